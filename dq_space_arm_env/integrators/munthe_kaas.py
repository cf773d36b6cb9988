"""The Runge-Kutta-Munthe-Kaas method for the pose, for any explicit tableau.

The pose moves to q exp(Omega / 2), where Omega' = dexp^-1_Omega(omega) starts at zero and is integrated by
the tableau, with the twists omega of the stages (Munthe-Kaas, High order Runge-Kutta methods on manifolds,
1999). It stays a unit dual quaternion by construction.

Second derivatives, of the classical method only: each stage turns its start P_s = a_s h w_{s-1} and its twist
o_s into a slope w_s; the pose moves with Omega = h sum b_s w_s. Jacobians S_st = dw_s/do_t are propagated
forward and multipliers eta_s of w_s backward, so only the curvature of each link is derived, over at most 12
numbers instead of the 24 of all twists; that of one stage serves for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_vectors, vectors
from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.dynamics.vector_field import PoseCoordinates
from dq_space_arm_env.integrators.pose_update import pose_curvature
from dq_space_arm_env.integrators.tableaus import RK4_OFFSETS, RK4_WEIGHTS, ButcherTableau

Scalar = Any
Matrix = Any

# dexp^-1 = 1 + ad / 2 + c ad^2 with c = sum_n SERIES[n] t^2n, t the dual angle: ad^3 = -t^2 ad turns the
# Bernoulli series into one of two commutators, whatever the order.
SERIES = (1 / 12, 1 / 720, 1 / 30240)


def slope(increment: Sequence[Scalar], twist: Sequence[Scalar], order: int) -> list[Scalar]:
    """Omega' = dexp^-1_Omega(omega), truncated for a method of the given order, at most 9.

    As Omega is h omega to first order, n commutators are of size h^(n + 1): those up to order - 2 count.
    """
    angular, linear = dual_vectors.real_part(increment), dual_vectors.dual_part(increment)
    square = vectors.dot(angular, angular)
    terms = SERIES[: max(1, (order - 2) // 2)]
    c: Scalar = terms[-1]
    by_square: Scalar = 0.0
    for coefficient in reversed(terms[:-1]):
        by_square = c + square * by_square
        c = coefficient + square * c
    # omega + ad omega / 2 + c ad^2 omega, with the dual number c.
    once = dual_vectors.cross(increment, twist)
    twice = dual_vectors.cross(increment, once)
    # The square of the dual angle is |angular|^2 + 2 eps angular . linear.
    c_dual = 2.0 * by_square * vectors.dot(angular, linear)
    dual = (0.0, 0.0, 0.0, *(c_dual * entry for entry in twice[:3]))
    return [w + 0.5 * a + c * b + d for w, a, b, d in zip(twist, once, twice, dual, strict=True)]


def stage_slopes(
    pose: PoseCoordinates, tableau: ButcherTableau, twists: Sequence[Sequence[Scalar]], h: Scalar
) -> list[list[Scalar]]:
    """Omega' at the stages, 6 entries each, from the free entries of the base twist at each."""
    slopes: list[list[Scalar]] = []
    for row, free in zip(tableau.stages, twists, strict=True):
        twist = pose.full_twist(free)
        slopes.append(slope(combined(row, slopes, h), twist, tableau.order) if row else twist)
    return slopes


def combined(weights: Sequence[float], vectors_: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """Sum h weights[i] vectors[i], skipping zero weights."""
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
    """Omega after a step, and its derivatives by the stages' twists, SX (n, n) over the base's directions.

    With D_i and E_i the derivatives of slope i by its Omega_i and its twist, G_i = h (b_i + sum_j a_ji G_j
    D_j) is the derivative of Omega by slope i, computed from the last stage to the first, and G_i E_i that by
    its twist.
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


def stage_twists(
    pose: PoseCoordinates, y: Sequence[Scalar], stages: Sequence[Sequence[Scalar]], h: Scalar
) -> list[list[Scalar]]:
    """Free entries of the base twist at the four stages of the classical method."""
    twists = [[y[i] for i in pose.twist_indices]]
    for offset, k in zip(RK4_OFFSETS[1:], stages, strict=False):
        twists.append([y[i] + offset * h * k[i] for i in pose.twist_indices])
    return twists


@dataclass(frozen=True, eq=False)
class TwistCurvature:
    """Derivatives of multiplier . (new pose), over the base's n tangent directions; stages count from 1."""

    by_twist: Mapping[int, Matrix]  # gradient by the twist of each stage, SX (n, 1)
    twice: Mapping[tuple[int, int], Matrix]  # Hessian blocks of twists s >= t, SX (n, n), rows of s
    by_pose: Mapping[int, Matrix]  # by the old pose (rows) and the twist of a stage, SX (n, n)


@dataclass(frozen=True, eq=False)
class _Stage:
    """A stage's slope w at its start P and twist o."""

    start: Matrix  # P, (n, 1)
    twist: Matrix  # o, (n, 1)
    slope: Matrix  # w, (n, 1)
    by_start: Matrix  # dw/dP, (n, n)
    by_twist: Matrix  # dw/do, (n, n)


class _StageSlope:
    """Slope of a stage and its derivatives, derived once over symbols."""

    def __init__(self, pose: PoseCoordinates) -> None:
        n = len(pose.directions)
        self._start, self._twist, self._multiplier = (column(*symbols(name, n)) for name in ("P", "o", "eta"))
        full = [pose.full_twist(casadi.vertsplit(entries)) for entries in (self._start, self._twist)]
        found = slope(full[0], full[1], 4)
        self._slope = column(*(found[i] for i in pose.directions))
        self._jacobians = [casadi.jacobian(self._slope, entries) for entries in (self._start, self._twist)]
        gradient = casadi.mtimes(self._jacobians[0].T, self._multiplier)
        self._curvature = [casadi.jacobian(gradient, entries) for entries in (self._start, self._twist)]

    def at(self, start: Matrix, twist: Matrix) -> _Stage:
        """A stage with its first derivatives."""
        names = casadi.vertcat(self._start, self._twist)
        values = casadi.densify(casadi.vertcat(start, twist))
        return _Stage(start, twist, *casadi.substitute([self._slope, *self._jacobians], [names], [values]))

    def curvature(self, stage: _Stage, multiplier: Matrix) -> tuple[Matrix, Matrix]:
        """Second derivatives of multiplier . w: by start twice, and by start (rows) and twist."""
        names = casadi.vertcat(self._start, self._twist, self._multiplier)
        values = casadi.densify(casadi.vertcat(stage.start, stage.twist, multiplier))
        by_start, by_both = casadi.substitute(self._curvature, [names], [values])
        return by_start, by_both


def twist_curvature(
    pose: PoseCoordinates, twists: Sequence[Matrix], h: Scalar, multiplier: Sequence[Scalar]
) -> TwistCurvature:
    """Derivatives of multiplier . (new pose) by the free entries of the stages' twists, SX (n, 1) each."""
    slopes, n = _StageSlope(pose), len(pose.directions)
    numbers = range(1, len(twists) + 1)
    offsets, weights = (dict(zip(numbers, values, strict=True)) for values in (RK4_OFFSETS, RK4_WEIGHTS))
    stages: dict[int, _Stage] = {}
    # by[s, t] = S_st; by_start[s, t] = dP_s/do_t.
    by: dict[tuple[int, int], Matrix] = {}
    by_start: dict[tuple[int, int], Matrix] = {}
    start = zeros(n, 1)
    for s, twist in zip(numbers, twists, strict=True):
        if s > 1:
            start = offsets[s] * h * stages[s - 1].slope
        stages[s] = slopes.at(start, twist)
        by[s, s] = stages[s].by_twist
        for t in range(1, s):
            by_start[s, t] = offsets[s] * h * by[s - 1, t]
            by[s, t] = casadi.mtimes(stages[s].by_start, by_start[s, t])
    omega = h * sum(weights[s] * stages[s].slope for s in numbers)
    by_omega = {t: h * sum(weights[s] * by[s, t] for s in numbers if s >= t) for t in numbers}
    increment = pose.full_twist(casadi.vertsplit(casadi.densify(omega)))
    curved = pose_curvature(pose, increment, multiplier)

    twice = {
        (s, t): casadi.mtimes(by_omega[s].T, casadi.mtimes(curved.increment_twice, by_omega[t]))
        for s in numbers
        for t in range(1, s + 1)
    }
    by_twist = {}
    later = zeros(n, 1)  # what the next stage passes on to the slope that it starts with
    for s in reversed(numbers):
        eta = weights[s] * h * curved.by_increment + later
        by_twist[s] = casadi.mtimes(stages[s].by_twist.T, eta)
        later = offsets[s] * h * casadi.mtimes(stages[s].by_start.T, eta)
        start_twice, mixed = slopes.curvature(stages[s], eta)
        for t in range(1, s):
            twice[s, t] += casadi.mtimes(mixed.T, by_start[s, t])
            moved = casadi.mtimes(start_twice, by_start[s, t])
            for r in range(t, s):
                twice[r, t] += casadi.mtimes(by_start[s, r].T, moved)
    by_pose = {s: casadi.sparsify(casadi.mtimes(curved.mixed, by_omega[s])) for s in numbers}
    return TwistCurvature(by_twist, {pair: casadi.sparsify(block) for pair, block in twice.items()}, by_pose)
