"""The kinds of numbers a scene is made of: finite, positive, limits, vectors, weights.

pydantic would read the text "3" or `true` as a number; here only numbers are numbers, and everything is
stored as floats and tuples so that a scene is hashable.
"""

import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from dq_space_arm_env.scene._problems import problem


def read_numbers(value: Any, count: int | None = None) -> tuple[float, ...]:
    """Read a list of finite numbers.

    Args:
        value: List, tuple or one-dimensional array of numbers.
        count: How many there must be; any number of them when None.

    Returns:
        The numbers, shape (count,).

    Raises:
        PydanticCustomError: If it is not that.
    """
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
    """Value as a float, NaN for what is not a number."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return math.nan
    try:
        # Adding zero turns -0.0 into 0.0: equal scenes must have equal content hashes.
        return float(value) + 0.0
    except OverflowError:
        return math.nan


def _finite(value: Any) -> float:
    number = _real(value)
    if not math.isfinite(number):
        raise problem("must be a finite number")
    return number


def _positive(value: Any) -> float:
    number = _real(value)
    if not (math.isfinite(number) and number > 0):
        raise problem("must be a finite number greater than 0")
    return number


def _non_negative(value: Any) -> float:
    number = _real(value)
    if not (math.isfinite(number) and number >= 0):
        raise problem("must be a finite number, 0 or greater")
    return number


def _fraction(value: Any) -> float:
    number = _real(value)
    if not 0 <= number < 1:
        raise problem("must be a fraction: 0 or greater, and less than 1")
    return number


def _limit(value: Any) -> float:
    number = _real(value)
    if not number > 0:
        raise problem("must be a number greater than 0, or .inf for no limit")
    return number


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


def _is_state_weight(number: float) -> bool:
    return math.isfinite(number) and number >= 0


def _is_control_weight(number: float) -> bool:
    return math.isfinite(number) and number > 0


_STATE_WEIGHT = "finite and 0 or greater"
_CONTROL_WEIGHT = "finite and greater than 0"

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Eight = tuple[float, float, float, float, float, float, float, float]

Finite = Annotated[float, BeforeValidator(_finite)]
Positive = Annotated[float, BeforeValidator(_positive)]
NonNegative = Annotated[float, BeforeValidator(_non_negative)]
Fraction = Annotated[float, BeforeValidator(_fraction)]
Limit = Annotated[float, BeforeValidator(_limit)]
Count = Annotated[int, BeforeValidator(_count)]
Vector3 = Annotated[Three, BeforeValidator(_vector(3))]
Vector6 = Annotated[Six, BeforeValidator(_vector(6))]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_vector(None))]
Limits3 = Annotated[
    Three,
    BeforeValidator(_per_component(3, lambda number: number > 0, "greater than 0, or .inf for no limit")),
]
StateWeights8 = Annotated[Eight, BeforeValidator(_per_component(8, _is_state_weight, _STATE_WEIGHT))]
StateWeights6 = Annotated[Six, BeforeValidator(_per_component(6, _is_state_weight, _STATE_WEIGHT))]
ControlWeights3 = Annotated[Three, BeforeValidator(_per_component(3, _is_control_weight, _CONTROL_WEIGHT))]
