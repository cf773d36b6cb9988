"""Second derivatives of the residual R(y, a): forces that accelerations a need, minus those acting at y."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols, zeros

Scalar = Any
Matrix = Any


@dataclass(frozen=True)
class Residual:
    """The residual over symbols."""

    forces: Matrix  # R: force and torque on the base, joint torques; SX (6 + n, 1)
    y: Sequence[Scalar]  # symbols, n_y
    accelerations: Sequence[Scalar]  # symbols of a: angular and linear of the base, joints; 6 + n
    free: Sequence[int]  # accelerations that the base's directions of motion and the joints allow

    def weighted(
        self, y: Sequence[Scalar], accelerations: Sequence[Scalar], weights: Sequence[Scalar]
    ) -> tuple[Matrix, Matrix]:
        """Second derivatives of weights . R: by (free accelerations, y), and by y twice."""
        w = symbols("w", len(self.accelerations))
        # The residual lists the force before the torque, an acceleration its angular part first.
        power = casadi.dot(column(*w[3:6], *w[:3], *w[6:]), self.forces)
        by_y = column(*self.y)
        mixed = casadi.jacobian(self._by_free(power).T, by_y) if self.free else zeros(0, len(self.y))
        twice = casadi.hessian(power, by_y)[0]
        names = column(*self.y, *self.accelerations, *w)
        return _at([mixed, twice], names, column(*y, *accelerations, *weights))

    def _by_free(self, expression: Matrix) -> Matrix:
        """Jacobian with respect to the free accelerations."""
        return casadi.jacobian(expression, column(*(self.accelerations[i] for i in self.free)))


def _at(expressions: Sequence[Matrix], names: Matrix, values: Matrix) -> tuple[Matrix, Matrix]:
    """Substitute values for names in expressions."""
    first, last = casadi.substitute(list(expressions), [names], [casadi.densify(values)])
    return casadi.sparsify(first), casadi.sparsify(last)
