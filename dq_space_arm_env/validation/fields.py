"""Kinds of numbers in a scene: finite, positive, limits, vectors, weights.

Unlike pydantic's own, they refuse the text "3" and `true`; values are stored as floats and tuples, which
keeps scenes hashable. Each kind of quantity has a range that the arithmetic carries.
"""

import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, StrictStr

from dq_space_arm_env.common.shown_text import is_control
from dq_space_arm_env.validation.problems import problem


class Range(NamedTuple):
    """Magnitudes that a quantity may have, if it is not zero or infinite."""

    least: float
    most: float

    def check(self, *numbers: float) -> None:
        """Refuse numbers outside."""
        for number in numbers:
            if number and math.isfinite(number) and not self.least <= abs(number) <= self.most:
                most = f"at most {self.most:g}" if abs(number) > self.most else f"at least {self.least:g}"
                raise problem(f"must be {most} in magnitude, or the numbers computed with it keep no digits")


# Double precision has 16 digits, and a square or a product of three numbers must stay far from overflow, in
# single precision (3e38) too. The stability benchmarks go to 1e-7 and 1e8 of masses, and to springs of 1e9.
ANY = Range(1e-18, 1e18)
UP_TO = Range(0.0, ANY.most)
LENGTHS = Range(0.0, 1e9)  # m: rounded to 1e-7 m there
SIZES = Range(1e-6, 1e6)  # m, of shapes in pictures
ANGLES = Range(0.0, 1e6)  # rad: up to where the code reduces angles with full precision
RATES = Range(0.0, 1e9)  # rad/s, m/s
MASSES = Range(1e-12, 1e12)  # kg: from a speck of dust to a mountain
INERTIAS = Range(1e-18, 1e18)  # kg m^2
GEARS = Range(1e-6, 1e6)  # 1, rad/m
FORCES = Range(1e-12, 1e12)  # N, N m, of limits
LOADS = Range(0.0, FORCES.most)
STATE_WEIGHTS = Range(0.0, 1e15)
CONTROL_WEIGHTS = Range(1e-24, 1e24)
TIME_STEPS = Range(1e-12, 1e6)  # s
MOST_STEPS = 10_000_000
"""Largest number of steps of an episode: the plan of such a maneuver fills the memory of a machine.

Below 2^24, up to which single precision counts the steps of an episode exactly.
"""
MOST_WAYPOINTS = 100_000
_MOST_COUNT = 10**12
_LONGEST_NAME = 200  # characters
_LONGEST_DELAY = 20  # steps: each command on its way is a state


def read_numbers(value: Any, count: int | None = None, span: Range | None = None) -> tuple[float, ...]:
    """Read a list of finite numbers."""
    wanted = f"must be {'a list of' if count is None else count} finite numbers"
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        raise problem(wanted)
    if count is not None and len(value) != count:
        raise problem(f"{wanted}; it has {len(value)}")
    numbers = [_real(item) for item in value]
    if not all(math.isfinite(number) for number in numbers):
        raise problem(wanted)
    if span is not None:
        span.check(*numbers)
    return tuple(numbers)


def numbers_of(count: int) -> str:
    """A count of numbers in words: "1 number", "2 numbers"."""
    return "1 number" if count == 1 else f"{count} numbers"


def _real(value: Any) -> float:
    """Convert a number to float, anything else to NaN."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return math.nan
    try:
        # Adding zero turns -0.0 into 0.0: equal scenes must have equal content hashes.
        return float(value) + 0.0
    except OverflowError:
        return math.nan


def _number(
    good: Callable[[float], bool], wanted: str, span: Range = ANY, *, word: str | None = None
) -> BeforeValidator:
    """Accept a number with a property, or a word."""
    allowed = wanted if word is None else f"{wanted}, or {word}"

    def read(value: Any) -> float | str:
        if isinstance(value, str) and value == word:
            return value
        number = _real(value)
        if not good(number):
            raise problem(f"must be {allowed}")
        span.check(number)
        return number

    return BeforeValidator(read)


def positive(span: Range, *, word: str | None = None) -> BeforeValidator:
    """Accept a positive number in a range, or a word."""
    return _number(lambda n: 0 < n < math.inf, "a finite number greater than 0", span, word=word)


def non_negative(span: Range) -> BeforeValidator:
    """Accept zero, or a positive number in a range."""
    return _number(lambda n: 0 <= n < math.inf, "a finite number, 0 or greater", span)


def count_up_to(most: int) -> BeforeValidator:
    """Accept a whole number from 1 to a largest one, also written as 8e3."""

    def read(value: Any) -> int:
        value = int(value) if isinstance(value, float) and value.is_integer() else value
        if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
            raise problem("must be a whole number, 1 or greater")
        number = int(value)
        if number > most:
            raise problem(f"must be a whole number of at most {most:,}")
        return number

    return BeforeValidator(read)


def _vector(count: int | None, span: Range | None = None) -> BeforeValidator:
    return BeforeValidator(lambda value: read_numbers(value, count, span))


def _per_component(
    count: int | None, good: Callable[[float], bool], wanted: str, span: Range
) -> BeforeValidator:
    """Read one number for all components, or one for each; a count of None leaves open how many there are."""

    def read(value: Any) -> tuple[float, ...]:
        if isinstance(value, np.ndarray):
            value = value.tolist()
        items: Sequence[Any] = value if isinstance(value, list | tuple) else (value,) * (count or 1)
        numbers = tuple(_real(item) for item in items)
        if len(numbers) != (count or max(len(numbers), 1)) or not all(good(number) for number in numbers):
            raise problem(f"must be one number or {count or 'several'} numbers, each {wanted}")
        span.check(*numbers)
        return numbers

    return BeforeValidator(read)


def _name(text: str) -> str:
    """Refuse what cannot stand in a table or in XML."""
    if any(is_control(character) or character in "\n\t" for character in text):
        raise problem("must have no control characters: it stands in tables and in other formats")
    if len(text) > _LONGEST_NAME:
        raise problem(f"must have at most {_LONGEST_NAME} characters")
    return text


def _delay(value: Any) -> int:
    """Accept a number of steps whose commands a state may hold."""
    steps = -1 if isinstance(value, bool) or not isinstance(value, Integral) else int(value)
    if not 0 <= steps <= _LONGEST_DELAY:
        raise problem(f"must be a whole number from 0 to {_LONGEST_DELAY}")
    return steps


def _flag(value: Any) -> bool:
    """Accept true or false, as Python and NumPy have them."""
    if not isinstance(value, bool | np.bool_):
        raise problem("must be true or false")
    return bool(value)


_Rule = tuple[Callable[[float], bool], str, Range]
_STATE_WEIGHT: _Rule = (lambda number: 0 <= number < math.inf, "finite and 0 or greater", STATE_WEIGHTS)
_CONTROL_WEIGHT: _Rule = (lambda number: 0 < number < math.inf, "finite and greater than 0", CONTROL_WEIGHTS)
_BOUND: _Rule = (lambda number: not math.isnan(number), "finite, or infinite for no bound", ANGLES)
_LIMIT: _Rule = (lambda number: number > 0, "greater than 0, or .inf for no limit", FORCES)

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Eight = tuple[float, float, float, float, float, float, float, float]

Name = Annotated[StrictStr, Field(min_length=1), AfterValidator(_name)]
Flag = Annotated[bool, BeforeValidator(_flag)]
Finite = Annotated[float, _number(math.isfinite, "a finite number", UP_TO)]
Positive = Annotated[float, positive(ANY)]
PositiveOrOff = Annotated[float | Literal["off"], positive(ANY, word="off")]
PositiveOrAuto = Annotated[float | Literal["auto"], positive(ANY, word="auto")]
FiniteOrAuto = Annotated[
    float | Literal["auto"], _number(math.isfinite, "a finite number", UP_TO, word="auto")
]
NonNegative = Annotated[float, non_negative(UP_TO)]
Fraction = Annotated[float, _number(lambda n: 0 <= n < 1, "a fraction: 0 or greater, and less than 1", UP_TO)]
Share = Annotated[float, _number(lambda n: 0 <= n <= 1, "a number from 0 to 1", UP_TO)]
Count = Annotated[int, count_up_to(_MOST_COUNT)]
Vector3 = Annotated[Three, _vector(3)]

Mass = Annotated[float, positive(MASSES)]
MomentOfInertia = Annotated[float, non_negative(INERTIAS)]
Gear = Annotated[float, _number(lambda n: n != 0 and math.isfinite(n), "a finite number other than 0", GEARS)]
Speed = Annotated[float, positive(Range(1e-9, RATES.most))]
Position = Annotated[Three, _vector(3, LENGTHS)]
Twist = Annotated[Six, _vector(6, RATES)]
Load = Annotated[Three, _vector(3, LOADS)]
Loads = Annotated[tuple[float, ...], _vector(None, LOADS)]
Angle = Annotated[float, _number(math.isfinite, "a finite number", ANGLES)]
Angles = Annotated[tuple[float, ...], _vector(None, ANGLES)]
Rates = Annotated[tuple[float, ...], _vector(None, RATES)]
Rates3 = Annotated[Three, _vector(3, RATES)]
Size = Annotated[float, positive(SIZES)]
LengthSpread = Annotated[float, non_negative(LENGTHS)]
AngleSpread = Annotated[float, non_negative(ANGLES)]
RateSpread = Annotated[float, non_negative(RATES)]
Limit = Annotated[float, _number(lambda n: n > 0, "a number greater than 0, or .inf for no limit", FORCES)]
Limits3 = Annotated[Three, _per_component(3, *_LIMIT)]
Bounds = Annotated[tuple[float, ...], _per_component(None, *_BOUND)]
Limits = Annotated[tuple[float, ...], _per_component(None, *_LIMIT)]
StateWeights8 = Annotated[Eight, _per_component(8, *_STATE_WEIGHT)]
StateWeights6 = Annotated[Six, _per_component(6, *_STATE_WEIGHT)]
ControlWeight = Annotated[float, positive(CONTROL_WEIGHTS)]
ControlWeights3 = Annotated[Three, _per_component(3, *_CONTROL_WEIGHT)]
TimeStep = Annotated[float, positive(TIME_STEPS)]
Steps = Annotated[int, count_up_to(MOST_STEPS)]
Delay = Annotated[int, BeforeValidator(_delay)]
