"""Where a policy goes in flight, for the expert to say what it should have done there."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.flights import Flights, Recording, fly
from dq_space_arm_env import Scene
from experts.problem import FloatArray


class Visits(NamedTuple):
    """Episodes of a policy, M of them, N steps.

    Attributes:
        states: Before every step, shape (M, N, n_x), units of the state.
        observations: Of these states, shape (M, N, n_obs).
        length: Steps until it ended; N unless it diverged, shape (M,). What comes after that is not part of
            it.
        flights: What became of them.
    """

    states: FloatArray
    observations: FloatArray
    length: NDArray[np.int64]
    flights: Flights


def record(
    policy: Callable[[FloatArray], NDArray[np.floating]], scene: Scene, seeds: Sequence[int]
) -> Visits:
    """Let a policy fly episodes, side by side, and write down where it goes.

    Args:
        policy: Function from observations, shape (M, n_obs), to actions, shape (M, n_u).
        scene: The scene.
        seeds: A seed for each episode.

    Returns:
        The flights.
    """
    recording = Recording()
    flights = fly(policy, scene, [int(seed) for seed in seeds], recording=recording)
    return Visits(recording.states, recording.observations, flights.length, flights)
