"""Small dense matrix operations for the backward sweep, without BLAS: products, factorization, substitutions.

Every matrix is row-major, and its rows are padded to whole vectors of `LANES` numbers. Padding columns never
mix with others, so whatever they hold stays there. The work is done in the register tiles of `vector_tiles`.
"""

import numpy as np
from numpy.typing import NDArray

from experts.compilation import compiled, inlined
from experts.vector_code import LANES, TILE_ROWS
from experts.vector_tiles import (
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
    """Round a row length up to whole vectors.

    Args:
        size: Number of entries.

    Returns:
        Smallest multiple of `LANES` that holds them.
    """
    return -(-size // LANES) * LANES


def padded_zeros(*shape: int) -> FloatArray:
    """Allocate an array with padded rows, from the beginning of a cache line: no vector straddles two.

    Args:
        shape: Extents; the last one is rounded up to whole vectors.

    Returns:
        Zeros, shape (*shape[:-1], padded(shape[-1])).
    """
    extents = (*shape[:-1], padded(shape[-1]))
    size = int(np.prod(extents))
    memory = np.zeros(size + CACHE_LINE)
    start = -(memory.ctypes.data // memory.itemsize) % CACHE_LINE
    return memory[start : start + size].reshape(extents)


@inlined
def prefetch(array: FloatArray) -> None:
    """Ask for a contiguous array to be brought near the processor while it works on something else.

    Args:
        array: Any shape.
    """
    for offset in range(0, array.size, CACHE_LINE):
        prefetch_line(array, offset)


@inlined
def prefetch_to_write(array: FloatArray) -> None:
    """Ask for a contiguous array as `prefetch` does, in order to write to it.

    Args:
        array: Any shape.
    """
    for offset in range(0, array.size, CACHE_LINE):
        prefetch_line_to_write(array, offset)


@compiled
def set_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Compute the product of a transposed matrix and a matrix: ``target = left' right``.

    Args:
        target: Shape (n, m), m a multiple of `LANES`.
        left: Shape (>= depth, >= n).
        right: Shape (>= depth, >= m).
        depth: Number of rows that take part.
    """
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        set_product_rows(target, rows, i, 0, left, right, depth)


@compiled
def add_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add the product of a transposed matrix and a matrix: ``target += left' right``.

    Args:
        target: Shape (n, m), m a multiple of `LANES`.
        left: Shape (>= depth, >= n).
        right: Shape (>= depth, >= m).
        depth: Number of rows that take part.
    """
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        add_product_rows(target, rows, i, 0, left, right, depth)


@compiled
def add_product_upper(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add a product known to be symmetric, on and above the diagonal only: ``target += left' right``.

    Vectors that the diagonal cuts are computed whole; entries below it are left undefined.

    Args:
        target: Shape (n, m), m a multiple of `LANES`.
        left: Shape (>= depth, >= n).
        right: Shape (>= depth, >= m).
        depth: Number of rows that take part.
    """
    rows = target.shape[0]
    for i in range(0, rows, TILE_ROWS):
        add_product_rows(target, rows, i, i - i % LANES, left, right, depth)


@compiled
def add_vector_product(target: FloatArray, matrix: FloatArray, vector: FloatArray, depth: int) -> None:
    """Add the product of a transposed matrix and a vector: ``target += matrix' vector``.

    Args:
        target: Shape (m,).
        matrix: Shape (>= depth, >= m).
        vector: Shape (>= depth,).
        depth: Number of rows that take part.
    """
    for i in range(depth):
        row, factor = matrix[i], vector[i]
        for j in range(target.shape[0]):
            target[j] += factor * row[j]


@inlined
def copy_in(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix into one with padded rows, and set their padding to zero.

    Args:
        target: Shape (>= n, >= padded(m)).
        source: Shape (n, m).
    """
    for i in range(source.shape[0]):
        copy_row_in(target, i, source, i)


@compiled
def add_block(target: FloatArray, source: FloatArray) -> None:
    """Add a matrix to the leading block of a larger one.

    Args:
        target: Shape (>= n, >= m).
        source: Shape (n, m).
    """
    for i in range(source.shape[0]):
        target_row, source_row = target[i], source[i]
        for j in range(source.shape[1]):
            target_row[j] += source_row[j]


@compiled
def mirror_upper(matrix: FloatArray, size: int) -> None:
    """Copy the upper triangle onto the lower one.

    Args:
        matrix: Shape (>= size, >= size).
        size: Size of the leading block.
    """
    for i in range(1, size):
        for j in range(i):
            matrix[i, j] = matrix[j, i]


@compiled
def factorize(matrix: FloatArray, inverse_pivots: FloatArray, size: int) -> bool:
    """Overwrite a symmetric matrix by its factor U, ``matrix = U' D U``, with ones on the diagonal of U.

    The square roots of Cholesky's factor would lengthen the chain from one pivot to the next.

    Args:
        matrix: Upper triangle of the matrix, shape (>= size, padded(size)); receives U above the diagonal,
            undefined elsewhere.
        inverse_pivots: Receives 1 / D[i, i], shape (>= size,).
        size: Size of the leading block.

    Returns:
        False if the matrix is not positive definite, or not finite.
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
    """Solve ``U' D U X = right_side`` for many right sides at once, overwriting them by X.

    Args:
        factor: U from `factorize`, shape (>= size, >= size).
        inverse_pivots: 1 / D[i, i], shape (>= size,).
        right_side: Shape (>= size, m), m a multiple of `LANES`.
        size: Number of unknowns.
    """
    for i in range(0, size, TILE_ROWS):
        substitute_forward(right_side, size, i, factor, inverse_pivots)
    for i in range(size - TILE_ROWS, -TILE_ROWS, -TILE_ROWS):
        substitute_backward(right_side, size, i, factor, inverse_pivots)


@compiled
def solve_vector_in_place(
    factor: FloatArray, inverse_pivots: FloatArray, right_side: FloatArray, size: int
) -> None:
    """Solve ``U' D U x = right_side`` for one right side, overwriting it by x.

    Args:
        factor: U from `factorize`, shape (>= size, >= size).
        inverse_pivots: 1 / D[i, i], shape (>= size,).
        right_side: Shape (>= size,).
        size: Number of unknowns.
    """
    for i in range(size):
        for j in range(i + 1, size):
            right_side[j] -= factor[i, j] * right_side[i]
    for i in range(size):
        right_side[i] *= inverse_pivots[i]
    for i in range(size - 1, 0, -1):
        for j in range(i):
            right_side[j] -= factor[j, i] * right_side[i]
