"""A case that may break the code, and the row that says what became of it.

A case ends in one of four ways. *Handled*: its error is a number and below its bound. *Refused*: the user is
told so, in a sentence that the row repeats. *Not claimed*: the method's limit of stability is exceeded, as
its documentation says. Everything else is *failed*: an error above the bound, a number that is not finite, a
refusal that does not come, an exception that nobody expected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from time import perf_counter


class Status(StrEnum):
    """How a case ended."""

    HANDLED = "handled"
    REFUSED = "refused"
    NOT_CLAIMED = "not claimed"
    FAILED = "failed"


@dataclass(frozen=True)
class Effort:
    """How much to try.

    Attributes:
        name: Its name.
        mass_ratios: Ratios of base to arm mass.
        samples: Random states of a case.
        steps: Time steps of the cases with many.
        stiffness: Springs of the stiff joint, N m/rad.
        horizon: Largest number of stages that the expert solves.
        slow: Whether to run cases that take more than a few seconds.
    """

    name: str
    mass_ratios: tuple[float, ...]
    samples: int
    steps: int
    stiffness: tuple[float, ...]
    horizon: int
    slow: bool


QUICK = Effort("quick", (1e-6, 1e-3, 1.0, 1e3, 1e6), 3, 100_000, (1e2, 1e5, 1e8), 2_000, False)
FULL = Effort(
    "full",
    tuple(10.0**k for k in range(-6, 7)),
    8,
    10_000_000,
    tuple(10.0**k for k in range(2, 9)),
    20_000,
    True,
)


@dataclass(frozen=True)
class Handled:
    """A case that gave a number.

    Attributes:
        error: The number that the case's bound is for.
        note: What else is to be known.
        curve: Points (abscissa, error) for the picture.
    """

    error: float
    note: str = ""
    curve: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Refused:
    """A case that the code refuses to compute.

    Attributes:
        sentence: What the user is told.
    """

    sentence: str


@dataclass(frozen=True)
class NotClaimed:
    """A case beyond what a method claims to handle.

    Attributes:
        sentence: The limit of the claim, and what happens beyond it.
        curve: Points (abscissa, error) for the picture.
    """

    sentence: str
    curve: tuple[tuple[float, float], ...] = ()


Outcome = Handled | Refused | NotClaimed


@dataclass(frozen=True)
class Case:
    """Something that may break.

    Attributes:
        group: The group it belongs to.
        name: What is extreme about it.
        subject: What it is applied to: a formulation, an integrator, a precision, the expert, ...
        criterion: When it passes, in words.
        run: Tries it.
        bound: Largest error that passes; infinite where a refusal is what should come.
        unit: Unit of the error.
        slow: Whether it takes more than a few seconds.
    """

    group: str
    name: str
    subject: str
    criterion: str
    run: Callable[[Effort], Outcome]
    bound: float = math.inf
    unit: str = ""
    slow: bool = False

    @property
    def title(self) -> str:
        """Name and subject, which together are unique within a group."""
        return f"{self.name}, {self.subject}"


@dataclass(frozen=True)
class Row:
    """What became of a case.

    Attributes:
        group: Group of the case.
        name: What is extreme about it.
        subject: What it is applied to.
        criterion: When it passes, in words.
        bound: Largest error that passes; None where a refusal should come.
        unit: Unit of error and bound.
        status: How it ended.
        error: Its error; None unless it gave a finite number.
        sentence: What the user is told, or a note.
        seconds: Time it took, compilation included, s.
        curve: Points (abscissa, error) for the picture.
    """

    group: str
    name: str
    subject: str
    criterion: str
    bound: float | None
    unit: str
    status: Status
    error: float | None
    sentence: str
    seconds: float
    curve: tuple[tuple[float, float], ...] = ()


def run_case(case: Case, effort: Effort) -> Row:
    """Try a case.

    Args:
        case: The case.
        effort: How much to try.

    Returns:
        Its row, whatever happens.
    """
    started = perf_counter()
    try:
        status, error, sentence, curve = _judge(case, case.run(effort))
    except Exception as exception:  # a row is never missing
        status, error, curve = Status.FAILED, None, ()
        sentence = f"{type(exception).__name__}: {exception}"
    bound = case.bound if math.isfinite(case.bound) else None
    seconds = perf_counter() - started
    return Row(
        case.group,
        case.name,
        case.subject,
        case.criterion,
        bound,
        case.unit,
        status,
        error,
        sentence,
        seconds,
        curve,
    )


def _judge(case: Case, outcome: Outcome) -> tuple[Status, float | None, str, tuple[tuple[float, float], ...]]:
    if isinstance(outcome, Refused):
        return Status.REFUSED, None, outcome.sentence, ()
    if isinstance(outcome, NotClaimed):
        return Status.NOT_CLAIMED, None, outcome.sentence, _finite(outcome.curve)
    curve = _finite(outcome.curve)
    if not math.isfinite(outcome.error):
        return Status.FAILED, None, f"the error is not finite. {outcome.note}".strip(), curve
    if outcome.error > case.bound:
        sentence = f"the error is above {case.bound:.3g} {case.unit}".strip()
        return Status.FAILED, outcome.error, f"{sentence}. {outcome.note}".strip(), curve
    return Status.HANDLED, outcome.error, outcome.note, curve


def _finite(curve: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in curve if math.isfinite(x) and math.isfinite(y))


def refusal(attempt: Callable[[], object], *, naming: str) -> Refused:
    """Try what should be refused.

    Args:
        attempt: It.
        naming: What the sentence must name for the user to find the mistake.

    Returns:
        The sentence.

    Raises:
        AssertionError: If it is accepted, or the sentence does not name what is wrong.
    """
    try:
        result = attempt()
    except ValueError as error:
        sentence = str(error)
        if naming not in sentence:
            raise AssertionError(f"the refusal does not name {naming!r}: {sentence}") from error
        return Refused(sentence)
    raise AssertionError(f"accepted, with the result {result!r}")
