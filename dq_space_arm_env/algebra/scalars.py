"""Elementary functions of one scalar, whatever the scalar is.

Each function looks at the type of its argument and calls `math` for a float, NumPy for an array and CasADi
for a symbol; inside numba, `numba_support` replaces it. There is no `if` on values anywhere in the algebra:
`select` takes its place. Both its branches are always evaluated, and CasADi differentiates both, so a branch
that is not taken must be given an argument at which it is finite (the "double where").
"""

import math
import sys
from typing import Any

import numpy as np

from dq_space_arm_env.algebra._types import Scalar

__all__ = ["arctan2", "cos", "maximum", "safe_sqrt", "select", "sin", "sqrt"]


def _casadi(value: Any, function: str) -> Any:
    """Return the module casadi, already imported by whoever made the symbol `value`.

    Raises:
        TypeError: `value` is no CasADi symbol, hence no scalar the algebra knows.
    """
    if type(value).__module__.partition(".")[0] != "casadi":
        raise TypeError(
            f"scalars.{function} got a {type(value).__name__}: {value!r}. "
            "A scalar must be a number, a NumPy array or a CasADi symbol."
        )
    return sys.modules["casadi"]


def sin(x: Scalar) -> Scalar:
    """Return the sine.

    Args:
        x: Angle, shape (), rad.

    Returns:
        Sine, shape (), dimensionless.
    """
    if isinstance(x, (float, int)):
        return math.sin(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.sin(x)
    return _casadi(x, "sin").sin(x)


def cos(x: Scalar) -> Scalar:
    """Return the cosine.

    Args:
        x: Angle, shape (), rad.

    Returns:
        Cosine, shape (), dimensionless.
    """
    if isinstance(x, (float, int)):
        return math.cos(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.cos(x)
    return _casadi(x, "cos").cos(x)


def sqrt(x: Scalar) -> Scalar:
    """Return the square root.

    Args:
        x: Nonnegative number, shape (), any unit.

    Returns:
        Square root, shape (), the square root of the unit of `x`.
    """
    if isinstance(x, (float, int)):
        return math.sqrt(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.sqrt(x)
    return _casadi(x, "sqrt").sqrt(x)


def safe_sqrt(x: Scalar) -> Scalar:
    """Return the square root with derivative 0, instead of infinity, at 0.

    It makes the gradient of a norm at the origin 0, one of its subgradients, where the chain rule gives NaN.

    Args:
        x: Number, shape (), any unit; a negative one counts as 0.

    Returns:
        Square root, shape (), the square root of the unit of `x`.
    """
    is_positive = x > 0.0
    return select(is_positive, sqrt(select(is_positive, x, 1.0)), 0.0)


def arctan2(y: Scalar, x: Scalar) -> Scalar:
    """Return the angle of the point (x, y) in the plane.

    Args:
        y: Ordinate, shape (), any unit.
        x: Abscissa, shape (), the unit of `y`.

    Returns:
        Angle in [-pi, pi], shape (), rad.
    """
    if isinstance(y, (float, int)) and isinstance(x, (float, int)):
        return math.atan2(y, x)
    if isinstance(y, (float, int, np.ndarray, np.generic)) and isinstance(
        x, (float, int, np.ndarray, np.generic)
    ):
        return np.arctan2(y, x)
    symbol = x if isinstance(y, (float, int)) else y
    return _casadi(symbol, "arctan2").atan2(y, x)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """Return the larger of two numbers.

    Args:
        a: Number, shape (), any unit.
        b: Number, shape (), the unit of `a`.

    Returns:
        The larger one, shape (), the unit of `a`.
    """
    return select(a < b, b, a)


def select(condition: Scalar, if_true: Scalar, if_false: Scalar) -> Scalar:
    """Return one of two values, chosen by a condition; both were evaluated.

    Args:
        condition: Result of a comparison, shape (), dimensionless.
        if_true: Value where the condition holds, shape (), any unit.
        if_false: Value where it does not, shape (), the unit of `if_true`.

    Returns:
        The chosen value, shape (), the unit of `if_true`.
    """
    if isinstance(condition, (bool, np.bool_)):
        return if_true if condition else if_false
    if isinstance(condition, np.ndarray):
        return np.where(condition, if_true, if_false)
    return _casadi(condition, "select").if_else(condition, if_true, if_false)
