"""The vector field of a single step: y, followed by Omega, the logarithm of the pose's motion.

Omega starts every step at zero and obeys Omega' = dexp^-1(omega) (Munthe-Kaas, High order Runge-Kutta methods
on manifolds, 1999), so any method for vectors also advances the pose, with its own order and stability.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.dual_vectors import cross as dual_cross
from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.pose_update import pose_blocks

Scalar = Any
Matrix = Any


class StepField:
    """z = (y, Omega) with z' = f(z, u), its exact Jacobian, and the way back to states.

    Only Omega' depends on Omega, so the Jacobian is block triangular.
    """

    def __init__(self, field: VectorField) -> None:
        self.field = field
        self.n_z = field.n_y + (len(field.pose.directions) if field.pose is not None else 0)

    def start(self, x: Sequence[Scalar]) -> list[Scalar]:
        """The vector z of a state."""
        return [*split_state(self.field, x)[1], *[0.0] * (self.n_z - self.field.n_y)]

    def rates(self, z: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of z."""
        return [*self.field.rates(z[: self.field.n_y], u), *self._slope(z)]

    def linearized_rates(
        self, z: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of z, its Jacobians by z (n_z, n_z) and u (n_z, n_u)."""
        n_y, n_pose = self.field.n_y, self.n_z - self.field.n_y
        rates, by_y, by_u = self.field.linearized_rates(z[:n_y], u)
        by_z = casadi.vertcat(casadi.horzcat(by_y, zeros(n_y, n_pose)), self._slope_by_z(z))
        return [*rates, *self._slope(z)], by_z, casadi.vertcat(by_u, zeros(n_pose, self.field.n_u))

    def jacobian_along(
        self,
        z: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_z: Matrix,
        by_u: Matrix,
        direction: Sequence[Scalar],
    ) -> Matrix:
        """Derivative of by_z times a fixed direction with respect to (y, u), SX (n_z, n_y + n_u)."""
        n_y, n_u = self.field.n_y, self.field.n_u
        motion = self.field.jacobian_along(
            z[:n_y], u, rates[:n_y], by_z[:n_y, :n_y], by_u[:n_y, :], direction[:n_y]
        )
        free = symbols("z", self.n_z)
        along = casadi.mtimes(self._slope_by_z(free), column(*direction))
        slope = _at(casadi.jacobian(along, column(*free[:n_y])), free, z)
        return casadi.vertcat(motion, casadi.horzcat(slope, zeros(self.n_z - n_y, n_u)))

    def moved(self, x: Sequence[Scalar], change: Sequence[Scalar]) -> list[Scalar]:
        """The state at a change of z from the start."""
        stored, start = split_state(self.field, x)
        y = [old + new for old, new in zip(start, change, strict=False)]
        if self.field.pose is None:
            return y
        return [*self.field.pose.moved(stored, self._increment(change)), *y]

    def moved_by(self, change: Sequence[Scalar], derivative: Matrix) -> tuple[Matrix, Matrix]:
        """A and B of `moved`, from the derivative of z by (y, u), SX (n_z, n_y + n_u)."""
        n_y, pose = self.field.n_y, self.field.pose
        by_state = derivative[:n_y, :]
        if pose is None:
            a, b = by_state[:, :n_y], by_state[:, n_y:]
        else:
            by_pose, by_increment = pose_blocks(pose, self._increment(change))
            by_state = casadi.vertcat(casadi.mtimes(by_increment, derivative[n_y:, :]), by_state)
            pose_columns = casadi.vertcat(by_pose, zeros(n_y, by_pose.shape[1]))
            a, b = casadi.horzcat(pose_columns, by_state[:, :n_y]), by_state[:, n_y:]
        return casadi.sparsify(a), casadi.sparsify(b)

    def _increment(self, z: Sequence[Scalar]) -> list[Scalar]:
        """Omega, 6."""
        return self.field.pose.full_twist(z[self.field.n_y :]) if self.field.pose is not None else []

    def _slope(self, z: Sequence[Scalar]) -> list[Scalar]:
        """Omega' = dexp^-1(omega), n_z - n_y.

        Omega x omega is of order h^2, so the series may stop after the second commutator: the remainder,
        (Omega x)^4 omega / 720, changes a step by O(h^6).
        """
        if self.field.pose is None:
            return []
        omega = self.field.pose.full_twist([z[i] for i in self.field.pose.twist_indices])
        once = dual_cross(self._increment(z), omega)
        twice = dual_cross(self._increment(z), once)
        slope = [w + 0.5 * a + (1 / 12) * b for w, a, b in zip(omega, once, twice, strict=True)]
        return [slope[i] for i in self.field.pose.directions]

    def _slope_by_z(self, z: Sequence[Scalar]) -> Matrix:
        """Jacobian of Omega' by z, SX (n_z - n_y, n_z)."""
        free = symbols("z", self.n_z)
        return _at(casadi.jacobian(column(*self._slope(free)), column(*free)), free, z)


def _at(expression: Matrix, names: Sequence[Scalar], values: Sequence[Scalar]) -> Matrix:
    """Substitute values for names in an expression."""
    return casadi.sparsify(casadi.substitute(expression, column(*names), casadi.densify(column(*values))))
