"""Controllers that follow a plan of the expert: open loop, with its gains, or planning anew at every step.

They know the scene that they plan in, and where a flight starts; in flight they see what every agent sees.
Where the scene that they fly in is another one, nobody tells them.
"""

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.plans import Plans
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene, compile_scene
from experts import RecedingHorizonExpert
from experts.arm_problem import ArmProblem
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import ShardResult
from experts.problem import FloatArray
from experts.solution import Solution

OPEN_LOOP, FEEDBACK, RECEDING = "open-loop plan", "plan with gains", "receding horizon"
CONTROLLERS = {"open-loop": OPEN_LOOP, "gains": FEEDBACK, "receding": RECEDING}
"""The controllers that follow a plan: names by what users ask for."""


def plans_of(settings: Settings, result: ShardResult) -> tuple[Plans, FloatArray]:
    """Take the plans out of a shard of demonstrations.

    Where the expert gave none, the best trajectory of another solve is flown for what it is worth.

    Args:
        settings: What the shard follows from.
        result: The shard.

    Returns:
        A plan for each problem, in their order, and the time that planning took, shape (B,), s.

    Raises:
        KeyboardInterrupt: If the user interrupts it.
    """
    from safetensors.numpy import load

    arrays = load(result.content)
    kernels = compile_scene(settings.scene)
    count, first = len(settings.problems(result.shard)), settings.problems(result.shard).start
    layout, steps = kernels.layout, settings.scene.simulation.steps
    states = np.zeros((count, steps + 1, layout.n_x))
    actions = np.zeros((count, steps, layout.n_u))
    gains = np.zeros((count, steps, layout.n_u, layout.n_t), dtype=np.float32)
    rows = arrays["index"] - first
    states[rows], actions[rows] = arrays["states"], arrays["actions"]
    gains[rows] = arrays["feedback_gains"]
    for row, start in zip(arrays["failures.index"] - first, arrays["failures.start"], strict=True):
        solution = expert_of(settings.scene).solver.solve(start)
        states[row], actions[row], gains[row] = _parts(solution, layout.control_limit)
    return Plans(states, actions, gains, np.arange(count)), np.array(result.solve_seconds)


class PlanFollower:
    """A policy for `agents.evaluation.fly` that flies plans side by side, with their gains or without."""

    def __init__(self, scene: Scene, plans: Plans, *, feedback: bool) -> None:
        """Prepare.

        Args:
            scene: The scene that was planned in.
            plans: A plan for each episode.
            feedback: Whether to correct deviations.
        """
        self._kernels, self._plans, self._feedback = compile_scene(scene), plans, feedback
        self._stage = 0

    def begin(self, environment: DQSpaceArmVectorEnv) -> None:
        """Begin episodes.

        Args:
            environment: Where they are; nothing is read there.
        """
        self._stage = 0

    def __call__(self, observations: NDArray[Any]) -> FloatArray:
        """Choose the actions of the next stage.

        Args:
            observations: Shape (B, n_obs), units as in `DQSpaceArmEnv`.

        Returns:
            Actions, shape (B, n_u).
        """
        stage, self._stage = self._stage, self._stage + 1
        if not self._feedback:
            return self._plans.planned(stage)
        states = self._kernels.state_from_observation(observations)
        return self._plans.follow(self._kernels, stage, states).action


class SingleFollower:
    """The same for one episode, with as little ado as a controller on board would make, to take its time."""

    def __init__(self, scene: Scene, *, feedback: bool) -> None:
        """Plan the nominal maneuver.

        Args:
            scene: The scene.
            feedback: Whether to correct deviations.

        Raises:
            KeyboardInterrupt: If the user interrupts it.
        """
        problem = ArmProblem(scene)
        self._kernels, self._limit = problem.kernels, problem.control_upper
        solution = expert_of(problem.scene).solver.solve()
        self._actions = solution.controls / self._limit
        self._policy = solution.policy(problem) if feedback else None
        self._stage = 0

    def begin(self, environment: DQSpaceArmVectorEnv) -> None:
        """Begin an episode.

        Args:
            environment: Where it is; nothing is read there.
        """
        self._stage = 0

    def __call__(self, observation: NDArray[Any]) -> FloatArray:
        """Choose the action of the next stage.

        Args:
            observation: Shape (n_obs,), units as in `DQSpaceArmEnv`.

        Returns:
            Action, shape (n_u,).
        """
        stage, self._stage = self._stage, self._stage + 1
        if self._policy is None:
            return np.asarray(self._actions[stage])
        state = self._kernels.state_from_observation(observation)
        return self._policy(state, stage) / self._limit


class RecedingHorizon:
    """The receding-horizon expert as a policy of one episode for `agents.evaluation.fly`.

    Attributes:
        expert: The expert.
        planning_seconds: Time of the first action of the last episode, which plans it, s.
    """

    def __init__(self, scene: Scene) -> None:
        """Prepare, the nominal maneuver included, which every plan begins with.

        Args:
            scene: The scene to plan in.
        """
        self.expert = RecedingHorizonExpert(scene)
        self.expert.reset(self.expert.maneuver.initial_state)
        self.planning_seconds = 0.0
        self._first, self._lost = True, False

    def begin(self, environment: DQSpaceArmVectorEnv) -> None:
        """Begin an episode.

        Args:
            environment: Where it is; nothing is read there.
        """
        self.expert.reset()
        self._first, self._lost = True, False

    def __call__(self, observations: NDArray[Any]) -> FloatArray:
        """Choose the action.

        Args:
            observations: Shape (1, n_obs), units as in `DQSpaceArmEnv`.

        Returns:
            Action, shape (1, n_u); NaN once there was no plan.
        """
        started = perf_counter()
        action = None
        if not self._lost:
            try:
                action = self.expert(observations[0])[None]
            except RuntimeError:
                self._lost = True
        if self._first:
            self.planning_seconds, self._first = perf_counter() - started, False
        if action is not None:
            return action
        return np.full((1, self.expert.maneuver.n_controls), np.nan)


def _parts(solution: Solution, limit: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, actions and gains of a solution; zeros where it is not finite."""
    parts = (
        solution.states,
        solution.controls / limit,
        solution.feedback_gains / limit[:, None],
    )
    if all(np.isfinite(part).all() for part in parts):
        return parts
    return tuple(np.zeros_like(part) for part in parts)  # type: ignore[return-value]
