"""Problems as episodes of the environment: where they start, and what it sees and charges on the way.

A shard's episodes go through the vector environment together, which gives bit for bit what single ones with
the same seeds and actions do.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.environment import DQSpaceArmVectorEnv
from experts.problem import FloatArray


class Episodes(NamedTuple):
    """Episodes with given actions, M of them.

    Attributes:
        states: Shape (M, N + 1, n_x), units of the state.
        observations: As the environment gives them, shape (M, N + 1, n_obs).
        rewards: Shape (M, N), dimensionless.
        start_errors: Attitude error [deg] and position error [m] of the tip at the start, shape (M, 2).
        final_errors: The same at the end, shape (M, 2).
        is_success: Whether those are within the scene's tolerances, shape (M,).
    """

    states: FloatArray
    observations: FloatArray
    rewards: FloatArray
    start_errors: FloatArray
    final_errors: FloatArray
    is_success: NDArray[np.bool_]

    def total_reward(self, episode: int) -> float:
        """Return of an episode.

        Args:
            episode: Its number.

        Returns:
            Sum of its rewards, correctly rounded, dimensionless.
        """
        return math.fsum(self.rewards[episode].tolist())


def draw_starts(scene: Scene, seeds: Sequence[int]) -> FloatArray:
    """Where `env.reset(seed=...)` starts.

    Args:
        scene: The scene.
        seeds: A seed for each start.

    Returns:
        States, shape (len(seeds), n_x), units of the state.

    Raises:
        ValueError: If the environment refuses the scene, for example for want of a finite limit.
    """
    environment = _environment(scene, len(seeds))
    environment.reset(seed=list(seeds))
    return environment.states


def play(scene: Scene, seeds: Sequence[int], actions: FloatArray) -> Episodes:
    """Carry out actions in the environment.

    Args:
        scene: The scene, N steps.
        seeds: A seed for each episode, M of them.
        actions: Inputs as fractions of their limits, shape (M, N, n_u).

    Returns:
        The episodes. One that diverges, and so ends early, has NaN among its rewards.
    """
    count, horizon, n_controls = actions.shape
    if count == 0:
        one = play(scene, [0], np.zeros((1, horizon, n_controls)))
        return one._replace(**{name: getattr(one, name)[:0] for name in one._fields})
    environment = _environment(scene, count)
    observation, info = environment.reset(seed=list(seeds))
    start_errors = _errors(info)
    n_x, n_obs = environment.states.shape[1], observation.shape[1]
    states, observations = (np.empty((count, horizon + 1, size)) for size in (n_x, n_obs))
    rewards = np.empty((count, horizon))
    states[:, 0], observations[:, 0] = environment.states, observation
    over = np.zeros(count, dtype=np.bool_)
    for k in range(horizon):
        observation, reward, terminated, _, info = environment.step(actions[:, k])
        states[:, k + 1], observations[:, k + 1], rewards[:, k] = environment.states, observation, reward
        # What ends early begins anew, and the others go on.
        rewards[over, k] = np.nan
        over |= terminated
    return Episodes(states, observations, rewards, start_errors, _errors(info), info["is_success"].copy())


def _environment(scene: Scene, count: int) -> DQSpaceArmVectorEnv:
    return DQSpaceArmVectorEnv(count, scene)


def _errors(info: dict[str, Any]) -> FloatArray:
    return np.stack([info["attitude_error"], info["position_error"]], axis=1)
