"""Where the buffers of a program lie: those that are never needed at the same time share memory.

The vectors between calls are what fills the caches; the less room they take, the more of them stay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Lifetime:
    """First and last call between which a buffer must keep its content, both included.

    Attributes:
        first: Number of the call that writes it; -1 for before all calls.
        last: Number of the call that needs it last.
    """

    first: int
    last: int

    def overlaps(self, other: Lifetime) -> bool:
        """Whether two buffers are needed at the same time."""
        return self.first <= other.last and other.first <= self.last


def place(sizes: Mapping[str, int], lifetimes: Mapping[str, Lifetime]) -> tuple[dict[str, int], int]:
    """Give every buffer a place in one block of memory, first fit, the largest first.

    Args:
        sizes: Size of each buffer, in any unit.
        lifetimes: When each buffer is needed.

    Returns:
        Where each buffer begins, and the size of the block.
    """
    starts: dict[str, int] = {}
    for name in sorted(sizes, key=lambda name: -sizes[name]):
        start = 0
        taken = [other for other in starts if lifetimes[name].overlaps(lifetimes[other])]
        for other in sorted(taken, key=starts.__getitem__):
            if starts[other] - start >= sizes[name]:
                break
            start = max(start, starts[other] + sizes[other])
        starts[name] = start
    return starts, max((starts[name] + sizes[name] for name in starts), default=0)
