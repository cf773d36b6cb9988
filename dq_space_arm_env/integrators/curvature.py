"""Second derivatives of a pose update, shared by the integrators.

Seen from its own result, a step moves a perturbed pose q exp(d / 2) to F = log(exp(-Omega_0) exp(d)
exp(Omega)), with twists in place of their halves. Drawing d through the exponential makes that log(exp(D)
exp(e)) with D = Ad(exp(-Omega_0)) d and e = log(exp(-Omega_0) exp(Omega)), and the series of Baker, Campbell
and Hausdorff gives F = D + e + [D, e] / 2 to second order; for twists the commutator is the dual cross
product. With the right Jacobian Jr, the second order of e is dJr[omega] omega / 2 at omega = Omega - Omega_0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.dual_vectors import cross as dual_cross
from dq_space_arm_env.compiler.symbols import column, matrix, symbols
from dq_space_arm_env.integrators.field import PoseCoordinates
from dq_space_arm_env.integrators.linearization import pose_blocks

Scalar = Any
Matrix = Any


@dataclass(frozen=True)
class PoseCurvature:
    """Derivatives of multiplier . F at z = 0, over the base's n tangent directions.

    Attributes:
        by_increment: Gradient with respect to the increment Omega, SX (n, 1).
        increment_twice: Hessian with respect to the increment, symmetric SX (n, n).
        mixed: Second derivative with respect to the pose (rows) and the increment, SX (n, n). The second
            derivative with respect to the pose alone is zero.
    """

    by_increment: Matrix
    increment_twice: Matrix
    mixed: Matrix


def pose_curvature(
    pose: PoseCoordinates, increment: Sequence[Scalar], multiplier: Sequence[Scalar]
) -> PoseCurvature:
    """Second derivatives of a pose update, contracted with a multiplier.

    Args:
        pose: Tells which directions the base can move in.
        increment: Omega, twist times time, 6 expressions (rad, m); zero in other directions.
        multiplier: Weights of the n tangent directions of the new pose.

    Returns:
        The derivatives.
    """
    weights = column(*multiplier)
    free = symbols("increment", len(pose.directions))
    _, jacobian = pose_blocks(pose, pose.full_twist(free))
    gradient = casadi.mtimes(jacobian.T, weights)
    slope = casadi.jacobian(gradient, column(*free))
    by_pose, by_increment = pose_blocks(pose, increment)
    values = casadi.densify(column(*(increment[i] for i in pose.directions)))
    gradient, slope = casadi.substitute([gradient, slope], [column(*free)], [values])
    commutator = casadi.mtimes(by_pose.T, casadi.mtimes(_commutator(pose, multiplier), by_increment))
    return PoseCurvature(
        by_increment=gradient,
        increment_twice=0.5 * (slope + slope.T),
        mixed=casadi.sparsify(0.5 * commutator),
    )


def _commutator(pose: PoseCoordinates, multiplier: Sequence[Scalar]) -> Matrix:
    """The matrix C with a' C b = multiplier . (a x b)."""
    rows = []
    for direction in pose.directions:
        unit = [1.0 if i == direction else 0.0 for i in range(6)]
        row = []
        for other in pose.directions:
            product = dual_cross(unit, [1.0 if i == other else 0.0 for i in range(6)])
            row.append(sum(w * product[i] for w, i in zip(multiplier, pose.directions, strict=True)))
        rows.append(row)
    return matrix(rows)


def upper_triangle(hessian: Matrix) -> Matrix:
    """The upper triangle of a symmetric matrix, without structural zeros.

    Args:
        hessian: SX (n, n).

    Returns:
        SX (n, n).
    """
    return casadi.sparsify(casadi.triu(hessian))
