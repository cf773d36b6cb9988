"""A plan of what is left of a maneuver, with a quadratic model of the cost that remains at every stage."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from experts.arm_problem import ArmProblem
from experts.backward_sweep import SWEEP_DONE
from experts.guesses import GuidedDDP
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
        emphasis: Factor of the final pose's weights at which the solution is a minimum: 1, or as much as
            reaching the target takes (`reaching`).
        value_gradients: Vx at every stage, with this emphasis, shape (M, n_t).
        value_hessians: Vxx at every stage without its negative curvature, shape (M, n_t, n_t). Off the plan
            that curvature would promise costs without a lower limit.
    """

    first_stage: int
    solution: Solution
    policy: Policy
    emphasis: float
    value_gradients: FloatArray
    value_hessians: FloatArray

    @classmethod
    def make(cls, maneuver: ArmProblem, state: FloatArray, stage: int, known: Solution) -> Self:
        """Plan from a state.

        Args:
            maneuver: The whole maneuver, N stages.
            state: Shape (n_x,).
            stage: Stage of the state, in [0, N).
            known: A solution of the whole maneuver from another start, whose policy is a guess.

        Returns:
            The plan.

        Raises:
            RuntimeError: If the maneuver cannot be simulated, or differentiated, from this state.
        """
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        rest = replace(
            known,
            states=known.states[stage:],
            controls=known.controls[stage:],
            feedback_gains=known.feedback_gains[stage:],
        )
        # At the beginning the maneuver itself is the problem, which knows the tip's screw motion besides.
        solver = GuidedDDP(maneuver if stage == 0 else problem, library=[rest])
        solution = solver.solve(state)
        emphasis = float(solution.metadata["emphasis"])
        exact = problem.has_second_order
        work = ShootingWorkspace(problem, second_order=exact, keep_values=True)
        with maneuver.emphasized(emphasis):
            work.start(state, solution.controls)
            work.differentiate()
            if exact:
                work.differentiate_twice()
            # Where the solver ran out of iterations the exact model may have no minimum.
            models = (True, False) if exact else (False,)
            found = any(work.sweep(0.0, exact=model).status == SWEEP_DONE for model in models)
        if solution.stop_reason is StopReason.DIVERGED or not found:
            raise RuntimeError(f"there is no plan from the state at stage {stage}: {solution.message}")
        hessians = _convex_part(work.update.stage_hessians)
        return cls(stage, solution, solution.policy(), emphasis, work.update.stage_gradients, hessians)


def _convex_part(matrices: FloatArray) -> FloatArray:
    """Set the negative eigenvalues of symmetric matrices to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.ascontiguousarray(vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1))
