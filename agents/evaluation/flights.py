"""Flying policies: one episode for each seed, all at once in the native vector environment."""

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from dq_space_arm_env import DQSpaceArmVectorEnv, Scene

FloatArray = NDArray[np.float64]
Policy = Callable[[NDArray[Any]], NDArray[Any]]

TIMED_ACTIONS = 300
"""Actions whose times are taken."""
_WARM_UP = 20


class Flights(NamedTuple):
    """What became of episodes, B of them.

    Attributes:
        cost: J of each, dimensionless, shape (B,).
        is_success: Whether the tip ended within the scene's tolerances, shape (B,); never where the policy
            failed.
        diverged: Whether the simulation blew up, shape (B,).
        policy_failed: Whether the policy gave something that is no number; from there on the episode went on
            without control, shape (B,).
        length: Steps until the episode ended, shape (B,); all of the scene's unless it diverged.
        attitude_error: Of the tip at the end, shape (B,), deg.
        position_error: Of the tip at the end, shape (B,), m.
        effort: What the cost charges for controls in all, shape (B,), dimensionless.
        base_turn: Largest angle by which the base turned away from its first attitude, shape (B,), deg.
    """

    cost: FloatArray
    is_success: NDArray[np.bool_]
    diverged: NDArray[np.bool_]
    policy_failed: NDArray[np.bool_]
    length: NDArray[np.int64]
    attitude_error: FloatArray
    position_error: FloatArray
    effort: FloatArray
    base_turn: FloatArray


class Recording:
    """What episodes look like on the way, B of them with N steps; to be given to `fly`, which fills it.

    Attributes:
        states: Before every step, shape (B, N, n_x), units of the state.
        observations: Of these states, shape (B, N, n_obs), units as in `DQSpaceArmEnv`. Of both, what comes
            after the length of an episode is none of it.
    """

    states: FloatArray
    observations: FloatArray

    def begin(self, states: FloatArray, observations: NDArray[Any], steps: int) -> None:
        """Make room.

        Args:
            states: First states, shape (B, n_x), units of the state.
            observations: Of them, shape (B, n_obs).
            steps: N.
        """
        self.states = np.empty((len(states), steps, states.shape[1]))
        self.observations = np.empty((len(states), steps, observations.shape[1]))

    def add(self, step: int, states: FloatArray, observations: NDArray[Any]) -> None:
        """Keep what is there before a step.

        Args:
            step: Its number, from 0.
            states: Shape (B, n_x), units of the state.
            observations: Shape (B, n_obs).
        """
        self.states[:, step], self.observations[:, step] = states, observations


def fly(
    policy: Policy,
    scene: Scene,
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda step, steps: None,
    *,
    recording: Recording | None = None,
) -> Flights:
    """Let a policy fly an episode for each seed.

    Args:
        policy: Function of observations, shape (B, n_obs), units as in `DQSpaceArmEnv`, that gives actions,
            shape (B, n_u), fractions of the limits. If it has a method `begin(environment)`, that is called
            when the episodes begin, with the vector environment: a controller that follows more than
            observations reads it there.
        scene: The scene.
        seeds: A seed for each episode, B of them.
        progress: Called after each step with its number and the number of all.
        recording: Gets states and observations before every step.

    Returns:
        What became of them.

    Raises:
        ValueError: If actions have a wrong shape.
    """
    environment = DQSpaceArmVectorEnv(len(seeds), scene, autoreset_mode=AutoresetMode.SAME_STEP)
    observation, info = environment.reset(seed=[int(seed) for seed in seeds])
    _begin(policy, environment)
    steps = scene.simulation.steps
    if recording is not None:
        recording.begin(environment.states, observation, steps)
    first_attitude = _base_attitude(environment)
    last = {
        name: info[name].copy() for name in ("is_success", "diverged", "attitude_error", "position_error")
    }
    cost, effort, base_turn = (np.zeros(len(seeds)) for _ in range(3))
    length = np.zeros(len(seeds), dtype=np.int64)
    flying, failed = np.ones(len(seeds), dtype=np.bool_), np.zeros(len(seeds), dtype=np.bool_)
    for step in range(steps):
        if recording is not None:
            recording.add(step, environment.states, observation)
        action = _checked(policy(observation), environment)
        failed |= flying & np.isnan(action).any(axis=1)
        action[failed] = 0.0
        action[np.isnan(action)] = 0.0  # of episodes that are over
        observation, reward, terminated, _, info = environment.step(action)
        # What has ended has begun anew, and flies along without being counted.
        ending = flying & terminated
        reports = info["final_info"] if ending.any() else info
        cost[flying] -= reward[flying]
        length += flying
        effort[flying] += np.where(terminated, reports["cost_control"], info["cost_control"])[flying]
        for name, values in last.items():
            values[ending] = reports[name][ending]
        flying &= ~terminated
        overlap = np.abs(np.sum(first_attitude * _base_attitude(environment), axis=1))
        turn = np.degrees(2.0 * np.arccos(np.minimum(overlap, 1.0)))
        base_turn[flying] = np.maximum(base_turn, turn)[flying]
        progress(step + 1, steps)
    last["is_success"] &= ~failed
    return Flights(cost=cost, policy_failed=failed, length=length, effort=effort, base_turn=base_turn, **last)


def time_per_action(policy: Policy, scene: Scene, *, batched: bool = True) -> float:
    """Measure how long a policy takes for one action, in flight.

    Args:
        policy: As for `fly`.
        scene: The scene.
        batched: Whether it wants a batch, here of one observation, rather than the observation, shape
            (n_obs,), units as in `DQSpaceArmEnv`.

    Returns:
        Median time, s.
    """
    environment = DQSpaceArmVectorEnv(1, scene)
    observation, _ = environment.reset(seed=0)
    _begin(policy, environment)
    times = []
    for _ in range(min(_WARM_UP + TIMED_ACTIONS, scene.simulation.steps)):
        given = observation if batched else observation[0]
        started = perf_counter()
        action = policy(given)
        times.append(perf_counter() - started)
        observation = environment.step(np.nan_to_num(np.reshape(action, (1, -1))))[0]
    return float(np.median(times[min(_WARM_UP, len(times) // 2) :]))


def _checked(action: NDArray[Any], environment: DQSpaceArmVectorEnv) -> NDArray[Any]:
    """A copy of actions, of the shape that the environment wants."""
    copied = np.array(action)
    expected = (environment.num_envs, environment.kernels.layout.n_u)
    if copied.shape != expected:
        raise ValueError(
            f"the policy gives actions of shape {copied.shape}; {expected[0]} episodes of scene "
            f"{environment.scene.name!r} want {expected}"
        )
    return copied


def _begin(policy: Policy, environment: DQSpaceArmVectorEnv) -> None:
    begin = getattr(policy, "begin", None)
    if begin is not None:
        begin(environment)


def _base_attitude(environment: DQSpaceArmVectorEnv) -> FloatArray:
    """Real part of the base's pose, shape (B, 4), or (B, 2) in a planar scene."""
    pose = environment.states[:, environment.kernels.layout.state.pose]
    return np.asarray(pose[:, : pose.shape[1] // 2], dtype=np.float64)
