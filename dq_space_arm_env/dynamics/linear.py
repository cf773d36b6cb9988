"""Linear algebra over plain scalars: the LDL' factorization of a small symmetric positive definite matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Scalar = Any


@dataclass(frozen=True)
class LDLFactor:
    """A = L D L' with unit lower triangular L.

    Attributes:
        lower: Strict lower triangle of L, row i holding i entries.
        inverse_diagonal: Reciprocals of D.
    """

    lower: Sequence[Sequence[Scalar]]
    inverse_diagonal: Sequence[Scalar]


def factorize_ldl(matrix: Sequence[Sequence[Scalar]]) -> LDLFactor:
    """Factorize a symmetric positive definite matrix without square roots or pivoting.

    Args:
        matrix: n x n; only the lower triangle is read.

    Returns:
        The factors.
    """
    lower: list[list[Scalar]] = []
    inverse_diagonal: list[Scalar] = []
    for i, row in enumerate(matrix):
        scaled: list[Scalar] = []  # entries of L D, which is what the elimination produces
        for j in range(i):
            entry = row[j]
            for k in range(j):
                entry = entry - scaled[k] * lower[j][k]
            scaled.append(entry)
        factors = [entry * inverse for entry, inverse in zip(scaled, inverse_diagonal, strict=True)]
        pivot = row[i]
        for entry, factor in zip(scaled, factors, strict=True):
            pivot = pivot - entry * factor
        lower.append(factors)
        inverse_diagonal.append(1.0 / pivot)
    return LDLFactor(lower, inverse_diagonal)


def solve_ldl(factor: LDLFactor, right: Sequence[Scalar]) -> list[Scalar]:
    """Solve A x = b.

    Args:
        factor: From `factorize_ldl`.
        right: b, n.

    Returns:
        x, n.
    """
    forward: list[Scalar] = []
    for i, row in enumerate(factor.lower):
        value = right[i]
        for k, entry in enumerate(row):
            value = value - entry * forward[k]
        forward.append(value)
    solution = [value * inverse for value, inverse in zip(forward, factor.inverse_diagonal, strict=True)]
    for i in reversed(range(len(solution))):
        for k in range(i):
            solution[k] = solution[k] - factor.lower[i][k] * solution[i]
    return solution
