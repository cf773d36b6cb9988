"""What an integrator may ask of the equations of motion, and what it must offer: calls of traced graphs.

The state is a pose (a unit dual quaternion) and a vector y of everything else; the pose moves with the twist
that is part of y, and never feeds back into y'. An integrator therefore advances y with a method for vectors,
and the pose with one for the group SE(3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from dq_space_arm_env.algebra import dual_quaternion, quaternion, screw
from dq_space_arm_env.compiler.program import Program

Scalar = Any
Matrix = Any  # a CasADi SX matrix


@dataclass(frozen=True)
class PoseCoordinates:
    """How the pose of the base is stored at the head of the state, and what moves it.

    Attributes:
        stored: Which of the 8 numbers of a dual quaternion are stored; the others are zero.
        directions: Which of the 6 twist directions the base can move in.
        twist_indices: Where the twist of these directions stands in y.
    """

    stored: tuple[int, ...]
    directions: tuple[int, ...]
    twist_indices: tuple[int, ...]

    def full(self, stored: Sequence[Scalar]) -> list[Scalar]:
        """All 8 numbers of a pose from the stored ones."""
        return spread(stored, self.stored, 8)

    def reduced(self, pose: Sequence[Scalar]) -> list[Scalar]:
        """The stored numbers of a pose."""
        return [pose[i] for i in self.stored]

    def full_twist(self, free: Sequence[Scalar]) -> list[Scalar]:
        """All 6 numbers of a twist from those of the free directions."""
        return spread(free, self.directions, 6)

    def moved(self, stored: Sequence[Scalar], increment: Sequence[Scalar]) -> list[Scalar]:
        """Compose a pose with the exponential of a twist increment, see `composed`.

        Args:
            stored: Stored numbers of the pose.
            increment: Twist times time, 6 numbers (rad, m), in body axes.

        Returns:
            Stored numbers of q exp(increment / 2).
        """
        return self.reduced(composed(self.full(stored), screw.exponential_minus_identity(increment)))


class VectorField(Protocol):
    """The equations of motion of a scene, over CasADi symbols.

    Attributes:
        name: Identifier that prefixes the names of the graphs.
        n_x: Number of stored states.
        n_y: Number of states besides the pose; they are the last entries of the state and of the tangent
            state.
        n_u: Number of inputs.
        pose: Coordinates of the pose; None for a formulation that has it among the entries of y.
        rate_indices: The entries of y whose time derivatives are accelerations; the others' are velocities or
            inputs.
        parameters: Symbols besides y and u that the equations hold, an input of every graph that evaluates
            them.
    """

    name: str
    n_x: int
    n_y: int
    n_u: int
    rate_indices: tuple[int, ...]
    parameters: tuple[Scalar, ...]

    @property
    def pose(self) -> PoseCoordinates | None:
        """Coordinates of the pose."""
        ...

    def rates(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of y, n_y."""
        ...

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of y, its Jacobians with respect to y (n_y, n_y) and u (n_y, n_u)."""
        ...

    def jacobian_along(
        self,
        y: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_y: Matrix,
        by_u: Matrix,
        direction: Sequence[Scalar],
    ) -> Matrix:
        """Derivative of by_y direction with respect to (y, u), SX (n_y, n_y + n_u), the direction held.

        The three arguments after u are what `linearized_rates` gives at (y, u).
        """
        ...


class TwiceDifferentiableField(VectorField, Protocol):
    """Equations of motion with second derivatives, and with a pose apart from y."""

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


class Integrator(Protocol):
    """A one-step method.

    Those with `has_curvature` are `TwiceDifferentiableIntegrator`s.
    """

    @property
    def name(self) -> str:
        """Name in the scene file."""
        ...

    @property
    def order(self) -> int:
        """Order of convergence."""
        ...

    @property
    def has_curvature(self) -> bool:
        """Whether there are second derivatives of a step."""
        ...

    def append_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn buffers x, u, h into x_next."""
        ...

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """Append the calls that turn x, u, h into the nonzeros A, B of the step's exact tangent derivative.

        Returns:
            CasADi sparsity patterns of A (n_t, n_t) and B (n_t, n_u); the buffers hold their nonzeros, column
            by column.
        """
        ...


@runtime_checkable
class TwiceDifferentiableIntegrator(Integrator, Protocol):
    """A one-step method with second derivatives."""

    def append_curvature(self, program: Program, field: TwiceDifferentiableField) -> Any:
        """Append the calls that turn x, u, h, multiplier into the second derivative of multiplier . step.

        The step is taken in tangent coordinates around x and around its own result at (x, u): the second
        derivative of multiplier . (step(x (+) z, u) (-) step(x, u)) with respect to (z, u).

        Returns:
            CasADi sparsity pattern of the upper triangle (n_t + n_u, n_t + n_u); buffer `curvature` holds its
            nonzeros, column by column.
        """
        ...


def graph_inputs(field: VectorField, **symbols: Sequence[Scalar]) -> dict[str, Sequence[Scalar]]:
    """Inputs of a graph that evaluates the equations of motion.

    Args:
        field: The equations of motion.
        symbols: The symbols of each input.

    Returns:
        The same with the parameters of the equations, if there are any, as input `parameters`.
    """
    return {**symbols, "parameters": field.parameters} if field.parameters else symbols


def split_state(field: VectorField, x: Sequence[Scalar]) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
    """Stored numbers of the pose, and y.

    Args:
        field: The equations of motion.
        x: State, n_x.

    Returns:
        The n_x - n_y numbers of the pose (none, if it is part of y), and the n_y others.
    """
    return x[: field.n_x - field.n_y], x[field.n_x - field.n_y :]


def spread(values: Sequence[Scalar], positions: Sequence[int], size: int) -> list[Scalar]:
    """Put values at given positions among zeros.

    Args:
        values: n values.
        positions: n positions.
        size: Length of the result.

    Returns:
        `size` scalars.
    """
    result: list[Scalar] = [0.0] * size
    for position, value in zip(positions, values, strict=True):
        result[position] = value
    return result


def composed(pose: Sequence[Scalar], change: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Multiply a pose by another, and project the product onto the unit dual quaternions.

    The projection is one step of Newton's method for 1/sqrt(|q|^2), a dual number near 1: errors of the
    pose's norm are squared, those of rounding do not accumulate. It joins the change, which is added at the
    end, so that each number is rounded once. Rounding the product, and then its projection, which is a matter
    of the last digit, would err in the same direction step after step: by 4e-18 rad each, 4e-12 rad in a
    million.

    Args:
        pose: Dual quaternion, 8 numbers, |q_r| = 1 and q_r . q_d = 0 up to small errors.
        change: The other pose less 1, 8 numbers.

    Returns:
        Unit dual quaternion pose (1 + change), 8 numbers.
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
