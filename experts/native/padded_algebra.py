"""Small dense matrix operations for the backward pass, without BLAS: products, factorization, substitution.

Every matrix is row-major, and its rows are padded to whole vectors of `LANES` numbers. Padding columns never
mix with others, so their content does not matter. The register tiles of `vector_tiles` do the work.
"""

import numpy as np
from numpy.typing import NDArray

from experts.native.compilation import compiled, inlined
from experts.native.vector_code import LANES, TILE_ROWS
from experts.native.vector_tiles import (
    add_product_rows,
    copy_row_in,
    eliminate_rows,
    prefetch_line,
    prefetch_line_to_write,
    set_product_rows,
    substitute_backward,
    substitute_forward,
)

FloatArray = NDArray[np.float64]

CACHE_LINE = 8
"""Numbers in one cache line."""

SMALLEST_PIVOT = 1e-14
"""A pivot below this share of its diagonal entry is rounding noise: the matrix is not positive definite."""


def padded(size: int) -> int:
    """Round a row length up to whole vectors."""
    return -(-size // LANES) * LANES


def padded_zeros(*shape: int) -> FloatArray:
    """Allocate zeros with padded rows, aligned to cache lines so that no vector straddles two."""
    extents = (*shape[:-1], padded(shape[-1]))
    size = int(np.prod(extents))
    memory = np.zeros(size + CACHE_LINE)
    start = -(memory.ctypes.data // memory.itemsize) % CACHE_LINE
    return memory[start : start + size].reshape(extents)


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


@compiled
def set_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Compute the product of a transposed matrix and a matrix: ``target = left' right``."""
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        set_product_rows(target, rows, i, 0, left, right, depth)


@compiled
def add_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add the product of a transposed matrix and a matrix: ``target += left' right``."""
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        add_product_rows(target, rows, i, 0, left, right, depth)


@compiled
def add_product_upper(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add a product known to be symmetric, on and above the diagonal only: ``target += left' right``.

    Vectors that the diagonal cuts are computed whole; entries below it are left undefined.
    """
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        add_product_rows(target, rows, i, i - i % LANES, left, right, depth)


@compiled
def add_vector_product(target: FloatArray, matrix: FloatArray, vector: FloatArray, depth: int) -> None:
    """Add the product of a transposed matrix and a vector: ``target += matrix' vector``."""
    for i in range(depth):
        row, factor = matrix[i], vector[i]
        for j in range(target.shape[0]):
            target[j] += factor * row[j]


@inlined
def copy_in(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix into one with padded rows, and zero the padding."""
    for i in range(source.shape[0]):
        copy_row_in(target, i, source, i)


@compiled
def add_block(target: FloatArray, source: FloatArray) -> None:
    """Add a matrix to the leading block of a larger one."""
    for i in range(source.shape[0]):
        target_row, source_row = target[i], source[i]
        for j in range(source.shape[1]):
            target_row[j] += source_row[j]


@compiled
def mirror_upper(matrix: FloatArray, size: int) -> None:
    """Copy the upper triangle onto the lower one."""
    for i in range(1, size):
        for j in range(i):
            matrix[i, j] = matrix[j, i]


@compiled
def factorize(matrix: FloatArray, inverse_pivots: FloatArray, size: int) -> bool:
    """Overwrite a symmetric matrix by its factor U, ``matrix = U' D U``, with ones on the diagonal of U.

    The square roots of Cholesky's factor would lengthen the chain from one pivot to the next.
    """
    for i in range(size):
        inverse_pivots[i] = SMALLEST_PIVOT * matrix[i, i]
    for i in range(size):
        pivot = matrix[i, i]
        if not (pivot > inverse_pivots[i] and 0.0 < pivot < np.inf):
            return False
        inverse_pivots[i] = 1.0 / pivot
        for row in range(i + 1, size, TILE_ROWS):
            eliminate_rows(matrix, size, row, row - row % LANES, i, inverse_pivots[i])
    for i in range(size):
        for j in range(i + 1, size):
            matrix[i, j] *= inverse_pivots[i]
    return True


@compiled
def solve_in_place(factor: FloatArray, inverse_pivots: FloatArray, right_side: FloatArray, size: int) -> None:
    """Solve ``U' D U X = right_side`` for many right sides at once, overwriting them by X."""
    for i in range(0, size, TILE_ROWS):
        substitute_forward(right_side, size, i, factor, inverse_pivots)
    for i in range(size - TILE_ROWS, -TILE_ROWS, -TILE_ROWS):
        substitute_backward(right_side, size, i, factor, inverse_pivots)


@compiled
def solve_vector_in_place(
    factor: FloatArray, inverse_pivots: FloatArray, right_side: FloatArray, size: int
) -> None:
    """Solve ``U' D U x = right_side`` for one right side, overwriting it by x."""
    for i in range(size):
        for j in range(i + 1, size):
            right_side[j] -= factor[i, j] * right_side[i]
    for i in range(size):
        right_side[i] *= inverse_pivots[i]
    for i in range(size - 1, 0, -1):
        for j in range(i):
            right_side[j] -= factor[j, i] * right_side[i]
