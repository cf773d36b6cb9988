"""Derivatives of a pose update, shared by the integrators.

In tangent coordinates a perturbed pose is q exp(d / 2). After q+ = q exp(Omega / 2) the perturbation reads d+
= Ad(exp(-Omega / 2)) d + Jr(Omega) dOmega, with the right Jacobian of the exponential: exact, and cheaper
than differentiating through the exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.algebra.dual_vectors import transform_matrix
from dq_space_arm_env.compiler.symbols import matrix
from dq_space_arm_env.integrators.field import PoseCoordinates

Scalar = Any
Matrix = Any


def pose_blocks(pose: PoseCoordinates, increment: Sequence[Scalar]) -> tuple[Matrix, Matrix]:
    """Derivatives of q+ = q exp(increment / 2) with respect to q and to the increment.

    Args:
        pose: Tells which directions the base can move in.
        increment: Twist times time, 6 expressions (rad, m).

    Returns:
        Two SX matrices (n, n) over the base's n tangent directions: with respect to the pose, and to the
        increment.
    """
    backward = screw.exponential([-entry for entry in increment])
    adjoint = transform_matrix(*poses.to_matrix(backward))
    kept = list(pose.directions)
    jacobian = screw.exponential_right_jacobian(increment)
    return matrix(_kept(adjoint, kept)), matrix(_kept(jacobian, kept))


def _kept(rows: Sequence[Sequence[Scalar]], indices: Sequence[int]) -> list[list[Scalar]]:
    """Some rows of a square matrix, and the same columns."""
    return [[rows[i][j] for j in indices] for i in indices]
