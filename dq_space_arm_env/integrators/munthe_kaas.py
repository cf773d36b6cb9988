"""Munthe-Kaas's method for the pose, for any explicit tableau.

The pose moves to q exp(Omega / 2), where Omega' = dexp^-1_Omega(omega) starts at zero and is integrated by
the tableau, with the twists omega of the stages (Munthe-Kaas, High order Runge-Kutta methods on manifolds,
1999). It stays a unit dual quaternion by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_vectors, vectors
from dq_space_arm_env.compiler.symbols import column, symbols, zeros
from dq_space_arm_env.integrators.field import PoseCoordinates
from dq_space_arm_env.integrators.tableaus import ButcherTableau

Scalar = Any
Matrix = Any

# dexp^-1 = 1 + ad / 2 + c ad^2 with c = sum_n SERIES[n] t^2n, t the dual angle: ad^3 = -t^2 ad turns the
# Bernoulli series into one of two commutators, whatever the order.
SERIES = (1 / 12, 1 / 720, 1 / 30240)


def slope(increment: Sequence[Scalar], twist: Sequence[Scalar], order: int) -> list[Scalar]:
    """dexp^-1_Omega(omega) as far as a method of an order needs it.

    As Omega is h omega to first order, n commutators are of size h^(n + 1): those up to order - 2 count.

    Args:
        increment: Omega, 6 expressions (rad, m).
        twist: omega, 6 expressions (rad/s, m/s).
        order: Order of the method, at most 9.

    Returns:
        Omega', 6 expressions (rad/s, m/s).
    """
    angular, linear = dual_vectors.real_part(increment), dual_vectors.dual_part(increment)
    square = vectors.dot(angular, angular)
    terms = SERIES[: max(1, (order - 2) // 2)]
    c: Scalar = terms[-1]
    by_square: Scalar = 0.0
    for coefficient in reversed(terms[:-1]):
        by_square = c + square * by_square
        c = coefficient + square * c
    once = dual_vectors.cross(increment, twist)
    twice = dual_vectors.cross(increment, once)
    # The square of the dual angle is |angular|^2 + 2 eps angular . linear.
    c_dual = 2.0 * by_square * vectors.dot(angular, linear)
    dual = (0.0, 0.0, 0.0, *(c_dual * entry for entry in twice[:3]))
    return [w + 0.5 * a + c * b + d for w, a, b, d in zip(twist, once, twice, dual, strict=True)]


def stage_slopes(
    pose: PoseCoordinates, tableau: ButcherTableau, twists: Sequence[Sequence[Scalar]], h: Scalar
) -> list[list[Scalar]]:
    """Omega' at the stages.

    Args:
        pose: Tells which directions the base can move in.
        tableau: The method.
        twists: Free entries of the base twist at each stage.
        h: Time step, s.

    Returns:
        6 expressions for each stage.
    """
    slopes: list[list[Scalar]] = []
    for row, free in zip(tableau.stages, twists, strict=True):
        twist = pose.full_twist(free)
        slopes.append(slope(combined(row, slopes, h), twist, tableau.order) if row else twist)
    return slopes


def combined(weights: Sequence[float], vectors_: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """H sum_i weights[i] vectors[i], without the vectors of no weight."""
    terms = [(w, vector) for w, vector in zip(weights, vectors_, strict=True) if w]
    sums = []
    for entries in zip(*(vector for _, vector in terms), strict=True):
        total: Scalar = 0.0
        for (weight, _), entry in zip(terms, entries, strict=True):
            total = total + weight * entry
        sums.append(h * total)
    return sums


def increment_jacobians(
    pose: PoseCoordinates, tableau: ButcherTableau, twists: Sequence[Sequence[Scalar]], h: Scalar
) -> tuple[list[Scalar], list[Matrix]]:
    """Omega after a step, and its derivatives by the twists of the stages.

    With D_i and E_i the derivatives of slope i by its Omega_i and its twist, G_i = h (b_i + sum_j a_ji G_j
    D_j) is the derivative of Omega by slope i, from the last stage to the first, and G_i E_i that by its
    twist.

    Args:
        pose: Tells which directions the base can move in.
        tableau: The method.
        twists: Free entries of the base twist at each stage.
        h: Time step, s.

    Returns:
        Omega, 6 expressions, and for each stage an SX matrix (n, n) over the base's n tangent directions.
    """
    slopes = stage_slopes(pose, tableau, twists, h)
    n, count = len(pose.directions), len(tableau.stages)
    by_slope = [h * weight * casadi.SX.eye(n) if weight else zeros(n, n) for weight in tableau.weights]
    by_twist: list[Matrix] = [zeros(n, n)] * count
    by_twist[0] = by_slope[0]
    for i in range(count - 1, 0, -1):
        if not by_slope[i].nnz():
            continue
        start = combined(tableau.stages[i], slopes[:i], h)
        by_start, by_omega = _slope_jacobians(pose, start, twists[i], tableau.order)
        by_twist[i] = casadi.sparsify(casadi.mtimes(by_slope[i], by_omega))
        behind = casadi.mtimes(by_slope[i], by_start)
        for j, weight in enumerate(tableau.stages[i]):
            if weight:
                by_slope[j] = by_slope[j] + (h * weight) * behind
    by_twist[0] = by_slope[0]
    return combined(tableau.weights, slopes, h), by_twist


def _slope_jacobians(
    pose: PoseCoordinates, start: Sequence[Scalar], free: Sequence[Scalar], order: int
) -> tuple[Matrix, Matrix]:
    """Derivatives of a slope by its increment and by its twist, over the free directions."""
    n = len(pose.directions)
    omega, twist = symbols("o", n), symbols("w", n)
    found = slope(pose.full_twist(omega), pose.full_twist(twist), order)
    kept = column(*(found[i] for i in pose.directions))
    jacobians = [casadi.jacobian(kept, column(*omega)), casadi.jacobian(kept, column(*twist))]
    values = casadi.densify(column(*(start[i] for i in pose.directions), *free))
    by_start, by_twist = casadi.substitute(jacobians, [column(*omega, *twist)], [values])
    return casadi.sparsify(by_start), casadi.sparsify(by_twist)
