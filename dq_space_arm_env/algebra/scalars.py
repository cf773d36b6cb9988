"""Elementary functions of one scalar, whatever the scalar is.

Each function calls `math` for a float, NumPy for an array and CasADi for a symbol. There is no `if` on values
anywhere in the algebra: `select` takes its place. Both its branches are always evaluated, and CasADi
differentiates both, so the branch not taken must get an argument at which it is finite (the "double where").
"""

import math
import sys
from typing import Any

import numpy as np

from dq_space_arm_env.algebra._types import Scalar

__all__ = ["arctan2", "cos", "maximum", "safe_sqrt", "select", "sin", "sqrt", "tanh"]


def _symbolic(value: Any, name: str, function: str, *arguments: Any) -> Any:
    """Apply a function of CasADi, imported already where the symbol `value` was made.

    The result has the type of `value`, whose operators may be faster than CasADi's, see `symbolic.Symbol`.

    Raises:
        TypeError: `value` is no CasADi symbol, hence no scalar the algebra knows.
    """
    kind = type(value)
    if all(base.__module__.partition(".")[0] != "casadi" for base in kind.__mro__):
        raise TypeError(
            f"scalars.{name} got a {kind.__name__}: {value!r}. "
            "A scalar must be a number, a NumPy array or a CasADi symbol."
        )
    result = getattr(sys.modules["casadi"], function)(*arguments)
    if issubclass(kind, type(result)):
        result.__class__ = kind
    return result


def sin(x: Scalar) -> Scalar:
    """Return the sine."""
    if isinstance(x, (float, int)):
        return math.sin(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.sin(x)
    return _symbolic(x, "sin", "sin", x)


def cos(x: Scalar) -> Scalar:
    """Return the cosine."""
    if isinstance(x, (float, int)):
        return math.cos(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.cos(x)
    return _symbolic(x, "cos", "cos", x)


def tanh(x: Scalar) -> Scalar:
    """Return the hyperbolic tangent."""
    if isinstance(x, (float, int)):
        return math.tanh(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.tanh(x)
    return _symbolic(x, "tanh", "tanh", x)


def sqrt(x: Scalar) -> Scalar:
    """Return the square root."""
    if isinstance(x, (float, int)):
        return math.sqrt(x)
    if isinstance(x, (np.ndarray, np.generic)):
        return np.sqrt(x)
    return _symbolic(x, "sqrt", "sqrt", x)


def safe_sqrt(x: Scalar) -> Scalar:
    """Return the square root with derivative 0, instead of infinity, at 0.

    It makes the gradient of a norm at the origin 0, one of its subgradients, where the chain rule gives NaN.

    A negative number counts as 0.
    """
    is_positive = x > 0.0
    return select(is_positive, sqrt(select(is_positive, x, 1.0)), 0.0)


def arctan2(y: Scalar, x: Scalar) -> Scalar:
    """Return the angle of the point (x, y) in the plane."""
    if isinstance(y, (float, int)) and isinstance(x, (float, int)):
        return math.atan2(y, x)
    if isinstance(y, (float, int, np.ndarray, np.generic)) and isinstance(
        x, (float, int, np.ndarray, np.generic)
    ):
        return np.arctan2(y, x)
    symbol = x if isinstance(y, (float, int)) else y
    return _symbolic(symbol, "arctan2", "atan2", y, x)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """Return the larger of two numbers."""
    return select(a < b, b, a)


def select(condition: Scalar, if_true: Scalar, if_false: Scalar) -> Scalar:
    """Return one of two values, chosen by a condition; both were evaluated."""
    if isinstance(condition, (bool, np.bool_)):
        return if_true if condition else if_false
    if isinstance(condition, np.ndarray):
        return np.where(condition, if_true, if_false)
    return _symbolic(condition, "select", "if_else", condition, if_true, if_false)
