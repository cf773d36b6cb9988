"""Where a policy goes in flight, for the expert to say what it should have done there."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.flights import Flights, fly
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
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
    recorder = _Recorder(policy)
    flights = fly(recorder, scene, [int(seed) for seed in seeds])
    states, observations = (np.stack(rows, axis=1) for rows in (recorder.states, recorder.observations))
    # An episode that diverges begins anew, with all of its time left.
    begins_anew = np.diff(observations[:, :, -1], axis=1) > 0.0
    length = np.where(begins_anew.any(axis=1), 1 + begins_anew.argmax(axis=1), scene.simulation.steps)
    return Visits(states, observations, length, flights)


class _Recorder:
    """A policy that writes down what it sees, and the state behind it."""

    def __init__(self, policy: Callable[[FloatArray], NDArray[np.floating]]) -> None:
        self._policy = policy
        self.states: list[FloatArray] = []
        self.observations: list[FloatArray] = []

    def begin(self, environment: DQSpaceArmVectorEnv) -> None:
        self._environment = environment

    def __call__(self, observation: FloatArray) -> NDArray[np.floating]:
        self.states.append(self._environment.states.copy())
        self.observations.append(observation.copy())
        return self._policy(observation)
