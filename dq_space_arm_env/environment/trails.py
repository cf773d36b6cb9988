"""Where the tips of many copies have been since their episodes began, for pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Trails:
    """Past positions of the tips of copies; each copy's begin with its episode."""

    def __init__(self, count: int) -> None:
        """Begin with empty trails.

        Args:
            count: Number of copies.
        """
        self._positions: list[Array] = []
        self._starts = np.zeros(count, dtype=np.int64)

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Forget where the tips of some copies have been.

        Args:
            rows: Numbers of the copies, shape (k,).
        """
        self._starts[rows] = len(self._positions)

    def append(self, positions: Array) -> None:
        """Note where all tips are, and drop what belongs to no copy's episode any more.

        Args:
            positions: Positions in the inertial frame, shape (count, 3), m.
        """
        self._positions.append(positions)
        oldest = int(self._starts.min())
        del self._positions[:oldest]
        self._starts -= oldest

    def of(self, row: int) -> Array:
        """Find the trail of a copy.

        Args:
            row: Its number.

        Returns:
            Positions in the inertial frame, oldest first, shape (m, 3), m.
        """
        return np.array([positions[row] for positions in self._positions[self._starts[row] :]])
