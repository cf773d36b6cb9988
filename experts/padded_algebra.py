"""Small dense matrix operations for the backward sweep, without BLAS: products, Cholesky, substitutions.

Every matrix is row-major, and its rows are padded with zeros to whole vectors of `LANES` numbers. All work
goes through one primitive, written in LLVM IR because numba's arrays may alias and LLVM then keeps no
accumulator in a register: a tile of the target, a few rows high and one vector wide, gathers ``sum_l
left[l, row] * right[l, :]``. Padding columns never mix with others, so whatever they hold stays there.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from experts.compilation import compiled

FloatArray = NDArray[np.float64]

LANES = 8
"""Numbers in one vector: an AVX-512 register; LLVM splits it where registers are narrower."""

CACHE_LINE = 8
"""Numbers in one cache line."""

TILE_ROWS = 4
"""Rows of a product tile: their accumulators fit in the registers of AVX2 as well."""

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


def _tile_operation(rows: int, start: str, sign: int) -> Any:
    """Build the primitive that computes one tile of a product.

    It sets ``target[i:i+rows, j:j+LANES]`` to ``start + sign * sum_l left[l, i:i+rows] right[l, j:j+LANES]``.

    Args:
        rows: Height of the tile.
        start: "target" to add to what is there, "zero" to overwrite it.
        sign: +1 or -1.

    Returns:
        A numba intrinsic (target, i, j, left, right, depth), l running over [0, depth).
    """

    def operation(typing_context: Any, target: Any, i: Any, j: Any, left: Any, right: Any, depth: Any) -> Any:
        signature = types.void(target, types.intp, types.intp, left, right, types.intp)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            double, index = ir.DoubleType(), context.get_value_type(types.intp)
            vector = ir.VectorType(double, LANES)

            def entry(position: int, row: Any, column: Any) -> Any:
                array_type = signature.args[position]
                array = context.make_array(array_type)(context, builder, arguments[position])
                return cgutils.get_item_pointer(context, builder, array_type, array, [row, column])

            def load_vector(pointer: Any) -> Any:
                return builder.load(builder.bitcast(pointer, vector.as_pointer()), align=8)

            i, j, depth = arguments[1], arguments[2], arguments[5]
            targets = [entry(0, builder.add(i, index(r)), j) for r in range(rows)]
            zero = ir.Constant(vector, [0.0] * LANES)
            starts = [load_vector(pointer) if start == "target" else zero for pointer in targets]
            sums = [cgutils.alloca_once_value(builder, value) for value in starts]
            with cgutils.for_range(builder, depth, intp=index) as loop:
                row = load_vector(entry(4, loop.index, j))
                for r, total in enumerate(sums):
                    factor = builder.load(entry(3, loop.index, builder.add(i, index(r))))
                    first = builder.insert_element(
                        ir.Constant(vector, ir.Undefined), factor, ir.Constant(ir.IntType(32), 0)
                    )
                    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
                    spread = builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)
                    product = builder.fmul(spread, row, flags=("contract",))
                    combine = builder.fadd if sign > 0 else builder.fsub
                    builder.store(combine(builder.load(total), product, flags=("contract",)), total)
            for pointer, total in zip(targets, sums, strict=True):
                builder.store(builder.load(total), builder.bitcast(pointer, vector.as_pointer()), align=8)
            return context.get_dummy_value()

        return signature, generate

    return intrinsic(operation)


_set_tile = _tile_operation(TILE_ROWS, "zero", +1)
_add_tile = _tile_operation(TILE_ROWS, "target", +1)
_add_row_tile = _tile_operation(1, "target", +1)
_subtract_row_tile = _tile_operation(1, "target", -1)


def _emit_prefetch(typing_context: Any, array: Any, offset: Any) -> Any:
    """Emit the code of `_prefetch_line(array, offset)`, offset in numbers from the array's start."""
    signature = types.void(array, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        pointer = builder.gep(array.data, [arguments[1]])
        byte, int32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [byte, int32, int32, int32])
        prefetch = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0")
        read, into_second_level, data = int32(0), int32(2), int32(1)
        builder.call(prefetch, [builder.bitcast(pointer, byte), read, into_second_level, data])
        return context.get_dummy_value()

    return signature, generate


_prefetch_line: Any = intrinsic(_emit_prefetch)


@compiled
def prefetch(array: FloatArray) -> None:
    """Ask for a contiguous array to be brought near the processor while it works on something else.

    Args:
        array: Any shape.
    """
    for offset in range(0, array.size, CACHE_LINE):
        _prefetch_line(array, offset)


@compiled
def set_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Compute the product of a transposed matrix and a matrix: ``target = left' right``.

    Args:
        target: Shape (n, m), n a multiple of `TILE_ROWS`, m of `LANES`.
        left: Shape (>= depth, >= n).
        right: Shape (>= depth, >= m).
        depth: Number of rows that take part.
    """
    for i in range(0, target.shape[0], TILE_ROWS):
        for j in range(0, target.shape[1], LANES):
            _set_tile(target, i, j, left, right, depth)


@compiled
def add_product_upper(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add a product known to be symmetric, on and above the diagonal only: ``target += left' right``.

    Tiles that the diagonal cuts are computed whole; entries below it are left undefined.

    Args:
        target: Shape (n, m), n a multiple of `TILE_ROWS`, m of `LANES`.
        left: Shape (>= depth, >= n).
        right: Shape (>= depth, >= m).
        depth: Number of rows that take part.
    """
    for i in range(0, target.shape[0], TILE_ROWS):
        for j in range(i - i % LANES, target.shape[1], LANES):
            _add_tile(target, i, j, left, right, depth)


@compiled
def add_plain_product(target: FloatArray, left: FloatArray, right: FloatArray, depth: int) -> None:
    """Add the product of two matrices: ``target += left right``.

    Args:
        target: Shape (n, m), n any number, m a multiple of `LANES`.
        left: Shape (n, >= depth).
        right: Shape (>= depth, >= m).
        depth: Number of columns of `left`, and rows of `right`, that take part.
    """
    transposed, rows = left.T, target.shape[0]
    for j in range(0, target.shape[1], LANES):
        for i in range(0, rows - rows % TILE_ROWS, TILE_ROWS):
            _add_tile(target, i, j, transposed, right, depth)
        for i in range(rows - rows % TILE_ROWS, rows):
            _add_row_tile(target, i, j, transposed, right, depth)


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


@compiled
def copy_block(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix into the leading block of a larger one.

    Args:
        target: Shape (>= n, >= m).
        source: Shape (n, m).
    """
    for i in range(source.shape[0]):
        target_row, source_row = target[i], source[i]
        for j in range(source.shape[1]):
            target_row[j] = source_row[j]


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
def factorize(matrix: FloatArray, inverse_diagonal: FloatArray, size: int) -> bool:
    """Overwrite a symmetric matrix by its Cholesky factor U, ``matrix = U' U``.

    Args:
        matrix: Upper triangle of the matrix, shape (>= size, padded(size)); undefined below it afterwards.
        inverse_diagonal: Receives 1 / U[i, i], shape (>= size,).
        size: Size of the leading block.

    Returns:
        False if the matrix is not positive definite, or not finite.
    """
    for i in range(size):
        diagonal = matrix[i, i]
        for j in range(i - i % LANES, matrix.shape[1], LANES):
            _subtract_row_tile(matrix, i, j, matrix, matrix, i)
        pivot = matrix[i, i]
        if not (pivot > SMALLEST_PIVOT * diagonal and pivot < np.inf):
            return False
        inverse_diagonal[i] = 1.0 / np.sqrt(pivot)
        for j in range(i, size):
            matrix[i, j] *= inverse_diagonal[i]
    return True


@compiled
def solve_in_place(
    factor: FloatArray, inverse_diagonal: FloatArray, right_side: FloatArray, size: int
) -> None:
    """Solve ``U' U X = right_side`` for many right sides at once, overwriting them by X.

    Args:
        factor: U from `factorize`, shape (>= size, padded(size)).
        inverse_diagonal: 1 / U[i, i], shape (>= size,).
        right_side: Shape (>= size, m), m a multiple of `LANES`.
        size: Number of unknowns.
    """
    columns = right_side.shape[1]
    for i in range(size):
        for j in range(0, columns, LANES):
            _subtract_row_tile(right_side, i, j, factor, right_side, i)
        for j in range(columns):
            right_side[i, j] *= inverse_diagonal[i]
    transposed = factor.T
    for i in range(size - 1, -1, -1):
        below = right_side[i + 1 :]
        for j in range(0, columns, LANES):
            _subtract_row_tile(right_side, i, j, transposed[i + 1 :], below, size - 1 - i)
        for j in range(columns):
            right_side[i, j] *= inverse_diagonal[i]


@compiled
def solve_vector_in_place(
    factor: FloatArray, inverse_diagonal: FloatArray, right_side: FloatArray, size: int
) -> None:
    """Solve ``U' U x = right_side`` for one right side, overwriting it by x.

    Args:
        factor: U from `factorize`, shape (>= size, >= size).
        inverse_diagonal: 1 / U[i, i], shape (>= size,).
        right_side: Shape (>= size,).
        size: Number of unknowns.
    """
    for i in range(size):
        right_side[i] *= inverse_diagonal[i]
        for j in range(i + 1, size):
            right_side[j] -= factor[i, j] * right_side[i]
    for i in range(size - 1, -1, -1):
        total = right_side[i]
        for j in range(i + 1, size):
            total -= factor[i, j] * right_side[j]
        right_side[i] = total * inverse_diagonal[i]
