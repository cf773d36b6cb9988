"""CasADi matrices that are symbolic whatever they hold: nothing, numbers only, or symbols.

CasADi's own `vertcat` makes a number matrix of numbers and refuses to differentiate it; scenes without
joints, actuators or wrist would need special cases everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi

Scalar = Any
Matrix = Any


def _binary(operation: int, name: str, *, reflected: bool = False) -> Callable[[Any, Any], Any]:
    """Operator of `Symbol`; operands that are neither SX nor plain numbers are left to CasADi's own."""
    plain = getattr(casadi.SX, name)

    def operator(self: Any, other: Any) -> Any:
        if not isinstance(other, casadi.SX):
            if type(other) is not float and type(other) is not int:
                return plain(self, other)
            other = casadi.SX(other)
        left, right = (other, self) if reflected else (self, other)
        result = casadi.SX.binary(operation, left, right)
        result.__class__ = Symbol
        return result

    return operator


class Symbol(casadi.SX):
    """An SX whose operators name the operation and the type.

    CasADi's own try one overload after the other, conversions included, which takes six times as long: that
    was half of the time of a trace.
    """

    __add__ = _binary(casadi.OP_ADD, "__add__")
    __radd__ = _binary(casadi.OP_ADD, "__radd__", reflected=True)
    __sub__ = _binary(casadi.OP_SUB, "__sub__")
    __rsub__ = _binary(casadi.OP_SUB, "__rsub__", reflected=True)
    __mul__ = _binary(casadi.OP_MUL, "__mul__")
    __rmul__ = _binary(casadi.OP_MUL, "__rmul__", reflected=True)
    __truediv__ = _binary(casadi.OP_DIV, "__truediv__")
    __rtruediv__ = _binary(casadi.OP_DIV, "__rtruediv__", reflected=True)
    __lt__ = _binary(casadi.OP_LT, "__lt__")
    __gt__ = _binary(casadi.OP_LT, "__gt__", reflected=True)
    __le__ = _binary(casadi.OP_LE, "__le__")
    __ge__ = _binary(casadi.OP_LE, "__ge__", reflected=True)

    def __neg__(self) -> Scalar:
        result = casadi.SX.unary(casadi.OP_NEG, self)
        result.__class__ = Symbol
        return result


def symbol(name: str) -> Scalar:
    made = casadi.SX.sym(name)
    made.__class__ = Symbol
    return made


def symbols(name: str, count: int) -> list[Scalar]:
    return [symbol(f"{name}_{i}") for i in range(count)]


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
