"""Arrays for the results of steps: the caller's, and used again once the caller has let go of them."""

from __future__ import annotations

from sys import getrefcount
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.kernels.report import FLAGS, REPORT

# A training loop holds the results of the last step or two; whoever keeps more gets fresh arrays.
_SPARES = 4


class StepResult(NamedTuple):
    """What a step returns.

    Attributes:
        observation: Shape (count, n_obs).
        report: A row for each name in `REPORT`, shape (len(REPORT), count).
        flags: A row for each name in `FLAGS`, shape (len(FLAGS), count).
    """

    observation: NDArray[Any]
    report: NDArray[np.float64]
    flags: NDArray[np.bool_]


class ResultArrays:
    """Hands out arrays that nobody else holds, neither them nor a view of them.

    Fresh arrays of hundreds of kilobytes at every step would make the operating system map and clear their
    pages at every step, which can take as long as the physics.
    """

    def __init__(self, observation_shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Hold nothing yet.

        Args:
            observation_shape: (count, n_obs).
            dtype: Type of the observations.
        """
        self._observation_shape, self._dtype = observation_shape, dtype
        self._spares: list[StepResult] = []
        self._holders_of_a_spare = _holders(self.fresh())
        self._next = 0

    def fresh(self) -> StepResult:
        """New arrays with arbitrary contents."""
        count = self._observation_shape[0]
        return StepResult(
            np.empty(self._observation_shape, self._dtype),
            np.empty((len(REPORT), count)),
            np.empty((len(FLAGS), count), np.bool_),
        )

    def take(self) -> StepResult:
        """Arrays with arbitrary contents, used before if some are free."""
        for spare in self._spares:
            if _holders(spare) == self._holders_of_a_spare:
                return spare
        result = self.fresh()
        if len(self._spares) < _SPARES:
            self._spares.append(result)
        else:
            self._spares[self._next] = result
            self._next = (self._next + 1) % _SPARES
        return result


def _holders(result: StepResult) -> int:
    """References to the arrays of a result; a view refers to the array that it shows."""
    return getrefcount(result[0]) + getrefcount(result[1]) + getrefcount(result[2])
