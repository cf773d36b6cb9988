"""Momentum coordinates with the base's rotation as a quaternion that need not have unit length.

The quaternion r of the base, seen from its start axes, solves r' = r omega / 2, and r* L r is the angular
momentum in base axes for a constant L; both hold as they stand off the unit sphere. There r and P = 2 L r are
canonical coordinates of T*H, the motion is Hamiltonian in (r, P) and the joints' (angles, canonical momenta),
and length of r and inertial angular momentum are quadratic invariants: McLachlan, Modin & Verdier, Collective
symplectic integrators, Nonlinearity 27 (2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.algebra import quaternion
from dq_space_arm_env.algebra.vectors import dot, scale, skew_matrix
from dq_space_arm_env.integrators.momentum_coordinates import LocalState, MomentumCoordinates

Scalar = Any
Scalars = Sequence[Scalar]


class QuaternionCoordinates(MomentumCoordinates):
    """Coordinates whose rotation is r - 1, 4 entries, scalar first."""

    identity = (0.0, 0.0, 0.0, 0.0)

    def _rotating(self) -> list[int]:
        return [0, *(1 + axis for axis in self.turning)]

    def rotation_matrix(self, rotation: Scalars) -> list[list[Scalar]]:
        """The matrix of v -> r v r*: a rotation times |r|^2."""
        scalar, vector = 1.0 + rotation[0], rotation[1:]
        length = scalar * scalar - dot(vector, vector)
        skew = skew_matrix(scale(2.0 * scalar, vector))
        return [
            [2.0 * vector[i] * vector[j] + skew[i][j] + (length if i == j else 0.0) for j in range(3)]
            for i in range(3)
        ]

    def rotation_rate(self, rotation: Scalars, omega: Scalars) -> Scalars:
        half = quaternion.from_vector(scale(0.5, omega))
        return quaternion.add(half, quaternion.multiply(rotation, half))

    def quaternion(self, rotation: Scalars) -> Scalars:
        return (1.0 + rotation[0], *rotation[1:])

    def scalar_less_one(self, rotation: Scalars) -> Scalar:
        return rotation[0]

    def momentum_rates(self, state: LocalState, u: Scalars) -> tuple[Scalars, Scalars]:
        """Rates of both momenta due to the external wrench, which a rotation turns to start axes."""
        unit = self.quaternion(state.rotation)
        inverse = 1.0 / quaternion.dot(unit, unit)[0]
        linear, angular = super().momentum_rates(state, u)
        return scale(inverse, linear), scale(inverse, angular)
