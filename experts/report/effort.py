"""Workload of the report of a scene."""

from collections.abc import Callable
from dataclasses import dataclass

Announce = Callable[[str, int, int], object]
"""Told what is being measured, and how many of how many items are done."""


@dataclass(frozen=True)
class Effort:
    """How much to measure."""

    steps_per_input: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    repeats: int = 9
    sample_seconds: float = 0.01
    max_iterations: int = 200  # of the expert
    starts: int = 30
    ratio: float = 1.05  # between neighbors of the values searched for the envelope
    all_parts: bool = True  # whether also shorter arms and parts that the scene does not have


FULL = Effort()
QUICK = Effort((1, 2, 4, 8, 16), 3, 0.002, 100, starts=6, ratio=1.2, all_parts=False)
