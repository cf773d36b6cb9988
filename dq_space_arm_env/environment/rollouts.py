"""Rollouts: the one episode loop; a policy flies episodes side by side in the native vector environment."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import fsum
from time import perf_counter
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.environment.disturbances import Disturbance, Disturbances, displaced
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.parameters import has_grasp
from dq_space_arm_env.task.step_report import cost_names
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.payload_places import leaves_tip, payload_path

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_AT_THE_END = ("attitude_error", "position_error", "is_success", "diverged", "caught")

Policy = Callable[[NDArray[Any]], ArrayLike]
"""From observations, shape (B, n_obs), to actions, fractions of the limits, shape (B, n_u).

If a policy has a method `begin(environment)`, it is called when the episodes begin, with the vector
environment, where a controller that needs more than observations finds states, targets and scene.
"""


@dataclass(frozen=True)
class StateFeedback:
    """A controller that reads states and the step instead of observations.

    Attributes:
        act: From measured states, shape (B, n_x), and the step k to actions, shape (B, n_u).
        begin: Called with the vector environment when the episodes begin.
    """

    act: Callable[[FloatArray, int], ArrayLike]
    begin: Callable[[DQSpaceArmVectorEnv], object] = lambda environment: None


@dataclass(frozen=True, eq=False)
class Rollout:
    """B episodes of a scene, N steps or fewer each.

    Attributes:
        scene: The scene.
        seeds: Of the episodes; None if they began at given states.
        parameters: What varies, as drawn or given, shape (B, n_p), units of the parameters.
        targets: Poses q_{D/I}, at the start where they move, shape (B, 8), dimensionless and m.
        rewards: Shape (B, N), dimensionless; zero after the end of an episode.
        cost_terms: Sums of the terms of the cost by their names in `info`, shape (B,) each, dimensionless.
        length: Steps flown, shape (B,); all of the scene's unless the simulation diverged.
        initial_errors: Attitude error [deg] and position error [m] of the tip at the start, shape (B, 2).
        attitude_error: Of the tip at the end, shape (B,), deg.
        position_error: Of the tip at the end, shape (B,), m.
        is_success: Whether both are within the scene's tolerances, shape (B,); False if the policy failed.
        diverged: Whether the simulation blew up, shape (B,).
        policy_failed: Whether the policy gave NaN, shape (B,); the episode went on with zero inputs.
        base_turn: Largest angle by which the base turned away from its first attitude, shape (B,), deg.
        action_seconds: Time of each call of the policy, shape (N,), s.
        states: Shape (B, N + 1, n_x), units of the state; this and the next three are None unless recorded,
            and arbitrary after the end of an episode.
        observations: Shape (B, N + 1, n_obs), as the policy saw them.
        controls: Commanded inputs, shape (B, N, n_u), N, N m or rad/s.
        noise: Disturbance added to them, same shape and units; None without.
        caught: Whether the last catch has not failed, shape (B,); None in a scene without.
        constraint_violations: Share of the steps whose violations exceed the constraints' tolerances, shape
            (B,): `info["cost"]` is above 1; None in a scene without constraints.
    """

    scene: Scene
    seeds: tuple[int, ...] | None
    parameters: FloatArray
    targets: FloatArray
    rewards: FloatArray
    cost_terms: dict[str, FloatArray]
    length: NDArray[np.int64]
    initial_errors: FloatArray
    attitude_error: FloatArray
    position_error: FloatArray
    is_success: Mask
    diverged: Mask
    policy_failed: Mask
    base_turn: FloatArray
    action_seconds: FloatArray
    states: FloatArray | None = None
    observations: FloatArray | None = None
    controls: FloatArray | None = None
    noise: FloatArray | None = None
    caught: Mask | None = None
    constraint_violations: FloatArray | None = None

    @cached_property
    def cost(self) -> FloatArray:
        """J of each episode, minus its return, shape (B,), dimensionless."""
        return np.array([-fsum(rewards) for rewards in self.rewards.tolist()])

    def __len__(self) -> int:
        return len(self.rewards)

    def trajectory(self, episode: int = 0, label: str = "", start: str = "") -> Trajectory:
        """The record of one episode, whose states must have been recorded."""
        if self.states is None or self.controls is None:
            raise ValueError("the rollout has no states: call rollout(..., record=True)")
        steps, layout = int(self.length[episode]), StateLayout.of(self.scene)
        parameters = self.parameters[episode]
        states, kernels = self.states[episode, : steps + 1], compile_scene(self.scene)
        if layout.parameters.move_target:
            parameters = kernels.stage_parameters(parameters)[: steps + 1]
        target, payload = layout.target_with(parameters), None
        if leaves_tip(self.scene):
            caught = self.caught is None or bool(self.caught[episode])
            payload = payload_path(self.scene, kernels.tip_pose(states), target, caught)
        return Trajectory(
            label=label,
            states=states,
            controls=self.controls[episode, :steps],
            noise=None if self.noise is None else self.noise[episode, :steps],
            rewards=self.rewards[episode, :steps],
            target=target,
            payload=payload,
            target_body=layout.target_body_with(parameters) if has_grasp(self.scene) else None,
            scene=self.scene,
            start=start,
            seed=None if self.seeds is None else self.seeds[episode],
            attitude_error=float(self.attitude_error[episode]),
            position_error=float(self.position_error[episode]),
            is_success=bool(self.is_success[episode]),
            diverged=bool(self.diverged[episode]),
            action_seconds=float(np.median(self.action_seconds[: int(self.length.max())])),
        )


def rollout(
    policy: Policy | StateFeedback,
    scene: Scene,
    seeds: Sequence[int] | None = None,
    *,
    starts: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
    disturbances: Disturbances | None = None,
    delay: int = 0,
    record: bool = False,
    steps: int | None = None,
    progress: Callable[[int, int], None] = lambda step, steps: None,
) -> Rollout:
    """Fly episodes side by side.

    Args:
        policy: The policy.
        scene: The scene.
        seeds: One per episode: they begin where `env.reset(seed=seed)` does.
        starts: States to begin at instead, shape (B, n_x), units of the state; with neither, one episode
            begins at the scene's nominal state.
        parameters: What varies, shape (n_p,) or (B, n_p), units of the parameters, instead of what is drawn;
            nominal with starts. The policy is not told.
        disturbances: Pushes and noise. The policy sees measured states or their observations.
        delay: Steps from an action to its effect; until the first one arrives all inputs are zero. Unlike
            that of a scene's actuators it is not modeled: no state and no observation tells of it.
        record: Whether to keep states, observations and controls.
        steps: Number of steps at most; the scene's by default.
        progress: Called after each step with its number and the number of all.

    Returns:
        The rollout.

    Raises:
        TypeError: If actions are masked, or not of real numbers.
        ValueError: If actions or starts have a wrong shape, there is no episode, seeds are no whole numbers,
            delay is none of at least 0 or steps none of at least 1, disturbances are those of another number
            of episodes, or both seeds and starts are given.
    """
    if seeds is not None and starts is not None:
        raise ValueError("seeds and starts exclude each other")
    if not isinstance(delay, int | np.integer) or delay < 0:
        raise ValueError(f"delay: {delay}, should be at least 0 steps, a whole number")
    if not all(isinstance(seed, int | np.integer) for seed in (() if seeds is None else seeds)):
        raise ValueError(f"seeds: {shortened(seeds)}, should be whole numbers")
    if steps is None:
        steps = scene.simulation.steps
    elif isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ValueError(f"steps: {steps!r}, should be a whole number of at least 1, or None")
    environment, observation, info = _begin(scene, seeds, starts, parameters)
    if disturbances is not None and disturbances.episodes != environment.num_envs:
        raise ValueError(
            f"disturbances: those of {disturbances.episodes} episodes, should be of {environment.num_envs}: "
            f"make them with count={environment.num_envs}"
        )
    if (begin := getattr(policy, "begin", None)) is not None:
        begin(environment)
    log = _Log(environment, observation, info, steps, record)
    observes = record or not isinstance(policy, StateFeedback)
    idle = np.zeros((len(log.state), environment.kernels.n_u))
    waiting = deque([idle] * delay)  # actions on their way, the oldest first
    for step in range(log.steps):
        known = measured = log.state
        disturbance = Disturbance() if disturbances is None else disturbances.draw()
        if disturbance.push is not None:
            environment.perturb(disturbance.push)
            log.state = measured = environment.states
        if disturbance.measurement is not None:
            measured = displaced(environment.kernels, log.state, disturbance.measurement)
        if measured is not known and observes:
            observation = environment.observe(measured)
        given = np.array(measured if isinstance(policy, StateFeedback) else observation)  # its own to change
        began = perf_counter()
        asked = policy.act(given, step) if isinstance(policy, StateFeedback) else policy(given)
        log.action_seconds[step] = perf_counter() - began
        waiting.append(np.array(real_array("actions of the policy", asked)))
        actions = log.before_step(step, observation, waiting.popleft(), disturbance.inputs)
        observation, reward, terminated, _, info = environment.step(actions)
        log.after_step(step, reward, terminated, info)
        progress(step + 1, log.steps)
        if not log.flying.any():
            break
    return log.rollout(scene, seeds, observation, info)


def _begin(
    scene: Scene, seeds: Sequence[int] | None, starts: ArrayLike | None, parameters: ArrayLike | None
) -> tuple[DQSpaceArmVectorEnv, NDArray[Any], dict[str, Any]]:
    """The environment at the start of the episodes, with its observations and info."""
    options: dict[str, Any] = {} if parameters is None else {"parameters": np.asarray(parameters)}
    if starts is not None:
        options["initial_state"] = np.asarray(starts)
        if options["initial_state"].ndim != 2:
            raise ValueError(f"starts: shape {options['initial_state'].shape}, should be (B, n_x)")
    elif seeds is None:
        options["nominal"] = True
    drawn = [0] if seeds is None else list(seeds)
    count = len(drawn) if starts is None else len(options["initial_state"])
    if not count:
        raise ValueError(f"{'seeds' if starts is None else 'starts'}: none, should be one for each episode")
    # What diverges restarts at the next step and flies along without being counted.
    environment = DQSpaceArmVectorEnv(count, scene, autoreset_mode=AutoresetMode.NEXT_STEP)
    return environment, *environment.reset(seed=0 if seeds is None else drawn, options=options)


class _Log:
    """Accumulates the arrays of a rollout."""

    def __init__(
        self,
        environment: DQSpaceArmVectorEnv,
        observation: NDArray[Any],
        info: dict[str, Any],
        steps: int,
        record: bool,
    ) -> None:
        count, layout = environment.num_envs, environment.kernels.layout
        self._environment, self._layout, self.steps = environment, layout, steps
        self.state, self.targets = environment.states, environment.targets
        self.parameters = environment.parameters
        self.initial_errors = np.stack([info["attitude_error"], info["position_error"]], axis=1)
        self.rewards, self.action_seconds = np.zeros((count, steps)), np.zeros(steps)
        self.cost_terms = {name: np.zeros(count) for name in cost_names(environment.scene)}
        self.length = np.zeros(count, dtype=np.int64)
        self.violations = np.zeros(count) if environment.scene.constraints else None
        self.flying, self.failed = np.ones(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        self.last = {name: info[name].copy() for name in _AT_THE_END if name in info}
        # Real part of the base's pose, 4 numbers (planar: 2), and its smallest overlap with the first one.
        self._real = slice(layout.state.pose.start, (layout.state.pose.start + layout.state.pose.stop) // 2)
        self._attitude, self._overlap = self.state[:, self._real].copy(), np.ones(count)
        self.states: FloatArray | None = None
        self.observations: FloatArray | None = None
        self.controls: FloatArray | None = None
        self.noise: FloatArray | None = None
        if record:
            self.states = np.empty((count, steps + 1, layout.n_x))
            self.observations = np.empty((count, steps + 1, observation.shape[1]))
            self.controls = np.zeros((count, steps, layout.n_u))
            self.states[:, 0] = self.state

    def before_step(
        self, step: int, observation: NDArray[Any], actions: NDArray[Any], noise: FloatArray | None
    ) -> NDArray[Any]:
        """Check actions, record them, and add noise; NaN becomes zero, and marks the policy as failed."""
        environment, expected = self._environment, (len(self.flying), self._layout.n_u)
        if actions.shape != expected:
            raise ValueError(
                f"the policy gives actions of shape {actions.shape}; {expected[0]} episodes of scene "
                f"{environment.scene.name!r} want {expected}"
            )
        missing = np.isnan(actions)
        if missing.any():
            self.failed |= self.flying & missing.any(axis=1)
            actions[missing] = 0.0
        actions[self.failed] = 0.0
        if self.states is not None and self.observations is not None and self.controls is not None:
            self.states[:, step], self.observations[:, step] = self.state, observation
            stages = environment.stage_parameters
            self.controls[:, step] = self._layout.to_control(np.clip(actions, -1.0, 1.0), stages)
        if noise is None:
            return actions
        least = self._layout.lower_limits(np.ones(self._layout.n_u))
        commanded = np.clip(actions.astype(np.float64), least, 1.0)
        disturbed = np.clip(commanded + noise, least, 1.0)
        if self.controls is not None:
            self.noise = np.zeros_like(self.controls) if self.noise is None else self.noise
            limits = self._layout.limits_with(environment.stage_parameters)
            self.noise[:, step] = (disturbed - commanded) * limits
        return disturbed

    def after_step(self, step: int, reward: FloatArray, terminated: Mask, info: dict[str, Any]) -> None:
        flying = self.flying
        self.state = self._environment.states
        if self.states is not None:
            self.states[:, step + 1] = self.state
        overlap = np.abs(np.sum(self._attitude * self.state[:, self._real], axis=1))
        np.minimum(self._overlap, overlap, out=self._overlap, where=flying)
        np.copyto(self.rewards[:, step], reward, where=flying)
        for name, sums in self.cost_terms.items():
            np.add(sums, info[name], out=sums, where=flying)
        self.length += flying
        if self.violations is not None:
            self.violations += flying & (info["cost"] > 1.0)
        ending = flying & terminated
        if ending.any():
            self._keep_last(info, ending)
            self.flying = flying & ~terminated

    def _keep_last(self, info: dict[str, Any], rows: Mask) -> None:
        for name, values in self.last.items():
            np.copyto(values, info[name], where=rows)

    def rollout(
        self, scene: Scene, seeds: Sequence[int] | None, observation: NDArray[Any], info: dict[str, Any]
    ) -> Rollout:
        self._keep_last(info, self.flying)  # where a rollout is shorter than the episodes
        if self.observations is not None:
            self.observations[:, self.length.max()] = observation
        return Rollout(
            scene=scene,
            seeds=None if seeds is None else tuple(int(seed) for seed in seeds),
            parameters=self.parameters,
            targets=self.targets,
            rewards=self.rewards,
            cost_terms=self.cost_terms,
            length=self.length,
            initial_errors=self.initial_errors,
            attitude_error=self.last["attitude_error"],
            position_error=self.last["position_error"],
            is_success=self.last["is_success"] & ~self.failed,
            diverged=self.last["diverged"],
            policy_failed=self.failed,
            base_turn=np.degrees(2.0 * np.arccos(self._overlap)),
            action_seconds=self.action_seconds,
            states=self.states,
            observations=self.observations,
            controls=self.controls,
            noise=self.noise,
            caught=self.last["caught"] != 0.0 if "caught" in self.last else None,
            constraint_violations=None if self.violations is None else self.violations / self.length,
        )
