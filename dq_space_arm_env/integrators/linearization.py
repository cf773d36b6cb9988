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
from dq_space_arm_env.compiler.symbols import column, matrix, symbols
from dq_space_arm_env.integrators.field import PoseCoordinates

Scalar = Any
Matrix = Any


class DifferentiatedJacobian:
    """Gives equations of motion `jacobian_along` by differentiating the graph of their Jacobian."""

    n_y: int
    n_u: int

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """See `VectorField`."""
        raise NotImplementedError

    def jacobian_along(
        self,
        y: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_y: Matrix,
        by_u: Matrix,
        direction: Sequence[Scalar],
    ) -> Matrix:
        """Derivative of by_y times a fixed direction with respect to (y, u), by differentiating by_y.

        Args:
            y: State, n_y expressions.
            u: Input, n_u expressions.
            rates: Time derivative of y at (y, u), n_y; not used.
            by_y: Its Jacobian with respect to y, SX (n_y, n_y); not used.
            by_u: Its Jacobian with respect to u, SX (n_y, n_u); not used.
            direction: The direction, n_y.

        Returns:
            SX (n_y, n_y + n_u).
        """
        free = symbols("v", self.n_y + self.n_u)
        _, jacobian, _ = self.linearized_rates(free[: self.n_y], free[self.n_y :])
        along = casadi.jacobian(casadi.mtimes(jacobian, column(*direction)), column(*free))
        return casadi.sparsify(casadi.substitute(along, column(*free), casadi.densify(column(*y, *u))))


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
