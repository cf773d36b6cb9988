"""What the expert would have done in states that a network visits."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from agents.imitation.flights import Visits
from agents.imitation.samples import Corrections
from dq_space_arm_env import Scene
from experts.arm_problem import ArmProblem
from experts.box_ddp import BoxDDP
from experts.demonstrations import Demonstrations, DemonstrationsError
from experts.demonstrations.reading import Demonstration
from experts.problem import FloatArray
from experts.window_problem import WindowProblem


def label_by_gains(demonstrations: Demonstrations, visits: Visits) -> Corrections:
    """Ask the feedback policies of the demonstrations from the same starts.

    It costs nothing, and holds as far as the flight is close to the demonstration.

    Args:
        demonstrations: M of them.
        visits: From their starts, in the same order.

    Returns:
        All visited states, with the actions clip(a_k + G_k (x (-) x_k)) and the gains. Inputs that these
        actions bring to a limit have no gain.
    """
    parts = []
    for i, demonstration in enumerate(demonstrations):
        steps = slice(int(visits.length[i]))
        states = visits.states[i, steps]
        gains = demonstration.feedback_gains[steps]
        deviations = demonstrations.tangent(demonstration.states[steps], states)
        wanted = demonstration.actions[steps] + np.einsum("kij,kj->ki", gains, deviations)
        free = np.abs(wanted) < 1.0
        parts.append(
            Corrections(
                states,
                visits.observations[i, steps],
                np.clip(wanted, -1.0, 1.0),
                np.where(free[:, :, None], gains, np.float32(0.0)),
            )
        )
    return Corrections.joined(parts)


class Solver:
    """Plans the rest of a maneuver anew, from states that a network visits."""

    def __init__(self, scene: Scene) -> None:
        """Prepare.

        Args:
            scene: The scene, in double precision.
        """
        self._maneuver = ArmProblem(scene)
        self._kernels = self._maneuver.kernels

    def label(
        self,
        demonstrations: Demonstrations,
        visits: Visits,
        solves: int,
        rng: np.random.Generator,
        progress: Callable[[int], None] = lambda done: None,
    ) -> tuple[Corrections, int]:
        """Plan anew from some stages of every flight.

        The plan from a stage holds until the next one, so that a flight gives as many time steps as it has
        stages. Each begins at a visited state, and goes on as the expert would: back to where it can still
        arrive. The solver begins with the demonstration's feedback policy from there, and a plan that does
        not converge is not taken.

        Args:
            demonstrations: M of them.
            visits: From their starts, in the same order.
            solves: Stages to plan from in each flight; the first one is drawn from the first part of the
                flight, the second from the second, and so on.
            rng: Draws them.
            progress: Called after each flight with the number of those that are done.

        Returns:
            Time steps of the plans, and the number of plans, those that did not converge included.

        Raises:
            ValueError: If the demonstrations do not say with which emphasis they were planned.
            DemonstrationsError: If no plan has converged.
        """
        if np.isnan(demonstrations.column("emphasis")).any():
            raise ValueError(
                f"{demonstrations.path}: these demonstrations do not say how much the final pose was "
                "emphasized, so that the expert cannot plan as it did: take labels from gains"
            )
        plans: list[Corrections | None] = []
        for i, demonstration in enumerate(demonstrations):
            plans += self._plans(demonstration, visits, i, solves, rng)
            progress(i + 1)
        parts = [plan for plan in plans if plan is not None]
        if not parts:
            raise DemonstrationsError("no plan from any visited state converges: the policy strays too far")
        return Corrections.joined(parts), len(plans)

    def _plans(
        self,
        demonstration: Demonstration,
        visits: Visits,
        flight: int,
        solves: int,
        rng: np.random.Generator,
    ) -> Iterator[Corrections | None]:
        length = int(visits.length[flight])
        bounds = np.linspace(0, length, solves + 1).astype(np.int64)
        stages = [int(rng.integers(a, b)) for a, b in pairwise(bounds.tolist()) if a < b]
        for stage, end in zip(stages, [*stages[1:], self._maneuver.horizon], strict=True):
            yield self._plan(demonstration, visits.states[flight, stage], stage, end)

    def _plan(
        self, demonstration: Demonstration, state: FloatArray, stage: int, end: int
    ) -> Corrections | None:
        maneuver, limits = self._maneuver, self._maneuver.control_upper
        problem = WindowProblem(maneuver, maneuver.horizon - stage)
        guess = self._followed(demonstration, state, stage) * limits
        # With the same weight of the final pose, so that what has missed the target otherwise reaches it.
        with maneuver.emphasized(float(demonstration.facts["emphasis"])):
            solution = BoxDDP(problem).solve(x0=state, u_init=guess)
        if not solution.converged:
            return None
        steps = slice(0, end - stage)
        states = solution.states[steps]
        left = (maneuver.horizon - stage - np.arange(len(states))) * maneuver.time_step
        gains = solution.feedback_gains[steps] / limits[:, None]
        return Corrections(
            states,
            self._kernels.observation(states, left[:, None])[0],
            solution.controls[steps] / limits,
            gains.astype(np.float32),
        )

    def _followed(self, demonstration: Demonstration, state: FloatArray, stage: int) -> FloatArray:
        """Actions of the demonstration's feedback policy from a state on."""
        actions = demonstration.actions[stage:].copy()
        limits = self._maneuver.control_upper
        for k in range(len(actions)):
            deviation = self._kernels.difference(demonstration.states[stage + k], state)
            actions[k] = np.clip(actions[k] + demonstration.feedback_gains[stage + k] @ deviation, -1.0, 1.0)
            state = self._kernels.step(state, actions[k] * limits)
        return actions
