"""The paper's quadratic cost (section V): pose of the tip, velocity of the base, and effort.

The stage cost of step k is (q_{G/I} - q_{D/I})' W_q (q_{G/I} - q_{D/I}) + (omega - omega_D)' W_omega (omega -
omega_D) + u' R u, without a factor dt; the terminal cost has the first two terms with weights of their own. q
and -q are one pose but not one cost: the sign of q_{G/I} is fixed at the start, q_r . q_{D,r} >= 0, and
carried along by continuity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Scalar = Any


def weighted_square(
    values: Sequence[Scalar], references: Sequence[Scalar], weights: Sequence[float]
) -> Scalar:
    """Sum of w (value - reference)^2: each of the terms of the cost.

    Args:
        values: n numbers.
        references: n numbers in the same units.
        weights: n weights, 1/unit^2.

    Returns:
        The sum, dimensionless.
    """
    # Squares that share a weight are added first: fewer products, and stage and terminal cost share the sums.
    sums: dict[float, Scalar] = {}
    for value, reference, weight in zip(values, references, weights, strict=True):
        error = value - reference
        sums[weight] = sums.get(weight, 0.0) + error * error
    total: Scalar = 0.0
    for weight, squares in sums.items():
        total = total + weight * squares
    return total
