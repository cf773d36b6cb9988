"""Coordinates with canonical momenta of the joints in place of their rates.

They are those of `momentum_coordinates`, with p = dT/d(rates) for the joint rates: T is the kinetic energy
relative to the center of mass. Hamilton's equations of the joints,

    p' = dT/d(angles) - K (angles - rest) - D rates + motor torques - f . dc/d(angles),

at fixed angular velocity and rates, hold the torques of springs and dampers as they are: nothing multiplies
them by an inverse inertia that changes with the angles, so a linearly implicit method sees their Jacobian at
any deflection. f is the external force and c the center of mass, both in base axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, columns, dense_entries, symbols
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.integrators.momentum_coordinates import (
    LocalState,
    MomentumCoordinates,
)

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any


class CanonicalCoordinates:
    """Equations of motion in these coordinates; `given` are those with joint rates."""

    def __init__(self, field: SpaceArmField, given: MomentumCoordinates | None = None) -> None:
        self.given = MomentumCoordinates(field) if given is None else given
        self.balance, self.n_y = self.given.balance, self.given.n_y

    def entered(self, y: Scalars) -> list[Scalar]:
        """Put canonical momenta in the place of joint rates."""
        state = self.given.parts(y)
        omega = self._turning(state)
        momenta = self._mass_matrix(state.shape).canonical_momenta(omega, state.joint_rates)[1]
        return self.given.joined(replace(state, joint_rates=momenta))

    def left(self, z: Scalars) -> list[Scalar]:
        """Put joint rates in the place of canonical momenta; the inverse of `entered`."""
        state = self.given.parts(z)
        return self.given.joined(replace(state, joint_rates=self._velocities(state)[1]))

    def rates(self, z: Scalars, u: Scalars) -> list[Scalar]:
        """Time derivative of a state with canonical momenta."""
        state = self.given.parts(z)
        omega, rates = self._velocities(state)
        return self._joined_rates(state, omega, rates, u)

    def linearized(self, y: Scalars, u: Scalars) -> tuple[list[Scalar], list[Scalar], Matrix, Matrix]:
        """Canonical state z and its time derivative, for a state y with joint rates; their Jacobians by y."""
        free, inputs = symbols("y", self.n_y), symbols("w", len(u))
        state = self.given.parts(free)
        rates = column(*self._joined_rates(state, self._turning(state), state.joint_rates, inputs))
        momenta = column(*self.entered(free))
        by_y = [casadi.jacobian(vector, column(*free)) for vector in (momenta, rates)]
        values = casadi.densify(column(*y, *u))
        found = casadi.substitute(
            [casadi.densify(momenta), casadi.densify(rates), *by_y], [column(*free, *inputs)], [values]
        )
        momenta, rates, momenta_by_y, rates_by_y = found
        return (
            casadi.vertsplit(momenta),
            casadi.vertsplit(rates),
            casadi.sparsify(momenta_by_y),
            casadi.sparsify(rates_by_y),
        )

    def passive_slopes(self, y: Scalars) -> tuple[Matrix, Matrix]:
        """Stiffness K and damping D of the joints, SX (n, n), for a state y with joint rates."""
        state = self.given.parts(y)
        n = len(state.joint_rates)
        free = column(*symbols("q", len(state.shape)), *symbols("v", n))
        shape, rates = casadi.vertsplit(free)[: len(state.shape)], casadi.vertsplit(free)[len(state.shape) :]
        torques = column(*self.balance.passive_torques(self.given.y(shape, [0.0] * 6, rates)))
        slopes = casadi.substitute(
            -casadi.jacobian(torques, free), free, casadi.densify(column(*state.shape, *state.joint_rates))
        )
        slopes = casadi.sparsify(slopes)
        return slopes[:, :n], slopes[:, len(state.shape) :]

    def inverse_inertia(self, y: Scalars) -> Matrix:
        """Derivative of the joint rates by the canonical momenta, SX (n, n)."""
        state = self.given.parts(y)
        n, mass_matrix = len(state.joint_rates), self._mass_matrix(state.shape)
        units = ([float(i == j) for i in range(n)] for j in range(n))
        return columns(
            *(column(*mass_matrix.velocities((0.0, 0.0, 0.0), unit).joints) for unit in units), rows=n
        )

    def _mass_matrix(self, shape: Scalars) -> Any:
        return self.balance.mass_matrix(self.given.y(shape, [0.0] * 6, [0.0] * len(self.given.joint_indices)))

    def _turning(self, state: LocalState) -> list[Scalar]:
        """The base's angular velocity for given joint rates, base axes."""
        angular = self.given.angular_of_bodies(state)
        return self.given.twist(state.shape, (0.0, 0.0, 0.0), angular, state.joint_rates)[:3]

    def _velocities(self, state: LocalState) -> tuple[Scalars, Scalars]:
        """The base's angular velocity, base axes, and the joint rates for given canonical momenta."""
        angular = self.given.angular_of_bodies(state)
        solved = self._mass_matrix(state.shape).velocities(angular, state.joint_rates)
        return solved.angular, solved.joints

    def _joined_rates(
        self, state: LocalState, omega: Scalars, joint_rates: Scalars, u: Scalars
    ) -> list[Scalar]:
        given = self.given
        linear, angular = given.momentum_rates(state, u)
        inputs = given.base.inputs(u)
        y = given.y(state.shape, [0.0] * 6, joint_rates)
        return given.joined(
            LocalState(
                given.rotation_rate(state.rotation, omega),
                [*joint_rates, *inputs.wrist_rates, *inputs.wheel_torques],
                [entry * (1.0 / self.balance.mass) for entry in state.linear],
                linear,
                angular,
                self._forces(state.shape, omega, joint_rates, y, u),
            )
        )

    def _forces(
        self, shape: Scalars, omega: Scalars, joint_rates: Scalars, y: Scalars, u: Scalars
    ) -> list[Scalar]:
        """Time derivatives of the canonical momenta, N m."""
        n = len(joint_rates)
        free, turning, moving = symbols("q", len(shape)), symbols("o", 3), symbols("v", n)
        mass_matrix = self._mass_matrix(free)
        angular, momenta = mass_matrix.canonical_momenta(turning, moving)
        energy = 0.5 * sum(
            (a * b for a, b in zip((*angular, *momenta), (*turning, *moving), strict=True)), 0.0
        )
        force = symbols("f", 3)
        pulled = sum((a * b for a, b in zip(force, mass_matrix.center, strict=True)), 0.0)
        gradient = casadi.gradient(casadi.SX(energy - pulled), column(*free))
        acting, _ = self.balance.external_wrench(y, u)
        values = casadi.densify(column(*shape, *omega, *joint_rates, *acting))
        names = column(*free, *turning, *moving, *force)
        gradient = casadi.substitute(casadi.densify(gradient), names, values)
        inertial = dense_entries(gradient)
        torques = self.balance.joint_torques(y, u)
        # Angles of joints and motors come first; nothing here depends on wrist angles and wheel momenta.
        return [a + b for a, b in zip(inertial[:n], torques, strict=True)]
