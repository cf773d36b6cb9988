"""The linear system of a Rosenbrock method, factorized once per step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.dynamics.linear import factorize_lu, solve_lu

Scalar = Any
Matrix = Any


class RosenbrockSystem:
    """A x = b with a sparse A, whose unknowns are eliminated in a given order, without pivoting."""

    def __init__(self, system: Matrix, order: Sequence[int]) -> None:
        """Factorize A, SX (n, n)."""
        self._order = list(order)
        self._factor = _factorized(system[self._order, self._order])

    @property
    def variables(self) -> list[Scalar]:
        """The entries of the factors that are not constants of the scene."""
        return [entry for entry in self._factor.nonzeros() if not entry.is_constant()]

    def renamed(self) -> RosenbrockSystem:
        """The same with new symbols for `variables`, computed elsewhere."""
        known = RosenbrockSystem.__new__(RosenbrockSystem)
        known._order, known._factor = self._order, _renamed(self._factor, "factor")
        return known

    def solve(self, right: Sequence[Scalar]) -> list[Scalar]:
        solved = solve_lu(_rows(self._factor), [right[i] for i in self._order])
        result: list[Scalar] = [0.0] * len(solved)
        for i, value in zip(self._order, solved, strict=True):
            result[i] = value
        return result


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
