"""Register tiles in LLVM IR: the building blocks of the backward pass's matrix operations.

As numba's arrays may alias, LLVM keeps no accumulator of a loop over them in a register. Here a tile of the
target, `TILE_ROWS` high and up to `TILE_VECTORS` vectors wide, stays in registers while it accumulates
``sum_l left[l, row] * right[l, :]``; a triangle is solved there before the tile is stored.

Arrays are row-major. Rows of the target and of ``right`` are padded to whole vectors; padding columns never
mix with others, so their content does not matter. Rows need no padding: a tile that would reach beyond the
matrix repeats its outermost row instead, and the valid copy of a repeated row is stored last.
"""

from typing import Any, Literal

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from experts.native.vector_code import LANES, TILE_ROWS, ZERO, Emitter


def _product_operation(start: Literal["target", "zero"]) -> Any:
    """Build the primitive that computes some rows of a product.

    It sets ``target[i:i+TILE_ROWS, begin:]`` to ``start + sum_l left[l, i:i+TILE_ROWS] right[l, begin:]``, l
    running over [0, depth), for those of the rows that are less than n_rows.
    """

    def operation(
        typing_context: Any, target: Any, n_rows: Any, i: Any, begin: Any, left: Any, right: Any, depth: Any
    ) -> Any:
        index = types.intp
        signature = types.void(target, index, index, index, left, right, index)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            emit = Emitter(context, builder, signature, arguments)
            _, n_rows, i, begin, _, _, depth = arguments
            last_row = emit.add(n_rows, -1)
            rows = [emit.smaller(emit.add(i, r), last_row) for r in range(TILE_ROWS)]

            def tile(j: Any, n_vectors: int) -> None:
                pointers = [emit.entry(0, row, j) for row in rows]
                sums = [[ZERO] * n_vectors for _ in rows]
                if start == "target":
                    sums = [emit.load_row(pointer, n_vectors) for pointer in pointers]
                sums = emit.accumulate(
                    sums,
                    +1,
                    emit.index(0),
                    depth,
                    lambda step: [emit.entry(4, step, row) for row in rows],
                    lambda step: emit.entry(5, step, j),
                )
                for pointer, values in zip(pointers, sums, strict=True):
                    emit.store_row(values, pointer)

            emit.for_strips(begin, emit.shape(0)[1], tile)
            return context.get_dummy_value()

        return signature, generate

    return intrinsic(operation)


def _substitution_operation(backward: bool) -> Any:
    """Build the primitive that solves some rows of a system with a unit triangle, those before being solved.

    Forward, it solves rows i to i+TILE_ROWS of ``factor' X = target``, factor an upper triangle with a
    diagonal of ones, [0, i) being solved, as far as there are n_rows. Backward, it solves ``factor X =
    diag(scale) target``, [i+TILE_ROWS, n_rows) being solved, and i may be negative.
    """

    def operation(typing_context: Any, target: Any, n_rows: Any, i: Any, factor: Any, scale: Any) -> Any:
        signature = types.void(target, types.intp, types.intp, factor, scale)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            emit = Emitter(context, builder, signature, arguments)
            _, n_rows, i, _, _ = arguments
            order = list(range(TILE_ROWS))
            if backward:
                rows = [emit.larger(emit.add(i, r), emit.index(0)) for r in order]
                solved = emit.add(i, TILE_ROWS), n_rows
                order.reverse()
            else:
                rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in order]
                solved = emit.index(0), i

            def coefficient(row: Any, known: Any) -> Any:
                return emit.entry(3, row, known) if backward else emit.entry(3, known, row)

            def tile(j: Any, n_vectors: int) -> None:
                pointers = [emit.entry(0, row, j) for row in rows]
                sums = [emit.load_row(pointer, n_vectors) for pointer in pointers]
                if backward:
                    scales = [emit.spread(builder.load(emit.entry(4, row))) for row in rows]
                    sums = [
                        [builder.fmul(total, factor) for total in totals]
                        for totals, factor in zip(sums, scales, strict=True)
                    ]
                sums = emit.accumulate(
                    sums,
                    -1,
                    *solved,
                    lambda step: [coefficient(row, step) for row in rows],
                    lambda step: emit.entry(0, step, j),
                )
                for position, r in enumerate(order):
                    for s in order[:position]:
                        factor = emit.spread(builder.load(coefficient(rows[r], rows[s])))
                        sums[r] = [
                            emit.multiply_add(total, factor, known, -1)
                            for total, known in zip(sums[r], sums[s], strict=True)
                        ]
                # Of identical rows, the one solved first is right.
                for r in reversed(order):
                    emit.store_row(sums[r], pointers[r])

            emit.for_strips(emit.index(0), emit.shape(0)[1], tile)
            return context.get_dummy_value()

        return signature, generate

    return intrinsic(operation)


def _emit_eliminate_rows(
    typing_context: Any, matrix: Any, n_rows: Any, i: Any, begin: Any, pivot: Any, scale: Any
) -> Any:
    """Emit ``matrix[i:i+TILE_ROWS, begin:] -= scale matrix[pivot, i:i+TILE_ROWS]' matrix[pivot, begin:]``.

    Only for those of the rows that are less than n_rows.
    """
    index = types.intp
    signature = types.void(matrix, index, index, index, index, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, n_rows, i, begin, pivot, scale = arguments
        rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in range(TILE_ROWS)]
        scaled = [builder.fmul(scale, builder.load(emit.entry(0, pivot, row))) for row in rows]

        def tile(j: Any, n_vectors: int) -> None:
            pointers = [emit.entry(0, row, j) for row in rows]
            subtracted = emit.load_row(emit.entry(0, pivot, j), n_vectors)
            sums = [
                [
                    emit.multiply_add(total, emit.spread(factor), vector, -1)
                    for total, vector in zip(emit.load_row(pointer, n_vectors), subtracted, strict=True)
                ]
                for pointer, factor in zip(pointers, scaled, strict=True)
            ]
            for pointer, values in zip(pointers, sums, strict=True):
                emit.store_row(values, pointer)

        emit.for_strips(begin, emit.shape(0)[1], tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_set_vector_sum(
    typing_context: Any, target: Any, start: Any, matrix: Any, vector: Any, depth: Any
) -> Any:
    """Emit ``target = start + matrix[:depth]' vector[:depth]``; only start may lack padding."""
    signature = types.void(target, start, matrix, vector, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        (n_start,) = emit.shape(1)

        def tile(j: Any, n_vectors: int) -> None:
            columns = [emit.add(j, c * LANES) for c in range(n_vectors)]
            starts = [emit.load_masked(emit.entry(1, k), builder.sub(n_start, k)) for k in columns]
            (sums,) = emit.accumulate(
                [starts],
                +1,
                emit.index(0),
                arguments[4],
                lambda step: [emit.entry(3, step)],
                lambda step: emit.entry(2, step, j),
            )
            emit.store_row(sums, emit.entry(0, j))

        emit.for_strips(emit.index(0), emit.shape(0)[0], tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_copy_row_in(typing_context: Any, target: Any, i: Any, source: Any, k: Any) -> Any:
    """Emit ``target[i] = source[k]``, target with padded rows, whose padding becomes zero, source without."""
    signature = types.void(target, types.intp, source, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, i, _, k = arguments
        columns = emit.shape(2)[1]
        with emit.for_vectors(columns) as j:
            value = emit.load_masked(emit.entry(2, k, j), builder.sub(columns, j))
            emit.store_vector(value, emit.entry(0, i, j))
        return context.get_dummy_value()

    return signature, generate


def _emit_copy_row_out(typing_context: Any, target: Any, i: Any, source: Any, k: Any) -> Any:
    """Emit ``target[i] = source[k]``, source with padded rows, target without."""
    signature = types.void(target, types.intp, source, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, i, _, k = arguments
        columns = emit.shape(0)[1]
        with emit.for_vectors(columns) as j:
            value = emit.load_vector(emit.entry(2, k, j))
            emit.store_masked(value, emit.entry(0, i, j), builder.sub(columns, j))
        return context.get_dummy_value()

    return signature, generate


def _prefetch_operation(*, write: bool) -> Any:
    """Build the primitive (array, offset) that prefetches a cache line; the offset counts numbers."""

    def operation(typing_context: Any, array: Any, offset: Any) -> Any:
        signature = types.void(array, types.intp)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            pointer = builder.gep(array.data, [arguments[1]])
            byte, int32 = ir.IntType(8).as_pointer(), ir.IntType(32)
            function_type = ir.FunctionType(ir.VoidType(), [byte, int32, int32, int32])
            prefetch = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0")
            purpose, into_second_level, data = int32(int(write)), int32(2), int32(1)
            builder.call(prefetch, [builder.bitcast(pointer, byte), purpose, into_second_level, data])
            return context.get_dummy_value()

        return signature, generate

    return intrinsic(operation)


def _emit_set_row_sum(
    typing_context: Any, target: Any, i: Any, source: Any, j: Any, scale: Any, other: Any, k: Any
) -> Any:
    """Emit ``target[i] = source[j] + scale * other[k]`` for matrices with padded rows."""
    index = types.intp
    signature = types.void(target, index, source, index, types.float64, other, index)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, i, _, j, scale, _, k = arguments

        def tile(column: Any, n_vectors: int) -> None:
            rows = [emit.load_row(emit.entry(p, row, column), n_vectors) for p, row in ((2, j), (5, k))]
            sums = [emit.multiply_add(a, emit.spread(scale), b, +1) for a, b in zip(*rows, strict=True)]
            emit.store_row(sums, emit.entry(0, i, column))

        emit.for_strips(emit.index(0), emit.shape(0)[1], tile)
        return context.get_dummy_value()

    return signature, generate


# Untyped, so that calls are not checked against the functions that emit the code.
set_product_rows: Any = _product_operation("zero")
add_product_rows: Any = _product_operation("target")
substitute_forward: Any = _substitution_operation(backward=False)
substitute_backward: Any = _substitution_operation(backward=True)
eliminate_rows: Any = intrinsic(_emit_eliminate_rows)
set_vector_sum: Any = intrinsic(_emit_set_vector_sum)
copy_row_in: Any = intrinsic(_emit_copy_row_in)
copy_row_out: Any = intrinsic(_emit_copy_row_out)
prefetch_line: Any = _prefetch_operation(write=False)
prefetch_line_to_write: Any = _prefetch_operation(write=True)
set_row_sum: Any = intrinsic(_emit_set_row_sum)
