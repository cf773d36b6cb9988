"""How far the parts of a training by imitation have come, in one line each."""

import math
from collections.abc import Mapping
from datetime import timedelta
from typing import NamedTuple

from experts.demonstrations import Advance as GenerationAdvance
from experts.demonstrations.progress import describe


class TrainingAdvance(NamedTuple):
    """How far a training has come.

    Attributes:
        total: Number of updates in all.
        done: Updates that are done.
        rate: Updates a second in this run; 0 before the first ones.
        losses: Of the last validation, or where there is none of the training since, by name; empty before.
        part: What is being done, for the beginning of the line; empty for nothing.
    """

    total: int
    done: int
    rate: float
    losses: Mapping[str, float]
    part: str = ""

    @property
    def seconds_left(self) -> float:
        """Time that the rest takes at this rate, s; inf if it is not known."""
        return (self.total - self.done) / self.rate if self.rate > 0.0 else math.inf

    def describe(self) -> str:
        """Put into one line how far it has come.

        Returns:
            The line.
        """
        line = f"{self.part}{': ' * bool(self.part)}{self.done} of {self.total} updates"
        for name in ("action", "gain"):
            value = self.losses.get(f"validation_{name}", self.losses.get(name, 0.0))
            if value:
                line += f", {name} loss {value:.2e}"
        if self.rate > 0.0:
            line += f", {self.rate:.0f} a second"
        if 0.0 < self.seconds_left < math.inf:
            line += f", {timedelta(seconds=round(self.seconds_left))} left"
        if "success_rate" in self.losses:
            line += f"; success {self.losses['success_rate']:.0%}"
        return line


class Generating(NamedTuple):
    """How far the demonstrations have come.

    Attributes:
        advance: How far.
    """

    advance: GenerationAdvance

    @property
    def done(self) -> int:
        """Problems that are solved."""
        return self.advance.done

    @property
    def total(self) -> int:
        """Problems in all."""
        return self.advance.problems

    def describe(self) -> str:
        """Put into one line how far they have come.

        Returns:
            The line.
        """
        return f"demonstrations: {describe(self.advance)}"


class Labeling(NamedTuple):
    """How far the expert has come with what a policy has done.

    Attributes:
        part: The round.
        done: Flights that are labeled.
        total: Of so many.
    """

    part: str
    done: int
    total: int

    def describe(self) -> str:
        """Put into one line how far it has come.

        Returns:
            The line.
        """
        return f"{self.part}: {self.done} of {self.total} flights labeled"
