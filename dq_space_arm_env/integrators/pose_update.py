"""First and second derivatives of a pose update q+ = q exp(Omega / 2), in tangent coordinates.

A perturbed pose is q exp(d / 2). After the update the perturbation is d+ = Ad(exp(-Omega / 2)) d + Jr(Omega)
dOmega, with the right Jacobian of the exponential: exact, and cheaper than differentiating the exponential.

Second derivatives: seen from its own result, a step moves the perturbed pose to F = log(exp(-Omega_0) exp(d)
exp(Omega)), with twists in place of their halves. Moving d through the exponential gives log(exp(D) exp(e))
with D = Ad(exp(-Omega_0)) d and e = log(exp(-Omega_0) exp(Omega)), and the Baker-Campbell-Hausdorff series
gives F = D + e + [D, e] / 2 to second order; the commutator of twists is the dual cross product. With the
right Jacobian Jr, the second order of e is dJr[omega] omega / 2 at omega = Omega - Omega_0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.algebra.dual_vectors import cross as dual_cross
from dq_space_arm_env.algebra.dual_vectors import transform_matrix
from dq_space_arm_env.algebra.symbolic import column, matrix, symbols
from dq_space_arm_env.dynamics.vector_field import PoseCoordinates

Scalar = Any
Matrix = Any


def pose_blocks(pose: PoseCoordinates, increment: Sequence[Scalar]) -> tuple[Matrix, Matrix]:
    """Derivatives of q+ = q exp(increment / 2) by q and by the increment (rad, m), SX (n, n) each."""
    # Ad(exp(-Omega / 2)) and Jr(Omega).
    backward = screw.exponential([-entry for entry in increment])
    adjoint = transform_matrix(*poses.to_matrix(backward))
    kept = list(pose.directions)
    jacobian = screw.exponential_right_jacobian(increment)
    return matrix(_kept(adjoint, kept)), matrix(_kept(jacobian, kept))


def _kept(rows: Sequence[Sequence[Scalar]], indices: Sequence[int]) -> list[list[Scalar]]:
    """Some rows of a square matrix, and the same columns."""
    return [[rows[i][j] for j in indices] for i in indices]


@dataclass(frozen=True)
class PoseCurvature:
    """Derivatives of multiplier . F, over the base's n directions; by the pose twice they are zero."""

    by_increment: Matrix  # gradient by Omega, SX (n, 1)
    increment_twice: Matrix  # Hessian by Omega, symmetric SX (n, n)
    mixed: Matrix  # by the pose (rows) and Omega, SX (n, n)


def pose_curvature(
    pose: PoseCoordinates, increment: Sequence[Scalar], multiplier: Sequence[Scalar]
) -> PoseCurvature:
    """Second derivatives of a pose update at Omega = `increment` (rad, m), contracted with a multiplier."""
    weights = column(*multiplier)
    free = symbols("increment", len(pose.directions))
    _, jacobian = pose_blocks(pose, pose.full_twist(free))
    gradient = casadi.mtimes(jacobian.T, weights)
    slope = casadi.jacobian(gradient, column(*free))
    by_pose, by_increment = pose_blocks(pose, increment)
    values = casadi.densify(column(*(increment[i] for i in pose.directions)))
    gradient, slope = casadi.substitute([gradient, slope], [column(*free)], [values])
    # [D, e] / 2, contracted with the multiplier.
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
    """Upper triangle of a symmetric matrix, without structural zeros."""
    return casadi.sparsify(casadi.triu(hessian))
