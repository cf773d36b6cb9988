"""A case that may break the code, and the claim that tells how it ended.

A case is *handled* if its error is a number below its bound and within ten times what it once reached,
*refused* if the user is told so in a sentence, and *not claimed* beyond a documented limit of the method. All
else *failed*: a larger error, a number that is not finite, a missing refusal, an unexpected exception, a case
that was handled once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import cast

import numpy as np

from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, Status, claim
from scripts.benchmarks.stability import reached

Curve = tuple[tuple[float, float], ...]  # points (abscissa, error) for the picture


@dataclass(frozen=True)
class Handled:
    """A case that gave an error."""

    error: float
    note: str = ""
    curve: Curve = ()


@dataclass(frozen=True)
class Refused:
    """A case that the code refuses to compute, in this sentence."""

    sentence: str


@dataclass(frozen=True)
class NotClaimed:
    """A case beyond the claim of a method: the limit of the claim, and what happens beyond it."""

    sentence: str
    curve: Curve = ()


Outcome = Handled | Refused | NotClaimed


def largest(*errors: float) -> float:
    """The largest error; NaN if there is one, over which `max` would pass."""
    return float(np.max(errors))


def worst_point(curve: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The point of a curve with the largest error; the first with NaN, if there is one."""
    return curve[int(np.argmax([error for _, error in curve]))]


@dataclass(frozen=True)
class Case:
    """Something that may break."""

    group: str
    name: str  # what is extreme about it
    subject: str  # a formulation, an integrator, a precision, the expert, ...
    criterion: str  # of passing
    run: Callable[[Effort], Outcome]
    bound: float = math.inf  # infinite where a refusal must come
    unit: str = ""
    scene: str = ""  # whose kernels it takes, if a quick run may do without

    @property
    def title(self) -> str:
        """Name and subject, unique within a group."""
        return f"{self.name}, {self.subject}"

    def rows(self, effort: Effort) -> Iterator[Row]:
        """Try the case: its claim, whatever happens, and the finite points of its curve."""
        started = perf_counter()
        status, error, curve = None, None, cast(Curve, ())
        try:
            outcome = self.run(effort)
        except Exception as exception:  # a row is never missing
            status, note = Status.FAILED, f"{type(exception).__name__}: {exception}"
        else:
            if isinstance(outcome, Handled):
                error, note, curve = outcome.error, outcome.note, outcome.curve
            elif isinstance(outcome, Refused):
                status, note = Status.REFUSED, outcome.sentence
            else:
                status, note, curve = Status.NOT_CLAIMED, outcome.sentence, outcome.curve
        once = reached.largest(effort, self.group, self.name, self.subject)
        if status == Status.NOT_CLAIMED and math.isfinite(once):
            status, note = Status.FAILED, f"it was handled once. {note}"
        bound = min(self.bound, once)
        yield claim(
            self.group,
            self.name,
            self.subject,
            error,
            bound if math.isfinite(bound) else None if status else math.inf,
            unit="" if self.unit == "1" else self.unit,
            note=note,
            status=status,
            criterion=self.criterion,
            seconds=perf_counter() - started,
        )
        for x, y in curve:
            if math.isfinite(x) and math.isfinite(y):
                labels = {"table": f"curves of {self.group}", "name": self.name, "subject": self.subject}
                yield {**labels, "x": float(x), "y": float(y)}


def refusal(attempt: Callable[[], object], *, naming: str) -> Refused:
    """Try what must be refused with a ValueError whose sentence contains `naming`."""
    try:
        result = attempt()
    except ValueError as error:
        sentence = str(error)
        if naming not in sentence:
            raise AssertionError(f"the refusal does not name {naming!r}: {sentence}") from error
        return Refused(sentence)
    raise AssertionError(f"accepted, with the result {result!r}")
