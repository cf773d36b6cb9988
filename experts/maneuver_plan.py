"""A plan of what is left of a maneuver, with a quadratic model of the cost that remains at every stage."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from experts.arm_problem import ArmProblem
from experts.backward_sweep import SWEEP_DONE
from experts.box_ddp import BoxDDP
from experts.problem import FloatArray
from experts.shooting import ShootingWorkspace
from experts.solution import Policy, Solution, StopReason
from experts.window_problem import WindowProblem


@dataclass(frozen=True, eq=False)
class ManeuverPlan:
    """An optimal maneuver from a stage of the episode to its end; M stages.

    Attributes:
        first_stage: Stage of the episode at which it starts.
        solution: Trajectory and feedback gains.
        policy: Feedback policy of the solution; it counts stages from that of the plan's start.
        value_gradients: Vx at every stage, shape (M, n_t).
        value_hessians: Vxx at every stage without its negative curvature, shape (M, n_t, n_t). Off the plan
            that curvature would promise costs without a lower limit.
    """

    first_stage: int
    solution: Solution
    policy: Policy
    value_gradients: FloatArray
    value_hessians: FloatArray

    @classmethod
    def make(cls, maneuver: ArmProblem, state: FloatArray, stage: int, guess: FloatArray) -> Self:
        """Plan from a state.

        Args:
            maneuver: The whole maneuver, N stages.
            state: Shape (n_x,).
            stage: Stage of the state, in [0, N).
            guess: Controls of the whole maneuver to start from, shape (N, n_u).

        Returns:
            The plan.

        Raises:
            RuntimeError: If the maneuver cannot be simulated, or differentiated, from this state.
        """
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        solution = BoxDDP(problem).solve(x0=state, u_init=guess[stage:])
        exact = problem.has_second_order
        work = ShootingWorkspace(problem, second_order=exact, keep_values=True)
        work.start(state, solution.controls)
        work.differentiate()
        if exact:
            work.differentiate_twice()
        # Where the solver ran out of iterations the exact model may have no minimum; Gauss-Newton's has one.
        models = (True, False) if exact else (False,)
        found = any(work.sweep(0.0, exact=model).status == SWEEP_DONE for model in models)
        if solution.stop_reason is StopReason.DIVERGED or not found:
            raise RuntimeError(f"there is no plan from the state at stage {stage}: {solution.message}")
        hessians = _convex_part(work.update.stage_hessians)
        return cls(stage, solution, solution.policy(), work.update.stage_gradients, hessians)


def _convex_part(matrices: FloatArray) -> FloatArray:
    """Set the negative eigenvalues of symmetric matrices to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.ascontiguousarray(vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1))
