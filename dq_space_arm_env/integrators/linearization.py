"""Derivatives of a pose update, shared by the integrators.

In tangent coordinates a perturbed pose is q exp(d / 2). After q+ = q exp(Omega / 2) the perturbation reads d+
= Ad(exp(-Omega / 2)) d + Jr(Omega) dOmega, with the right Jacobian of the exponential: exact, and cheaper
than differentiating through the exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.algebra.dual_vectors import transform_matrix
from dq_space_arm_env.integrators.field import PoseCoordinates

Scalar = Any
Matrix = Any


def zero_matrix(rows: int, columns: int) -> Matrix:
    """A matrix without a single stored entry.

    Args:
        rows: Number of rows.
        columns: Number of columns.

    Returns:
        Sparse SX matrix.
    """
    return casadi.SX(rows, columns)


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
    return _matrix(adjoint, kept), _matrix(jacobian, kept)


def _matrix(rows: Sequence[Sequence[Scalar]], kept: Sequence[int]) -> Matrix:
    """Rows and columns of a nested sequence as a sparse SX matrix without its structural zeros."""
    return casadi.sparsify(casadi.vertcat(*(casadi.horzcat(*(rows[i][j] for j in kept)) for i in kept)))
