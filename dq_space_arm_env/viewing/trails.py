"""Past positions of the tips of many episodes, for pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Trails:
    """A trail of tip positions for each of `count` episodes, which begins with the episode."""

    def __init__(self, count: int) -> None:
        self._positions: list[Array] = []
        self._starts = np.zeros(count, dtype=np.int64)

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Clear the trails of some episodes."""
        self._starts[rows] = len(self._positions)

    def append(self, positions: Array) -> None:
        """Add positions, shape (count, 3), m, and drop those that belong to no trail any longer."""
        self._positions.append(positions)
        oldest = int(self._starts.min())
        del self._positions[:oldest]
        self._starts -= oldest

    def of(self, row: int) -> Array:
        """Trail of an episode, oldest first, shape (m, 3), m."""
        return np.array([positions[row] for positions in self._positions[self._starts[row] :]])
