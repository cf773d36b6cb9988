"""Plans of several flights: demonstrations, followed with their feedback gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env import Kernels
from experts.demonstrations.reading import Demonstration

FloatArray = NDArray[np.float64]


class Followed(NamedTuple):
    """What plans ask for at one stage.

    Attributes:
        action: clip(a_k + G_k (x (-) x_k)), inputs as fractions of their limits, shape (B, n_u).
        deviation: x (-) x_k in tangent coordinates, shape (B, n_t), rad, m, rad/s, m/s.
    """

    action: FloatArray
    deviation: FloatArray


@dataclass(frozen=True, eq=False)
class Plans:
    """Plans of B flights of N stages, chosen from M plans.

    Attributes:
        states: Shape (M, N + 1, n_x), units of the state.
        actions: Inputs as fractions of their limits, shape (M, N, n_u).
        gains: Change of the action per deviation in tangent coordinates, float32, shape (M, N, n_u, n_t).
        chosen: Which of them each flight follows, shape (B,).
    """

    states: FloatArray
    actions: FloatArray
    gains: NDArray[np.float32]
    chosen: NDArray[np.int64]

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration]) -> Self:
        """Take the plans of demonstrations.

        Args:
            demonstrations: M of them.

        Returns:
            Copies in memory, one flight for each.
        """
        shape = (len(demonstrations), *demonstrations[0].feedback_gains.shape)
        gains = np.empty(shape, dtype=np.float32)
        states, actions = [], []
        for row, each in zip(gains, demonstrations, strict=True):
            row[:] = each.feedback_gains
            states.append(each.states)
            actions.append(each.actions)
        return cls(np.stack(states), np.stack(actions), gains, np.arange(len(gains)))

    def choose(self, chosen: ArrayLike) -> Self:
        """Choose whose plans flights follow.

        Args:
            chosen: Shape (B,), in [0, M).

        Returns:
            The same plans, for these flights.
        """
        return replace(self, chosen=np.asarray(chosen, dtype=np.int64))

    def __len__(self) -> int:
        """Number B of flights."""
        return len(self.chosen)

    @property
    def starts(self) -> FloatArray:
        """States at which flights begin, shape (B, n_x), units of the state."""
        return np.asarray(self.states[self.chosen, 0])

    def planned(self, stage: int) -> FloatArray:
        """Give the actions of a stage without feedback.

        Args:
            stage: Stage k, in [0, N).

        Returns:
            Inputs as fractions of their limits, shape (B, n_u).
        """
        return np.asarray(self.actions[self.chosen, stage])

    def follow(self, kernels: Kernels, stage: int, measured: FloatArray) -> Followed:
        """Compare states with those planned, and react.

        Args:
            kernels: Functions of the plans' scene.
            stage: Stage k, in [0, N).
            measured: States x, shape (B, n_x), units of the state.

        Returns:
            What the feedback policies of the plans do.
        """
        deviation = kernels.difference(self.states[self.chosen, stage], measured)
        feedback = (self.gains[self.chosen, stage] @ deviation[:, :, None])[:, :, 0]
        return Followed(np.clip(self.planned(stage) + feedback, -1.0, 1.0), deviation)
