"""Derivatives by central differences."""

from collections.abc import Callable
from typing import Any

import numpy as np

from experts.problems.shooting_problem import FloatArray

_EPSILON = float(np.finfo(np.float64).eps)
FIRST_STEP = _EPSILON ** (1.0 / 3.0)
"""Step of first derivatives: where truncation, of order h^2, is as large as rounding, of order 1 / h."""
SECOND_STEP = _EPSILON**0.25
"""Step of second derivatives, whose rounding is of order 1 / h^2."""


def jacobian(function: Callable[[FloatArray], Any], x: FloatArray) -> FloatArray:
    """Derivative of a function's results, shape (..., n), at x, shape (n,)."""
    steps = _steps(x, FIRST_STEP)
    columns = [
        (np.asarray(function(x + step), dtype=np.float64) - function(x - step)) / (2.0 * step[i])
        for i, step in enumerate(np.diag(steps))
    ]
    return np.stack(columns, axis=-1)


def hessian(function: Callable[[FloatArray], Any], x: FloatArray) -> FloatArray:
    """Symmetric second derivative of a scalar function, shape (n, n), at x, shape (n,)."""
    steps, n = _steps(x, SECOND_STEP), len(x)
    moves, result, center = np.diag(steps), np.zeros((n, n)), function(x)
    for i in range(n):
        result[i, i] = (function(x + moves[i]) - 2.0 * center + function(x - moves[i])) / steps[i] ** 2
        for j in range(i):
            both, apart = moves[i] + moves[j], moves[i] - moves[j]
            change = function(x + both) - function(x + apart) - function(x - apart) + function(x - both)
            result[i, j] = result[j, i] = change / (4.0 * steps[i] * steps[j])
    return result


def _steps(x: FloatArray, relative: float) -> FloatArray:
    """Steps for each entry, relative to entries above 1; exact in binary."""
    sizes: FloatArray = np.exp2(np.round(np.log2(relative * np.maximum(1.0, np.abs(x)))))
    return sizes
