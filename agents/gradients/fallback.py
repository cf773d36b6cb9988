"""What a training goes back to where its motions become unstable, to take smaller steps from there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

WORSE = 2.0  # median cost relative to recent ones, above which a training has lost what it had
DRIFTED = 1.5  # likewise of recent costs, relative to those of the copy to go back to
WORTHY = 1.2  # likewise, up to which a newer copy takes its place
LOST = 0.3  # further share of episodes that miss the tolerances, beyond which it has, too
WORTHY_LOSS = 0.1  # likewise, up to which a newer copy takes its place
PATIENCE = 1.003  # factor in an update by which costs may rise, as where constraints come to matter
FORGETTING = 0.05  # share of the newest in the mean of recent costs, and of misses
BETWEEN_COPIES = 50  # updates; the copy to go back to is the last but one
REDUCTION = 0.7  # factor of the learning rate each time
RECOVERY = 1.001  # factor by which it comes back in an update
LEAST_RATE = 1e-3  # factor of the learning rate at which the training gives up


@dataclass
class Copy:
    """Arrays of a training by name, with its recent cost and share of misses."""

    arrays: dict[str, Array]
    cost: float
    missing: float

    def under(self, name: str) -> dict[str, Array]:
        """Everything, as arrays of a checkpoint."""
        numbers = {"cost": np.array(self.cost), "missing": np.array(self.missing)}
        return {f"{name}.{key}": each for key, each in {**self.arrays, **numbers}.items()}

    @classmethod
    def read(cls, name: str, arrays: Mapping[str, Array]) -> Copy:
        """From what `under` has returned, and other arrays."""
        start = f"{name}."
        found = {key.removeprefix(start): each for key, each in arrays.items() if key.startswith(start)}
        cost, missing = float(found.pop("cost")), float(found.pop("missing"))
        return cls(found, cost, missing)


class Fallback:
    """The last two copies of a training, what its episodes cost and miss of late, and its learning rate."""

    def __init__(self, arrays: dict[str, Array]) -> None:
        self.cost, self.missing = math.inf, 1.0  # median cost; share that misses the tolerances
        self.rate = 1.0  # factor of the learning rate
        self.happened = False
        self.kept, self.newer = (Copy(arrays, self.cost, self.missing) for _ in range(2))

    def is_needed(self, median: float, warm: bool) -> bool:
        """Whether episodes with a median cost, or the recent ones if warmed up, have lost what there was."""
        return math.isinf(median) or (warm and (self._costs_more(median) or self._misses_more()))

    def _costs_more(self, median: float) -> bool:
        return self.cost > DRIFTED * self.kept.cost or median > WORSE * self.cost

    def _misses_more(self) -> bool:
        return self.missing > self.kept.missing + LOST

    def pays_for_missing(self, median: float) -> str | None:
        """What to tell where more episodes miss although they cost no more; None where that is not so."""
        if math.isinf(median) or self._costs_more(median) or not self._misses_more():
            return None
        return (
            f"the share of flights that miss rose from {self.kept.missing:.2f} to {self.missing:.2f}, again "
            "and again: the cost pays for missing; lower cost.base_force or cost.base_torque, or raise "
            "cost.terminal_pose"
        )

    def go_back(self, median: float, other_costs: bool) -> None:
        """Go on from the kept copy, whose episodes have a median cost, by smaller steps.

        With `other_costs`, the same motions have others now: it says nothing about the copy.
        """
        kept = self.kept
        self.cost, self.missing = min(self.cost, kept.cost), min(self.missing, kept.missing)
        if not other_costs and median > WORSE * self.cost:
            self.cost = kept.cost = median  # that was no better
        # The newest may have been on the brink already.
        self.newer = replace(kept)
        self.rate *= REDUCTION
        self.happened = True

    def takes_copy(self, updates: int) -> bool:
        """Whether the training should be copied after some updates."""
        stays = self.cost <= WORTHY * self.kept.cost and self.missing <= self.kept.missing + WORTHY_LOSS
        return updates % BETWEEN_COPIES == 0 and stays

    def copy(self, arrays: dict[str, Array]) -> None:
        """Keep the newer copy, and take another one: what comes of it has to be known before it is kept."""
        self.kept, self.newer = self.newer, Copy(arrays, self.cost, self.missing)

    def recover(self) -> None:
        """Let costs rise and steps grow a little, once an update."""
        for copy in (self.kept, self.newer):
            copy.cost *= PATIENCE
        self.rate = min(self.rate * RECOVERY, 1.0)

    def note_cost(self, median: float) -> None:
        """Take the median cost of an update's episodes into that of the recent ones."""
        recent = self.cost if math.isfinite(self.cost) else median
        self.cost = recent + FORGETTING * (median - recent)

    def note_misses(self, share: float) -> None:
        """Likewise the share that misses the tolerances."""
        self.missing += FORGETTING * (share - self.missing)

    def forget_costs(self) -> None:
        """Begin with recent costs anew: the same motions have others now."""
        self.cost = self.kept.cost = self.newer.cost = math.inf

    def arrays(self) -> dict[str, Array]:
        """Everything that it remembers, by name."""
        numbers = {"rate": np.array(self.rate), "happened": np.array(self.happened)}
        now = Copy(numbers, self.cost, self.missing)
        return {**now.under("now"), **self.kept.under("kept"), **self.newer.under("newer")}

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Go on from what `arrays` has returned."""
        now, self.kept, self.newer = (Copy.read(name, arrays) for name in ("now", "kept", "newer"))
        self.cost, self.missing = now.cost, now.missing
        self.rate, self.happened = float(now.arrays["rate"]), bool(now.arrays["happened"])
