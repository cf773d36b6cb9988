"""Programs of a quadratic cost of the state, given by gradient and Hessian at a reference: a value model.

The cost-to-go of a maneuver, expanded to second order around one of its states, is the terminal cost of a
shorter maneuver that ends there. The reference x_reference, the gradient g and the symmetric Hessian P, row
by row, are inputs of each program.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.task.equations import SceneEquations

Matrix = Any


class QuadraticPrograms:
    """Builds the programs of one scene: cost = g . e + 1/2 e . P e, with e(x) as in `_deviation`."""

    def __init__(self, equations: SceneEquations) -> None:
        self.field, self.equations = equations.field, equations
        n_x, n_t = self.field.n_x, self.field.n_t
        self._x, self._x_reference = symbols("x", n_x), symbols("x_reference", n_x)
        self._gradient, self._hessian = symbols("gradient", n_t), symbols("hessian", n_t * n_t)
        self._z = symbols("z", n_t)  # increment of x in tangent coordinates

    def cost(self) -> Program:
        """The cost, zero at the reference."""
        deviation, slope, gradient = self._deviation(), self._slope(), column(*self._gradient)
        return self._program("quadratic_cost", {"cost": 0.5 * casadi.dot(deviation, gradient + slope)})

    def cost_derivatives(self) -> Program:
        """Gradient and Gauss-Newton Hessian D' P D with D = de/dz, positive semidefinite if P is."""
        z = column(*self._z)
        by_state, slope = casadi.jacobian(self._deviation(), z), self._slope()
        derivatives = {
            "lx": casadi.mtimes(by_state.T, slope),
            "lxx": casadi.mtimes(by_state.T, casadi.jacobian(slope, z)),
        }
        return self._program("quadratic_cost_derivatives", derivatives)

    def _slope(self) -> Matrix:
        """The derivative g + P e of the cost by e."""
        weight = casadi.reshape(column(*self._hessian), len(self._z), len(self._z))
        return column(*self._gradient) + casadi.mtimes(weight, self._deviation())

    def _deviation(self) -> Matrix:
        """Coordinates e of x (+) z seen from the reference; e = x (-) x_reference up to third order.

        For the pose they are twice the vector part of q_reference* q, whose derivatives, unlike the
        logarithm's, are polynomials. For a small twist z, q moves to q (1 + z / 2), with dual quaternion
        products.
        """
        field, equations, n = self.field, self.equations, len(self.field.pose.directions)
        base, reference = equations.base_pose(self._x), equations.base_pose(self._x_reference)
        half = dq.from_vector([0.5 * entry for entry in field.pose.full_twist(self._z[:n])])
        relative = dq.multiply(dq.multiply(dq.conjugate(reference), base), dq.add(dq.IDENTITY, half))
        twist = dq.to_vector(dq.scale(2.0, relative))
        rest = zip(equations.y(self._x), self._z[n:], equations.y(self._x_reference), strict=True)
        return column(*(twist[i] for i in field.pose.directions), *(a + b - c for a, b, c in rest))

    def _program(self, name: str, outputs: Mapping[str, Matrix]) -> Program:
        """A program of expressions at z = 0."""
        inputs = {
            "x": self._x,
            "x_reference": self._x_reference,
            "gradient": self._gradient,
            "hessian": self._hessian,
        }
        zero = casadi.DM.zeros(len(self._z))
        values = casadi.substitute(list(outputs.values()), [column(*self._z)], [zero])
        entries = {key: casadi.densify(value).nonzeros() for key, value in zip(outputs, values, strict=True)}
        program = Program(
            name,
            [Buffer(key, len(scalars)) for key, scalars in inputs.items()],
            [Buffer(key, len(scalars)) for key, scalars in entries.items()],
        )
        program.call(graph_of(name + "_graph", inputs, entries))
        return program
