"""The plan of an episode for the receding-horizon expert, with its value function to second order."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, cast

import numpy as np

from experts.ddp.augmented_lagrangian import AugmentedLagrangian
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import Policy, Solution, StopReason, uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.guesses.policies import follow
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from experts.problems.window_problem import WindowProblem


@dataclass(frozen=True, eq=False)
class ManeuverPlan:
    """An optimal maneuver from a stage of the episode to its end; M stages."""

    first_stage: int  # of the episode
    solution: Solution
    policy: Policy  # of the solution; counts stages from the plan's start
    maneuver: ArmProblem  # the episode's, with success as constraint where the solution needs it
    reaches_target: bool  # whether the solution converged within the tolerances
    multipliers: FloatArray  # and penalties of constraints at every stage and the end, shape (M + 1, 2 m)
    Vx: FloatArray  # at every stage, shape (M, n_t)
    # at every stage, shape (M, n_t, n_t), without negative curvature: off the plan it would predict costs
    # without a lower bound
    Vxx: FloatArray

    @classmethod
    def make(
        cls,
        planner: GuidedDDP,
        state: FloatArray,
        stage: int,
        known: Sequence[Solution] = (),
        model: ArmProblem | None = None,
    ) -> Self:
        """Plan from a state at a stage; after the first one, policies of known solutions are the guesses.

        The model is the planner's problem, or after the first stage another one.

        Raises:
            RuntimeError: If the maneuver cannot be simulated or differentiated from this state.
            KeyboardInterrupt: If the user interrupts the solve.
        """
        maneuver = model or cast(ArmProblem, planner.problem)
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        problem.begin_at(stage)
        library = [_last_stages(solution, problem.horizon) for solution in known]
        solver = GuidedDDP(problem, library=library, reserve=planner.reserve) if stage > 0 else planner
        solution = uninterrupted(solver.solve(state, parameters=problem.parameters.rows))
        nothing = f"there is no plan from the state at stage {stage}: {solution.message}"
        # Under constraints it has no multipliers to go on with.
        if solution.stop_reason is StopReason.DIVERGED:
            raise RuntimeError(nothing)
        if solution.constraints is not None and problem.constraints is None:
            rows, maneuver = maneuver.parameters.rows, maneuver.constrained(planner.reserve)
            maneuver.parameters.set(rows)
            problem = WindowProblem(maneuver, problem.horizon)
            problem.begin_at(stage)
        if problem.constraints is not None:
            AugmentedLagrangian(problem.constraints).hold(solution.multipliers)
        exact = problem.has_second_order
        work = ShootingWorkspace(problem, second_order=exact, keep_values=True)
        work.start(state, solution.controls)
        work.differentiate()
        if exact:
            work.differentiate_twice()
        # The exact model may have no minimum where the solver ran out of iterations.
        models = (True, False) if exact else (False,)
        found = any(work.backward_pass(0.0, exact=model).completed for model in models)
        if not found:
            raise RuntimeError(nothing)
        hessians = _convex_part(work.update.Vxx_all)
        held = problem.parameters.more.copy()
        reached = solution.converged and maneuver.is_success(solution.states, solution.controls)
        policy = solution.policy()
        return cls(stage, solution, policy, maneuver, reached, held, work.update.Vx_all, hessians)

    def reaches_target_from(self, state: FloatArray, stage: int) -> bool:
        """Whether its policy, followed from a state at a stage, ends within the tolerances."""
        problem = WindowProblem(self.maneuver, self.maneuver.horizon - stage)
        problem.begin_at(stage)
        flight = follow(_last_stages(self.solution, problem.horizon), problem, state)
        return bool(np.isfinite(flight.cost)) and self.maneuver.is_success(flight.states, flight.controls)


def _last_stages(solution: Solution, count: int) -> Solution:
    """The last stages of a maneuver."""
    return replace(
        solution,
        states=solution.states[-count - 1 :],
        controls=solution.controls[-count:],
        feedback_gains=solution.feedback_gains[-count:],
        parameters=solution.parameters[-count - 1 :],
        multipliers=solution.multipliers[-count - 1 :],
    )


def _convex_part(matrices: FloatArray) -> FloatArray:
    """Set the negative eigenvalues of symmetric matrices to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.ascontiguousarray(vectors * np.maximum(values, 0.0)[:, None, :] @ vectors.transpose(0, 2, 1))
