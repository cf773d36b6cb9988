"""What a solve carries from iteration to iteration, and why it ends."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from experts.models import ModelSchedule
from experts.solution import IterationRecord, StopReason

COST_FLOOR = 1e-9
"""Costs below this share of the first one count as zero: relative measures are taken to it."""

Callback = Callable[[IterationRecord], None]


class Stop(NamedTuple):
    """Why a solve ends, and the same in words."""

    reason: StopReason
    message: str


@dataclass
class Progress:
    """What a solve carries from iteration to iteration.

    Attributes:
        schedule: Which model to take, and its damping.
        first_cost: Cost of the first trajectory without gaps, in the unit of the cost.
        optimality: Relative decrease that an undamped step promises, inf where unknown.
        idle_iterations: Iterations in a row that hardly lowered the cost.
        note: What became of gaps that no step closed, for the message; empty if there were none.
        records: One per iteration.
    """

    schedule: ModelSchedule
    first_cost: float = 0.0
    optimality: float = np.inf
    idle_iterations: int = 0
    note: str = ""
    records: list[IterationRecord] = field(default_factory=list)

    def scale(self, cost: float) -> float:
        """A cost to relate changes to: positive however small the cost is.

        Args:
            cost: In the unit of the cost.

        Returns:
            The same, or a positive number in place of a cost that counts as zero.
        """
        return max(abs(cost), COST_FLOOR * abs(self.first_cost), float(np.finfo(np.float64).tiny))

    def iteration_limit(self, max_iterations: int) -> Stop | None:
        """Say that the iterations are used up, if they are.

        Args:
            max_iterations: Largest number of iterations.

        Returns:
            The reason to stop, or None.
        """
        if len(self.records) < max_iterations:
            return None
        return Stop(StopReason.MAX_ITERATIONS, f"the limit of {max_iterations} iterations is reached")
