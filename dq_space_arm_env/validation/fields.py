"""Kinds of numbers in a scene: finite, positive, limits, vectors, weights.

Unlike pydantic's own, they refuse the text "3" and `true`; values are stored as floats and tuples, which
keeps scenes hashable.
"""

import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from dq_space_arm_env.validation.problems import problem


def read_numbers(value: Any, count: int | None = None) -> tuple[float, ...]:
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
    return tuple(numbers)


def _real(value: Any) -> float:
    """Convert a number to float, anything else to NaN."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return math.nan
    try:
        # Adding zero turns -0.0 into 0.0: equal scenes must have equal content hashes.
        return float(value) + 0.0
    except OverflowError:
        return math.nan


def _number(good: Callable[[float], bool], wanted: str) -> BeforeValidator:
    """Accept a number with a property."""

    def read(value: Any) -> float:
        number = _real(value)
        if not good(number):
            raise problem(f"must be {wanted}")
        return number

    return BeforeValidator(read)


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise problem("must be a whole number, 1 or greater")
    return int(value)


def _vector(count: int | None) -> Callable[[Any], tuple[float, ...]]:
    return lambda value: read_numbers(value, count)


def _per_component(
    count: int, good: Callable[[float], bool], wanted: str
) -> Callable[[Any], tuple[float, ...]]:
    """Read one number for all components, or one for each."""

    def read(value: Any) -> tuple[float, ...]:
        if isinstance(value, np.ndarray):
            value = value.tolist()
        items: Sequence[Any] = value if isinstance(value, list | tuple) else (value,) * count
        numbers = tuple(_real(item) for item in items)
        if len(numbers) != count or not all(good(number) for number in numbers):
            raise problem(f"must be one number or {count} numbers, each {wanted}")
        return numbers

    return read


_Rule = tuple[Callable[[float], bool], str]
_STATE_WEIGHT: _Rule = (lambda number: 0 <= number < math.inf, "finite and 0 or greater")
_CONTROL_WEIGHT: _Rule = (lambda number: 0 < number < math.inf, "finite and greater than 0")

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Eight = tuple[float, float, float, float, float, float, float, float]

Finite = Annotated[float, _number(math.isfinite, "a finite number")]
Positive = Annotated[float, _number(lambda n: 0 < n < math.inf, "a finite number greater than 0")]
NonNegative = Annotated[float, _number(lambda n: 0 <= n < math.inf, "a finite number, 0 or greater")]
Fraction = Annotated[float, _number(lambda n: 0 <= n < 1, "a fraction: 0 or greater, and less than 1")]
Limit = Annotated[float, _number(lambda n: n > 0, "a number greater than 0, or .inf for no limit")]
Count = Annotated[int, BeforeValidator(_count)]
Vector3 = Annotated[Three, BeforeValidator(_vector(3))]
Vector6 = Annotated[Six, BeforeValidator(_vector(6))]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_vector(None))]
Limits3 = Annotated[
    Three,
    BeforeValidator(_per_component(3, lambda number: number > 0, "greater than 0, or .inf for no limit")),
]
StateWeights8 = Annotated[Eight, BeforeValidator(_per_component(8, *_STATE_WEIGHT))]
StateWeights6 = Annotated[Six, BeforeValidator(_per_component(6, *_STATE_WEIGHT))]
ControlWeights3 = Annotated[Three, BeforeValidator(_per_component(3, *_CONTROL_WEIGHT))]
