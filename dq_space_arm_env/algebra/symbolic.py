"""CasADi matrices that are symbolic whatever they hold: nothing, numbers only, or symbols.

CasADi's own `vertcat` makes a number matrix of numbers and refuses to differentiate it; scenes without
joints, actuators or wrist would need special cases everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

Scalar = Any
Matrix = Any


def symbols(name: str, count: int) -> list[Scalar]:
    return [casadi.SX.sym(f"{name}_{i}") for i in range(count)]


def column(*entries: Scalar) -> Matrix:
    """SX column of scalars, without its structural zeros."""
    return casadi.sparsify(casadi.SX(casadi.vertcat(*entries))) if entries else zeros(0, 1)


def columns(*vectors: Matrix, rows: int) -> Matrix:
    """SX columns side by side."""
    return casadi.horzcat(*vectors) if vectors else zeros(rows, 0)


def matrix(rows: Sequence[Sequence[Scalar]]) -> Matrix:
    """SX matrix from nested sequences, without its structural zeros."""
    return casadi.sparsify(casadi.SX(casadi.vertcat(*(casadi.horzcat(*row) for row in rows))))


def zeros(rows: int, columns: int) -> Matrix:
    """SX matrix without a single stored entry."""
    return casadi.SX(rows, columns)


def dense_entries(vector: Matrix) -> list[Scalar]:
    """Entries of an SX column, zero where nothing is stored."""
    entries: list[Scalar] = [0.0] * vector.shape[0]
    for row, value in zip(vector.row(), vector.nonzeros(), strict=True):
        entries[row] = value
    return entries
