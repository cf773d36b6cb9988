"""LDL' and LU factorizations of small matrices over plain scalars, without pivoting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Scalar = Any


@dataclass(frozen=True)
class LDLFactor:
    """A = L D L' with unit lower triangular L."""

    lower: Sequence[Sequence[Scalar]]  # strict lower triangle of L, row i holding i entries
    inverse_diagonal: Sequence[Scalar]  # of D


def factorize_ldl(matrix: Sequence[Sequence[Scalar]]) -> LDLFactor:
    """Factorize a symmetric positive definite matrix; only its lower triangle is read."""
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
    """Solve A x = right."""
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


def factorize_lu(matrix: Sequence[Sequence[Scalar]]) -> list[list[Scalar]]:
    """Factorize A = L U without pivoting; reciprocals of U's diagonal replace the diagonal.

    Meant for matrices I + A E with a positive definite A and a diagonal E >= 0, and for small changes of
    them: rounding errors are those of the symmetric I + E^1/2 A E^1/2, which needs no pivoting either,
    because scaling rows and columns by inverse factors scales every number of the elimination alike.
    """
    rows = [list(row) for row in matrix]
    for k, pivot_row in enumerate(rows):
        pivot_row[k] = 1.0 / pivot_row[k]
        for row in rows[k + 1 :]:
            row[k] = row[k] * pivot_row[k]
            for j in range(k + 1, len(rows)):
                row[j] = row[j] - row[k] * pivot_row[j]
    return rows


def solve_lu(factor: Sequence[Sequence[Scalar]], right: Sequence[Scalar]) -> list[Scalar]:
    """Solve A x = right."""
    solution: list[Scalar] = []
    for row, value in zip(factor, right, strict=True):
        for entry, known in zip(row, solution, strict=False):
            value = value - entry * known
        solution.append(value)
    for i in reversed(range(len(solution))):
        for j in range(i + 1, len(solution)):
            solution[i] = solution[i] - factor[i][j] * solution[j]
        solution[i] = solution[i] * factor[i][i]
    return solution
