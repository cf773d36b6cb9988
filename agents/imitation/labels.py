"""Label the states that a network visits with what the expert would have done there."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from agents.imitation.samples import Corrections
from dq_space_arm_env import Scene
from dq_space_arm_env.environment.rollouts import Rollout
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.demonstrations import Demonstrations, DemonstrationsError
from experts.demonstrations.reading import Demonstration
from experts.guesses.guided import RESERVE
from experts.guesses.initial_guesses import NEAR_REGULARIZATION
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from experts.problems.window_problem import WindowProblem


def label_by_gains(demonstrations: Demonstrations, visits: Rollout) -> Corrections:
    """Label every visited state by the feedback policy of the demonstration from the same start.

    The actions are clip(a_k + G_k (x (-) x_k)); inputs at a limit get zero gains. This costs nothing, and
    holds as long as the flight stays close to the demonstration.
    """
    assert visits.states is not None
    assert visits.observations is not None
    parts, layout = [], demonstrations.kernels.layout
    least = layout.lower_limits(np.ones(layout.n_u))
    for i, demonstration in enumerate(demonstrations):
        steps = slice(int(visits.length[i]))
        states = visits.states[i, steps]
        gains = demonstration.feedback_gains[steps]
        deviations = demonstrations.tangent(demonstration.states[steps], states)
        wanted = demonstration.actions[steps] + np.einsum("kij,kj->ki", gains, deviations)
        free = (least < wanted) & (wanted < 1.0)
        parts.append(
            Corrections(
                states,
                visits.observations[i, steps],
                np.clip(wanted, least, 1.0),
                np.where(free[:, :, None], gains, np.float32(0.0)),
                demonstrations.kernels.stage_parameters(demonstration.parameters)[steps],
            )
        )
    return Corrections.joined(parts)


class Solver:
    """Replans the rest of a maneuver from visited states, in a scene in double precision."""

    def __init__(self, scene: Scene) -> None:
        self._maneuver = ArmProblem(scene)
        self._kernels = self._maneuver.kernels

    def label(
        self,
        demonstrations: Demonstrations,
        visits: Rollout,
        solves: int,
        rng: np.random.Generator,
        progress: Callable[[int], None] = lambda done: None,
    ) -> tuple[Corrections, int]:
        """Replan from `solves` stages of every flight, drawn one from each of as many equal parts.

        A plan labels the stages up to the next one. It starts at a visited state and returns to the target as
        the expert would; its initial guess is the demonstration's feedback policy from there. Plans that do
        not converge are dropped. Returns the labels and the number of plans, dropped ones included.
        """
        plans: list[Corrections | None] = []
        for i, demonstration in enumerate(demonstrations):
            plans += self._plans(demonstration, visits, i, solves, rng)
            progress(i + 1)
        parts = [plan for plan in plans if plan is not None]
        if not parts:
            raise DemonstrationsError("no plan from any visited state converges: the policy strays too far")
        return Corrections.joined(parts), len(plans)

    def _plans(
        self, demonstration: Demonstration, visits: Rollout, i: int, solves: int, rng: np.random.Generator
    ) -> Iterator[Corrections | None]:
        assert visits.states is not None
        length = int(visits.length[i])
        bounds = np.linspace(0, length, solves + 1).astype(np.int64)
        stages = [int(rng.integers(a, b)) for a, b in pairwise(bounds.tolist()) if a < b]
        for stage, end in zip(stages, [*stages[1:], self._maneuver.horizon], strict=True):
            yield self._plan(demonstration, visits.states[i, stage], stage, end)

    def _plan(
        self, demonstration: Demonstration, state: FloatArray, stage: int, end: int
    ) -> Corrections | None:
        maneuver, layout = self._maneuver, self._kernels.layout
        maneuver.parameters.set(demonstration.parameters)  # its end is that of the window
        rows = maneuver.parameters.rows[stage:]
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        guess = layout.to_control(self._followed(demonstration, state, stage, rows), rows[:-1])
        solution = uninterrupted(BoxDDP(problem).solve(x0=state, u_init=guess, parameters=rows))
        if solution.converged and not problem.is_success(solution.states, solution.controls):
            within = BoxDDP(problem.constrained(RESERVE), initial_regularization=NEAR_REGULARIZATION)
            reached = uninterrupted(within.solve(x0=state, u_init=solution.controls, parameters=rows))
            solution = reached if reached.converged else solution  # too late to reach the target
        if not solution.converged:
            return None
        steps = slice(0, end - stage)
        states = solution.states[steps]
        left = (maneuver.horizon - stage - np.arange(len(states))) * maneuver.time_step
        gains = layout.to_action_gains(solution.feedback_gains[steps], rows[steps])
        return Corrections(
            states,
            self._kernels.observation(states, left[:, None], p=rows[steps])[0],
            layout.to_action(solution.controls[steps], rows[steps]),
            gains.astype(np.float32),
            rows[steps].copy(),
        )

    def _followed(
        self, demonstration: Demonstration, state: FloatArray, stage: int, rows: FloatArray
    ) -> FloatArray:
        """Actions of the demonstration's feedback policy, rolled out from a state."""
        actions, layout = demonstration.actions[stage:].copy(), self._kernels.layout
        least = layout.lower_limits(np.ones(layout.n_u))
        for k in range(len(actions)):
            deviation = self._kernels.difference(demonstration.states[stage + k], state)
            wanted = actions[k] + demonstration.feedback_gains[stage + k] @ deviation
            actions[k] = np.clip(wanted, least, 1.0)
            state = self._kernels.step(state, layout.to_control(actions[k], rows[k]), p=rows[k])
        return actions
