"""Plans of several flights: demonstrations, followed with their feedback gains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env import Kernels
from experts.demonstrations import Demonstrations, DemonstrationsError

FloatArray = NDArray[np.float64]


class Followed(NamedTuple):
    """Response of plans to measured states at one stage."""

    action: FloatArray  # clip(a_k + G_k (x (-) x_k)), fractions of the limits, shape (B, n_u)
    deviation: FloatArray  # x (-) x_k in tangent coordinates, shape (B, n_t), rad, m, rad/s, m/s


@dataclass(frozen=True, eq=False)
class Plans:
    """Plans of B flights of N stages, chosen from M plans."""

    states: FloatArray  # shape (M, N + 1, n_x), units of the state
    actions: FloatArray  # fractions of the limits, shape (M, N, n_u)
    gains: NDArray[np.float32]  # d action / d deviation in tangent coordinates, shape (M, N, n_u, n_t)
    parameters: FloatArray  # what varied in the scene as it was planned in, shape (M, n_p)
    chosen: NDArray[np.int64]  # the plan of each flight, shape (B,)

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> Self:
        """Plans of demonstrations, one flight each, copied to memory."""
        if not len(demonstrations):
            raise DemonstrationsError(f"{demonstrations.path} has no demonstration to fly: generate others")
        shape = (len(demonstrations), *demonstrations[0].feedback_gains.shape)
        gains = np.empty(shape, dtype=np.float32)
        states, actions, varied = [], [], []
        for row, each in zip(gains, demonstrations, strict=True):
            row[:] = each.feedback_gains
            states.append(each.states)
            actions.append(each.actions)
            varied.append(each.parameters)
        parts = np.stack(states), np.stack(actions), gains, np.stack(varied)
        return cls(*parts, np.arange(len(gains)))

    def choose(self, chosen: ArrayLike) -> Self:
        """The same plans for other flights: the number of the plan of each, in [0, M)."""
        return replace(self, chosen=np.asarray(chosen, dtype=np.int64))

    def __len__(self) -> int:
        """Number B of flights."""
        return len(self.chosen)

    @property
    def starts(self) -> FloatArray:
        """Initial states of the flights, shape (B, n_x), units of the state."""
        return np.asarray(self.states[self.chosen, 0])

    @property
    def known(self) -> FloatArray:
        """What varies in each flight as its plan knows it, shape (B, n_p), units of the parameters."""
        return np.asarray(self.parameters[self.chosen])

    def planned(self, stage: int) -> FloatArray:
        """Planned actions a_k of stage k, fractions of the limits, shape (B, n_u)."""
        return np.asarray(self.actions[self.chosen, stage])

    def follow(self, kernels: Kernels, stage: int, measured: FloatArray) -> Followed:
        """Apply the feedback gains of stage k to measured states x, shape (B, n_x)."""
        deviation = kernels.difference(self.states[self.chosen, stage], measured)
        feedback = (self.gains[self.chosen, stage] @ deviation[:, :, None])[:, :, 0]
        least = kernels.layout.lower_limits(np.ones(kernels.n_u))
        return Followed(np.clip(self.planned(stage) + feedback, least, 1.0), deviation)
