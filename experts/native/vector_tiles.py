"""Register tiles in LLVM IR: the building blocks of the backward pass's matrix operations.

As numba's arrays may alias, LLVM keeps no accumulator of a loop over them in a register. Here a tile of the
target, `TILE_ROWS` high and up to `TILE_VECTORS` vectors wide, stays in registers while it accumulates
``sum_l left[l, row] * right[l, :]``; a triangle is solved there before the tile is stored.

Arrays are row-major. Rows of the target and of ``right`` are padded to whole vectors; padding columns never
mix with others, so their content does not matter. Rows need no padding: a tile that would reach beyond the
matrix repeats its outermost row instead, and the valid copy of a repeated row is stored last.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from experts.native.vector_code import TILE_ROWS, Emitter


def _emit_sum_product_rows(
    typing_context: Any,
    target: Any,
    n_rows: Any,
    i: Any,
    begin: Any,
    start: Any,
    left: Any,
    right: Any,
    steps: Any,
) -> Any:
    """Emit ``target[i:i+TILE_ROWS, begin:] = start + sum_l left[l, i:i+TILE_ROWS]' right[l, begin:]``.

    For those of the rows that are less than n_rows. The l are [0, steps); if ``steps`` is an array, its row
    i / TILE_ROWS lists them, their number first. The start needs no padding; columns that it lacks are zero.
    """
    index, listed = types.intp, isinstance(steps, types.Array)
    signature = types.void(target, index, index, index, start, left, right, steps if listed else index)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, n_rows, i, begin, _, _, _, steps = arguments
        rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in range(TILE_ROWS)]
        first, end, tile_number = emit.index(0), steps, builder.sdiv(i, emit.index(TILE_ROWS))
        if listed:
            first, end = emit.index(1), emit.add(emit.number(7, tile_number, emit.index(0)), 1)

        def inner(step: Any) -> Any:
            return emit.number(7, tile_number, step) if listed else step

        def tile(j: Any, n_vectors: int) -> None:
            masks = emit.masks(4, j, n_vectors)
            sums = emit.accumulate(
                [emit.load_masked(emit.entry(4, row, j), masks) for row in rows],
                +1,
                first,
                end,
                lambda step: [emit.number(5, inner(step), row) for row in rows],
                lambda step: emit.entry(6, inner(step), j),
            )
            for row, values in zip(rows, sums, strict=True):
                emit.store_row(values, emit.entry(0, row, j))

        emit.for_strips(begin, emit.shape(0)[1], tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_layer_rows(typing_context: Any, target: Any, i: Any, start: Any, left: Any, right: Any) -> Any:
    """Emit ``target[i:i+TILE_ROWS] = start + left[i:i+TILE_ROWS] right``, as far as there are such rows."""
    signature = types.void(target, types.intp, start, left, right)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        i, (n_rows, n_columns), (depth, _) = arguments[1], emit.shape(0), emit.shape(4)
        rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in range(TILE_ROWS)]

        def tile(j: Any, n_vectors: int) -> None:
            sums = emit.accumulate(
                [emit.load_row(emit.entry(2, j), n_vectors) for _ in rows],
                +1,
                emit.index(0),
                depth,
                lambda step: [emit.number(3, row, step) for row in rows],
                lambda step: emit.entry(4, step, j),
            )
            for row, values in zip(rows, sums, strict=True):
                emit.store_row(values, emit.entry(0, row, j))

        emit.for_strips(emit.index(0), n_columns, tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_symmetric_product_rows(typing_context: Any, target: Any, i: Any, upper: Any, right: Any) -> Any:
    """Emit ``target[i:i+TILE_ROWS] = symmetric[i:i+TILE_ROWS] right``, as far as there are such rows.

    Of the symmetric matrix only the diagonal and what is above is read: elsewhere rounding errors would grow
    from product to product.
    """
    signature = types.void(target, types.intp, upper, right)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        i, (n_rows, n_columns) = arguments[1], emit.shape(0)
        rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in range(TILE_ROWS)]
        zero = ir.Constant(ir.DoubleType(), 0.0)

        def tile(j: Any, n_vectors: int) -> None:
            sums = emit.accumulate(
                [[emit.zero] * n_vectors for _ in rows],
                +1,
                emit.index(0),
                i,
                lambda step: [emit.number(2, step, row) for row in rows],
                lambda step: emit.entry(3, step, j),
            )
            for s, step in enumerate(rows):
                vectors = emit.load_row(emit.entry(3, step, j), n_vectors)
                # A repeated row counts once.
                repeated = builder.icmp_signed("==", step, rows[s - 1]) if s > 0 else cgutils.false_bit
                for r, totals in enumerate(sums):
                    entry = emit.number(2, rows[min(r, s)], rows[max(r, s)])
                    factor = emit.spread(builder.select(repeated, zero, entry))
                    sums[r] = [
                        emit.multiply_add(total, factor, vector, +1)
                        for total, vector in zip(totals, vectors, strict=True)
                    ]
            sums = emit.accumulate(
                sums,
                +1,
                emit.add(rows[-1], 1),
                n_rows,
                lambda step: [emit.number(2, row, step) for row in rows],
                lambda step: emit.entry(3, step, j),
            )
            for row, values in zip(rows, sums, strict=True):
                emit.store_row(values, emit.entry(0, row, j))

        emit.for_strips(emit.index(0), n_columns, tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_substitute_rows(
    typing_context: Any, system: Any, n_rows: Any, i: Any, begin: Any, inverse_pivots: Any
) -> Any:
    """Emit ``X[k] = -(X[k] + sum_l system[k, l] X[l]) * inverse_pivots[k]``, l > k.

    X is ``system[:, begin:]``. For rows k from i+TILE_ROWS-1 down to i, which may be negative; those after
    them are done.
    """
    signature = types.void(system, types.intp, types.intp, types.intp, inverse_pivots)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, n_rows, i, begin, _ = arguments
        rows = [emit.larger(emit.add(i, r), emit.index(0)) for r in reversed(range(TILE_ROWS))]

        def tile(j: Any, n_vectors: int) -> None:
            pointers = [emit.entry(0, row, j) for row in rows]
            sums = emit.accumulate(
                [emit.load_row(pointer, n_vectors) for pointer in pointers],
                +1,
                emit.add(i, TILE_ROWS),
                n_rows,
                lambda step: [emit.number(0, row, step) for row in rows],
                lambda step: emit.entry(0, step, j),
            )
            for r, row in enumerate(rows):
                for s in range(r):
                    factor = emit.spread(emit.number(0, row, rows[s]))
                    sums[r] = [
                        emit.multiply_add(total, factor, known, +1)
                        for total, known in zip(sums[r], sums[s], strict=True)
                    ]
                scale = emit.spread(builder.fneg(emit.number(4, row)))
                sums[r] = [builder.fmul(total, scale) for total in sums[r]]
            # Of identical rows, the one solved first is right.
            for values, pointer in reversed(list(zip(sums, pointers, strict=True))):
                emit.store_row(values, pointer)

        emit.for_strips(begin, emit.shape(0)[1], tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_factorize_rows(
    typing_context: Any, matrix: Any, n_rows: Any, i: Any, inverse_pivots: Any, smallest: Any
) -> Any:
    """Emit the elimination of rows i to i+TILE_ROWS of a symmetric matrix, [0, i) being eliminated.

    ``Y[k] = matrix[k] - sum_l Y[l, k] Y[l] / Y[l, l]``, l < k, takes the place of row k on and right of the
    diagonal, as far as there are n_rows, and 1 / Y[k, k] that of the inverse pivot. False if a pivot Y[k, k]
    is no more than its share ``smallest`` of matrix[k, k], not positive, or not finite.
    """
    signature = types.boolean(matrix, types.intp, types.intp, inverse_pivots, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, n_rows, i, _, smallest = arguments
        rows = [emit.smaller(emit.add(i, r), emit.add(n_rows, -1)) for r in range(TILE_ROWS)]
        bounds = [builder.fmul(smallest, emit.number(0, row, row)) for row in rows]
        sound = cgutils.alloca_once_value(builder, cgutils.true_bit)
        zero, one, infinite = (ir.Constant(ir.DoubleType(), value) for value in (0.0, 1.0, float("inf")))

        def tile(j: Any, n_vectors: int) -> None:
            pointers = [emit.entry(0, row, j) for row in rows]
            sums = emit.accumulate(
                [emit.load_row(pointer, n_vectors) for pointer in pointers],
                -1,
                emit.index(0),
                i,
                lambda step: [builder.fmul(emit.number(0, step, row), emit.number(3, step)) for row in rows],
                lambda step: emit.entry(0, step, j),
            )
            inverses: list[Any] = []
            for r, row in enumerate(rows):
                for s, known in enumerate(rows[:r]):
                    # A repeated row is not subtracted from itself.
                    repeated = builder.icmp_signed("==", known, row)
                    entry = builder.select(repeated, zero, emit.number(0, known, row))
                    factor = emit.spread(builder.fmul(entry, inverses[s]))
                    sums[r] = [
                        emit.multiply_add(total, factor, vector, -1)
                        for total, vector in zip(sums[r], sums[s], strict=True)
                    ]
                emit.store_row(sums[r], pointers[r])
                pivot = emit.number(0, row, row)
                inverses.append(builder.fdiv(one, pivot))
                builder.store(inverses[r], emit.entry(3, row))
                for bound, relation in ((bounds[r], ">"), (zero, ">"), (infinite, "<")):
                    fulfilled = builder.fcmp_ordered(relation, pivot, bound)
                    builder.store(builder.and_(builder.load(sound), fulfilled), sound)

        emit.for_strips(builder.sub(i, builder.srem(i, emit.index(emit.lanes))), emit.shape(0)[1], tile)
        return builder.load(sound)

    return signature, generate


def _emit_set_vector_sum(
    typing_context: Any, target: Any, start: Any, matrix: Any, vector: Any, depth: Any
) -> Any:
    """Emit ``target = start + matrix[:depth]' vector[:depth]``; only start may lack padding."""
    signature = types.void(target, start, matrix, vector, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)

        def tile(j: Any, n_vectors: int) -> None:
            (sums,) = emit.accumulate(
                [emit.load_masked(emit.entry(1, j), emit.masks(1, j, n_vectors))],
                +1,
                emit.index(0),
                arguments[4],
                lambda step: [emit.number(3, step)],
                lambda step: emit.entry(2, step, j),
            )
            emit.store_row(sums, emit.entry(0, j))

        emit.for_strips(emit.index(0), emit.shape(0)[0], tile)
        return context.get_dummy_value()

    return signature, generate


def _emit_copy_in(typing_context: Any, target: Any, source: Any) -> Any:
    """Emit ``target = source``, target with padded rows, whose padding becomes zero, source without."""
    signature = types.void(target, source)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        n_rows, _ = emit.shape(1)

        def strip(j: Any, n_vectors: int) -> None:
            masks = emit.masks(1, j, n_vectors)
            with cgutils.for_range(builder, n_rows, intp=emit.index) as loop:
                row = emit.load_masked(emit.entry(1, loop.index, j), masks)
                emit.store_row(row, emit.entry(0, loop.index, j))

        emit.for_strips(emit.index(0), emit.shape(0)[1], strip)
        return context.get_dummy_value()

    return signature, generate


def _emit_copy_row(typing_context: Any, target: Any, i: Any, source: Any, k: Any) -> Any:
    """Emit ``target[i] = source[k]`` for matrices with padded rows; the target's may be longer."""
    signature = types.void(target, types.intp, source, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        emit = Emitter(context, builder, signature, arguments)
        _, i, _, k = arguments

        def strip(j: Any, n_vectors: int) -> None:
            emit.store_row(emit.load_row(emit.entry(2, k, j), n_vectors), emit.entry(0, i, j))

        emit.for_strips(emit.index(0), emit.shape(2)[1], strip)
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
sum_product_rows: Any = intrinsic(_emit_sum_product_rows)
layer_rows: Any = intrinsic(_emit_layer_rows)
symmetric_product_rows: Any = intrinsic(_emit_symmetric_product_rows)
factorize_rows: Any = intrinsic(_emit_factorize_rows)
substitute_rows: Any = intrinsic(_emit_substitute_rows)
set_vector_sum: Any = intrinsic(_emit_set_vector_sum)
copy_in: Any = intrinsic(_emit_copy_in)
copy_row: Any = intrinsic(_emit_copy_row)
copy_row_out: Any = intrinsic(_emit_copy_row_out)
prefetch_line: Any = _prefetch_operation(write=False)
prefetch_line_to_write: Any = _prefetch_operation(write=True)
set_row_sum: Any = intrinsic(_emit_set_row_sum)
