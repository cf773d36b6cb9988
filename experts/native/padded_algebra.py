"""Small dense matrix operations for the backward pass, without BLAS: products, factorization, substitution.

Every matrix is row-major. Rows of targets are padded to whole vectors of `LANES` numbers; padding columns
never mix with others, so their content does not matter. The register tiles of `vector_tiles` do the work.
"""

import numpy as np
from numpy.typing import NDArray

from experts.native.compilation import inlined, part
from experts.native.vector_code import LANES, TILE_ROWS
from experts.native.vector_tiles import (
    factorize_rows,
    prefetch_line,
    prefetch_line_to_write,
    substitute_rows,
    sum_product_rows,
    symmetric_product_rows,
)

FloatArray = NDArray[np.float64]
Rows = int | NDArray[np.int64]
"""Rows of the matrices of a product to sum over: the first ones, or those that `nonzero_rows` lists."""

CACHE_LINE = 8
"""Numbers in one cache line."""

SMALLEST_PIVOT = 1e-14
"""A pivot below this share of its diagonal entry is rounding noise: the matrix is not positive definite."""


def padded(size: int) -> int:
    """Round a row length up to whole vectors."""
    return -(-size // LANES) * LANES


padded_in_loops = part(padded)


def padded_zeros(*shape: int) -> FloatArray:
    """Allocate zeros with padded rows, aligned to cache lines so that no vector straddles two."""
    extents = (*shape[:-1], padded(shape[-1]))
    size = int(np.prod(extents))
    memory = np.zeros(size + CACHE_LINE)
    start = -(memory.ctypes.data // memory.itemsize) % CACHE_LINE
    return memory[start : start + size].reshape(extents)


def nonzero_rows(pattern: NDArray[np.bool_]) -> NDArray[np.int64]:
    """List the rows with nonzeros in every `TILE_ROWS` columns of a pattern: their number, then the rows."""
    starts = range(0, pattern.shape[1], TILE_ROWS)
    listed = np.zeros((len(starts), 1 + len(pattern)), dtype=np.int64)
    for row, start in zip(listed, starts, strict=True):
        (found,) = np.nonzero(pattern[:, start : start + TILE_ROWS].any(axis=1))
        row[0], row[1 : 1 + len(found)] = len(found), found
    return listed


@inlined
def prefetch(array: FloatArray) -> None:
    """Prefetch a contiguous array."""
    for offset in range(0, array.size, CACHE_LINE):
        prefetch_line(array, offset)


@inlined
def prefetch_to_write(array: FloatArray) -> None:
    """Prefetch a contiguous array to write to it."""
    for offset in range(0, array.size, CACHE_LINE):
        prefetch_line_to_write(array, offset)


@part
def set_symmetric_product(target: FloatArray, upper: FloatArray, right: FloatArray) -> None:
    """Compute the product of a symmetric matrix, given on and above the diagonal, and a matrix."""
    for i in range(0, target.shape[0], TILE_ROWS):
        symmetric_product_rows(target, i, upper, right)


@part
def set_product_sum(
    target: FloatArray, start: FloatArray, left: FloatArray, right: FloatArray, rows: Rows
) -> None:
    """Compute ``target = start + left' right``."""
    n = target.shape[0]
    for i in range(0, n, TILE_ROWS):
        sum_product_rows(target, n, i, 0, start, left, right, rows)


@part
def set_product_sum_upper(
    target: FloatArray, start: FloatArray, left: FloatArray, right: FloatArray, rows: Rows
) -> None:
    """Compute ``target = start + left' right``, known to be symmetric, on and above the diagonal only.

    Vectors that the diagonal cuts are computed whole; entries before them are left undefined.
    """
    n = target.shape[0]
    for i in range(0, n, TILE_ROWS):
        sum_product_rows(target, n, i, i - i % LANES, start, left, right, rows)


@part
def add_vector_product(target: FloatArray, matrix: FloatArray, vector: FloatArray, depth: int) -> None:
    """Add the product of a transposed matrix and a vector: ``target += matrix' vector``."""
    for i in range(depth):
        row, factor = matrix[i], vector[i]
        for j in range(target.shape[0]):
            target[j] += factor * row[j]


@part
def mirror_upper(matrix: FloatArray, size: int) -> None:
    """Copy the upper triangle onto the lower one."""
    for i in range(1, size):
        for j in range(i):
            matrix[i, j] = matrix[j, i]


@part
def factorize(matrix: FloatArray, inverse_pivots: FloatArray, size: int) -> bool:
    """Overwrite a symmetric matrix by its factor U, ``matrix = U' D^-1 U``, D being the diagonal of U.

    Further columns G, right sides, become D U'^-1 G on the way. The square roots of Cholesky's factor would
    lengthen the chain from one pivot to the next.
    """
    for i in range(0, size, TILE_ROWS):
        if not factorize_rows(matrix, size, i, inverse_pivots, SMALLEST_PIVOT):
            return False
    return True


@part
def substitute(system: FloatArray, inverse_pivots: FloatArray, begin: int, size: int) -> None:
    """Solve ``matrix X = -G``, with D U'^-1 G from `factorize` from a column on, overwriting them by X."""
    for i in range(size - TILE_ROWS, -TILE_ROWS, -TILE_ROWS):
        substitute_rows(system, size, i, begin, inverse_pivots)
