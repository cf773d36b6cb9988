"""The linear system of a Rosenbrock method, factorized once per step.

y and Omega are solved for one after the other, because y' does not depend on Omega. In the system of y the
angles come first: their rates are velocities, so their pivots are 1 and they leave a system for the
velocities alone, 1 - gamma h J_v - (gamma h)^2 J_q. Springs K and dampers D make it 1 + M^-1 (gamma h D +
(gamma h)^2 K), for which elimination without pivoting is as stable as for the mass matrix M (see
`factorize_lu`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.dynamics.linear import factorize_lu, solve_lu

Scalar = Any
Matrix = Any


class RosenbrockSystem:
    """(1 - scale J) x = b with a block lower triangular J."""

    def __init__(self, scale: Scalar, jacobian: Matrix, split: int) -> None:
        """Factorize; J, SX (n, n), is zero in the first `split` rows of the other columns."""
        system = casadi.SX.eye(jacobian.shape[0]) - scale * jacobian
        self._coupling = system[split:, :split]
        self._factors = [_factorized(system[:split, :split]), _factorized(system[split:, split:])]

    @property
    def variables(self) -> list[Scalar]:
        """The entries of the factors that are not constants of the scene."""
        parts = (self._coupling, *self._factors)
        return [entry for part in parts for entry in part.nonzeros() if not entry.is_constant()]

    def renamed(self) -> RosenbrockSystem:
        """The same with new symbols for `variables`, computed elsewhere."""
        known = RosenbrockSystem.__new__(RosenbrockSystem)
        known._coupling = _renamed(self._coupling, "coupling")
        known._factors = [_renamed(factor, f"factor{i}") for i, factor in enumerate(self._factors)]
        return known

    def solve(self, right: Sequence[Scalar]) -> list[Scalar]:
        first, last = (_rows(factor) for factor in self._factors)
        solved = solve_lu(first, right[: len(first)])
        rest = [
            value - sum((entry * x for entry, x in zip(row, solved, strict=True)), 0.0)
            for row, value in zip(_rows(self._coupling), right[len(first) :], strict=True)
        ]
        return [*solved, *solve_lu(last, rest)]


def _factorized(system: Matrix) -> Matrix:
    """`factorize_lu` as a matrix without structural zeros."""
    factor = casadi.SX(*system.shape)
    for i, row in enumerate(factorize_lu(_rows(system))):
        for j, entry in enumerate(row):
            factor[i, j] = entry
    return casadi.sparsify(factor)


def _renamed(values: Matrix, name: str) -> Matrix:
    """New symbols in place of all entries but constants."""
    entries = [
        entry if entry.is_constant() else casadi.SX.sym(f"{name}_{i}")
        for i, entry in enumerate(values.nonzeros())
    ]
    return casadi.SX(values.sparsity(), casadi.vertcat(*entries)) if entries else values


def _rows(values: Matrix) -> list[list[Scalar]]:
    """The rows of a matrix, with zeros for structural ones."""
    rows: list[list[Scalar]] = [[0.0] * values.shape[1] for _ in range(values.shape[0])]
    for row, col, entry in zip(*values.sparsity().get_triplet(), values.nonzeros(), strict=True):
        rows[row][col] = entry
    return rows
