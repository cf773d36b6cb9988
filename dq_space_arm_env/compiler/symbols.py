"""CasADi matrices that are symbolic whatever they hold: no entry at all, numbers only, or symbols.

CasADi's own `vertcat` makes a number matrix of numbers and refuses to differentiate it; scenes without
joints, actuators or wrist would need a special case everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

Scalar = Any
Matrix = Any


def symbols(name: str, count: int) -> list[Scalar]:
    """Scalar symbols.

    Args:
        name: Beginning of their names.
        count: How many.

    Returns:
        The symbols.
    """
    return [casadi.SX.sym(f"{name}_{i}") for i in range(count)]


def column(*entries: Scalar) -> Matrix:
    """A column of scalars.

    Args:
        entries: Numbers or expressions.

    Returns:
        SX matrix (n, 1), without its structural zeros.
    """
    return casadi.sparsify(casadi.SX(casadi.vertcat(*entries))) if entries else zeros(0, 1)


def columns(*vectors: Matrix, rows: int) -> Matrix:
    """Columns side by side.

    Args:
        vectors: SX matrices of `rows` rows.
        rows: Number of rows, also when there are no columns.

    Returns:
        SX matrix.
    """
    return casadi.horzcat(*vectors) if vectors else zeros(rows, 0)


def matrix(rows: Sequence[Sequence[Scalar]]) -> Matrix:
    """A matrix from nested sequences.

    Args:
        rows: At least one row of numbers or expressions.

    Returns:
        SX matrix, without its structural zeros.
    """
    return casadi.sparsify(casadi.SX(casadi.vertcat(*(casadi.horzcat(*row) for row in rows))))


def zeros(rows: int, columns: int) -> Matrix:
    """A matrix without a single stored entry.

    Args:
        rows: Number of rows.
        columns: Number of columns.

    Returns:
        SX matrix.
    """
    return casadi.SX(rows, columns)


def dense_entries(vector: Matrix) -> list[Scalar]:
    """Entries of a column, with the number zero where nothing is stored.

    Args:
        vector: SX matrix (n, 1).

    Returns:
        n numbers or expressions.
    """
    entries: list[Scalar] = [0.0] * vector.shape[0]
    for row, value in zip(vector.row(), vector.nonzeros(), strict=True):
        entries[row] = value
    return entries
