"""The interface of an integrator: it appends calls of traced graphs to a program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.vector_field import TwiceDifferentiableField, VectorField

Scalar = Any


class Integrator(Protocol):
    """A one-step method."""

    def append_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn buffers x, u, h into x_next."""
        ...

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """Append the calls that turn x, u, h into A and B, the exact tangent derivatives of the step.

        Returns the sparsity patterns of A (n_t, n_t) and B (n_t, n_u); the buffers hold their nonzeros by
        column.
        """
        ...


@runtime_checkable
class MomentumIntegrator(Integrator, Protocol):
    """A one-step method that keeps the total momentum, and can hand it on from step to step."""

    def append_walk(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn buffers x, momentum, u, h into x_next, momentum_next.

        The momentum is that of `Kernels.momentum`, 6 entries in inertial axes. It is handed on plus the
        change in the step, so rounding errors of the states never enter it.
        """
        ...


@runtime_checkable
class EmbeddedIntegrator(Integrator, Protocol):
    """A one-step method with another one, of lower order, that estimates its error."""

    embedded_order: int  # at least 3

    def append_embedded_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn x, u, h into x_next and `estimate`, the difference of both methods.

        The estimate is in tangent coordinates: of the pose, if it is apart from y, then of y.
        """
        ...


@runtime_checkable
class TwiceDifferentiableIntegrator(Integrator, Protocol):
    """A one-step method with second derivatives."""

    def append_curvature(self, program: Program, field: TwiceDifferentiableField) -> Any:
        """Append the calls that turn x, u, h, multiplier into `curvature`, the Hessian of multiplier . step.

        It is taken in tangent coordinates around x and around the result: the second derivative of multiplier
        . (step(x (+) z, u) (-) step(x, u)) with respect to (z, u). Returns the sparsity pattern of the upper
        triangle (n_t + n_u, n_t + n_u), whose nonzeros the buffer holds by column.
        """
        ...


def program_inputs(field: VectorField, *buffers: Buffer) -> list[Buffer]:
    """Inputs of a program that evaluates the field, its parameters, if any, after the first of them."""
    if not field.parameters:
        return list(buffers)
    return [buffers[0], Buffer("parameters", len(field.parameters)), *buffers[1:]]


def graph_inputs(field: VectorField, **symbols: Sequence[Scalar]) -> dict[str, Sequence[Scalar]]:
    """Inputs of a graph that evaluates the field, with its parameters, if any, as input `parameters`."""
    return {**symbols, "parameters": field.parameters} if field.parameters else symbols
