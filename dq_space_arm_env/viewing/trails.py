"""Past positions of the tips of many episodes, for pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Trails:
    """A trail of tip positions for each of `count` episodes, which begins with the episode."""

    def __init__(self, count: int) -> None:
        self._positions: list[list[Array]] = [[] for _ in range(count)]

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Clear the trails of some episodes."""
        for row in rows.tolist():
            self._positions[row] = []

    def extend(self, rows: NDArray[np.int64], positions: Array) -> None:
        """Add positions of some episodes, shape (len(rows), 3), m."""
        for row, position in zip(rows.tolist(), positions, strict=True):
            self._positions[row].append(position)

    def of(self, row: int) -> Array:
        """Trail of an episode, oldest first, shape (m, 3), m."""
        return np.array(self._positions[row]).reshape(-1, 3)
