"""Controllers that follow plans of the expert: open loop, with gains, or replanning at every step.

They know the scene that they plan in and the state that a flight starts in; in flight they see measured
states. Nobody tells them where the scene that they fly in differs.
"""

from collections.abc import Callable
from functools import partial
from itertools import count
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.plans import FloatArray, Plans
from dq_space_arm_env import Scene, compile_scene
from dq_space_arm_env.environment.rollouts import StateFeedback
from dq_space_arm_env.scene import StateLayout
from experts import RecedingHorizonExpert
from experts.ddp.solution import Solution, uninterrupted
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import ShardResult, draw_starts
from experts.problems.arm_problem import ArmProblem

OPEN_LOOP, FEEDBACK, RECEDING = "open-loop plan", "plan with gains", "receding horizon"
CONTROLLERS = {"open-loop": OPEN_LOOP, "gains": FEEDBACK, "receding": RECEDING}
"""The expert's controllers: names by what users ask for."""


def plans_of(settings: Settings, result: ShardResult) -> tuple[Plans, FloatArray]:
    """The plans of a shard of demonstrations, and the time to make each, shape (B,), s.

    Where the expert failed, the best trajectory of another solve is flown in place of a plan.
    """
    from safetensors.numpy import load

    arrays = load(result.content)
    kernels = compile_scene(settings.scene)
    problems = settings.problems(result.shard)
    layout, steps = kernels.layout, settings.scene.simulation.steps
    states = np.zeros((len(problems), steps + 1, layout.n_x))
    actions = np.zeros((len(problems), steps, layout.n_u))
    gains = np.zeros((len(problems), steps, layout.n_u, layout.n_t), dtype=np.float32)
    rows = arrays["index"] - problems.start
    states[rows], actions[rows] = arrays["states"], arrays["actions"]
    gains[rows] = arrays["feedback_gains"]
    varied = draw_starts(settings.scene, [settings.problem_seed(problem) for problem in problems]).parameters
    for row, start in zip(arrays["failures.index"] - problems.start, arrays["failures.start"], strict=True):
        solution = uninterrupted(expert_of(settings.scene).solver.solve(start, parameters=varied[row]))
        states[row], actions[row], gains[row] = _parts(solution, layout)
    return Plans(states, actions, gains, varied, np.arange(len(problems))), np.array(result.solve_seconds)


def _parts(solution: Solution, layout: StateLayout) -> tuple[FloatArray | float, ...]:
    """States, actions and gains of a solution; zeros if one is not finite."""
    stages = solution.parameters[:-1]
    actions = layout.to_action(solution.controls, stages)
    parts = (solution.states, actions, layout.to_action_gains(solution.feedback_gains, stages))
    return parts if all(np.isfinite(part).all() for part in parts) else (0.0, 0.0, 0.0)


def follower(scene: Scene, plans: Plans, *, feedback: bool) -> StateFeedback:
    """Fly plans made in a scene side by side, with their gains or open loop."""
    kernels = compile_scene(scene)
    if feedback:
        return StateFeedback(lambda states, stage: plans.follow(kernels, stage, states).action)
    return StateFeedback(lambda states, stage: plans.planned(stage))


def onboard_follower(scene: Scene, *, feedback: bool) -> Callable[[NDArray[Any]], FloatArray]:
    """Fly the plan of the nominal maneuver as an on-board controller would, to time its actions.

    It maps single observations, shape (n_obs,), to actions, shape (n_u,), for one episode.
    """
    problem = ArmProblem(scene)
    kernels, to_action = problem.kernels, problem.kernels.layout.to_action
    solution = uninterrupted(expert_of(problem.scene).solver.solve())
    policy, rows, stages = solution.policy(problem), problem.parameters.rows, count()
    if feedback:

        def act(seen: NDArray[Any]) -> FloatArray:
            stage = next(stages)
            control = policy(kernels.state_from_observation(seen, p=rows[stage]), stage)
            return np.asarray(to_action(control, rows[stage]))

        return act
    actions = to_action(solution.controls, rows[:-1])
    return lambda seen: np.asarray(actions[next(stages)])


class RecedingHorizon:
    """The receding-horizon expert in B episodes: plans each from its start, and replans at every step.

    Attributes:
        planning_seconds: Mean time to plan a flight when the last episodes began, s.
    """

    def __init__(self, scene: Scene, horizon: int = 100) -> None:
        """Prepare the expert for one episode, including the nominal maneuver that every plan starts with.

        Args:
            scene: The scene to plan in.
            horizon: Stages to look ahead.
        """
        self._scene, self._horizon, self.planning_seconds = scene, horizon, 0.0
        self._experts = [RecedingHorizonExpert(scene, horizon)]
        self._experts[0].reset(self._experts[0].maneuver.initial_state)
        self._lost: set[int] = set()

    def policy(self, parameters: FloatArray | None = None) -> StateFeedback:
        """Make the controller for `rollout`; it gives NaN in episodes that the expert cannot plan.

        Args:
            parameters: What varies in the scene to plan in, shape (B, n_p), units of the parameters; None for
                nominal values.
        """
        return StateFeedback(self._act, lambda environment: self._begin(environment.states, parameters))

    def _begin(self, starts: FloatArray, parameters: FloatArray | None) -> None:
        while len(self._experts) < len(starts):
            self._experts.append(RecedingHorizonExpert(self._scene, self._horizon))
        self._lost, began = set(), perf_counter()
        for index, start in enumerate(starts):
            told = None if parameters is None else parameters[index]
            self._attempt(index, partial(RecedingHorizonExpert.reset, parameters=told), start)
        self.planning_seconds = (perf_counter() - began) / len(starts)

    def _act(self, states: FloatArray, stage: int) -> FloatArray:
        actions = np.full((len(states), self._experts[0].maneuver.n_controls), np.nan)
        for index, state in enumerate(states):
            action = self._attempt(index, RecedingHorizonExpert.__call__, state)
            if action is not None:
                actions[index] = action
        return actions

    def _attempt(self, index: int, method: Callable[..., Any], state: FloatArray) -> Any:
        """Ask an expert, unless it has failed in this episode."""
        if index in self._lost:
            return None
        try:
            return method(self._experts[index], state)
        except RuntimeError:
            self._lost.add(index)
            return None
