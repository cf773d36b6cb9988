"""The equations of motion as an integrator sees them.

The state is a pose (a unit dual quaternion) and a vector y of everything else; the pose moves with the twist
that is part of y, and never feeds back into y'. An integrator advances y with a method for vectors, and the
pose with one for the group SE(3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from dq_space_arm_env.algebra import dual_quaternion, quaternion, screw

Scalar = Any
Matrix = Any  # a CasADi SX matrix


@dataclass(frozen=True)
class PoseCoordinates:
    """Storage of the base pose at the head of the state, and the twist that moves it."""

    stored: tuple[int, ...]  # entries of the dual quaternion that are stored; the others are zero
    directions: tuple[int, ...]  # of the 6 twist directions, those in which the base can move
    twist_indices: tuple[int, ...]  # of the twist in these directions, in y

    def full(self, stored: Sequence[Scalar]) -> list[Scalar]:
        """All 8 numbers of a pose."""
        return spread(stored, self.stored, 8)

    def reduced(self, pose: Sequence[Scalar]) -> list[Scalar]:
        """The stored numbers of a pose."""
        return [pose[i] for i in self.stored]

    def full_twist(self, free: Sequence[Scalar]) -> list[Scalar]:
        """All 6 numbers of a twist."""
        return spread(free, self.directions, 6)

    def moved(self, stored: Sequence[Scalar], increment: Sequence[Scalar]) -> list[Scalar]:
        """Compose a stored pose with exp(increment / 2), increment in body axes (rad, m); see `composed`."""
        return self.reduced(composed(self.full(stored), screw.exponential_minus_identity(increment)))


class VectorField(Protocol):
    """The equations of motion of a scene over CasADi symbols."""

    name: str  # prefix of the graphs' names
    n_x: int  # states
    n_y: int  # states besides the pose: the last entries of state and tangent state
    n_u: int  # inputs
    rate_indices: tuple[int, ...]  # entries of y whose derivatives are accelerations
    parameters: tuple[
        Scalar, ...
    ]  # symbols besides y and u, an input of every graph that evaluates the field

    @property
    def pose(self) -> PoseCoordinates | None:
        """Coordinates of the pose; None where it is part of y."""
        ...

    def rates(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of y, n_y."""
        ...

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of y, its Jacobians by y (n_y, n_y) and u (n_y, n_u)."""
        ...


class TwiceDifferentiableField(VectorField, Protocol):
    """Equations of motion with second derivatives, and with the pose apart from y."""

    @property
    def pose(self) -> PoseCoordinates:
        """Coordinates of the pose."""
        ...

    def rates_hessian(
        self,
        y: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_y: Matrix,
        by_u: Matrix,
        multiplier: Sequence[Scalar],
    ) -> Matrix:
        """Hessian of multiplier . rates with respect to (y, u), from `linearized_rates`; symmetric."""
        ...


def split_state(field: VectorField, x: Sequence[Scalar]) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
    """Stored numbers of the pose (none if it is part of y), and y."""
    return x[: field.n_x - field.n_y], x[field.n_x - field.n_y :]


def spread(values: Sequence[Scalar], positions: Sequence[int], size: int) -> list[Scalar]:
    """Values at given positions of a list of zeros."""
    result: list[Scalar] = [0.0] * size
    for position, value in zip(positions, values, strict=True):
        result[position] = value
    return result


def composed(pose: Sequence[Scalar], change: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Multiply a pose by 1 + `change`, and project the product onto the unit dual quaternions.

    The projection is one step of Newton's method for 1/sqrt(|q|^2), a dual number near 1: it squares the
    error of the norm, and rounding does not accumulate. It is part of the change, which is added last, so
    that each number is rounded once. Rounding the product and then its projection, a matter of the last
    digit, would err in the same direction step after step: by 4e-18 rad each, 4e-12 rad in a million.
    """
    real, dual = pose[:4], pose[4:]
    # The product has the norm of the pose: the other one is a unit dual quaternion.
    lengthening = 0.5 - 0.5 * quaternion.dot(real, real)[0]
    overlap = quaternion.dot(real, dual)[0]
    # (1 + lengthening - eps overlap)(1 + change) - 1
    factor = 1.0 + lengthening
    first, *rest = (factor * entry for entry in change[:4])
    shift = [
        factor * d - overlap * r for r, d in zip((1.0 + change[0], *change[1:4]), change[4:], strict=True)
    ]
    step = dual_quaternion.multiply(pose, (first + lengthening, *rest, *shift))
    return tuple(old + new for old, new in zip(pose, step, strict=True))
