"""Between arrays and registers: rows of an array become vectors with one row per lane, and back.

Arrays hold one state after another, vectors one number of several states. A square of as many rows and
columns as there are lanes is transposed in registers, by exchanging ever smaller blocks; moving its numbers
one by one would cost more than a step of the dynamics.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from llvmlite import ir

from dq_space_arm_env.compiler.emit import DOUBLE, INDEX, VectorBuilder


def gather(
    vectors: VectorBuilder, rows: Sequence[ir.Value], block: ir.Value, size: int, *, shared: bool
) -> None:
    """Read rows of an array into a block of vectors.

    Args:
        vectors: Builder to append to.
        rows: Address of each lane's row.
        block: Address of the block, `size` vectors.
        size: Numbers in a row.
        shared: Whether all lanes have the same row.
    """
    lanes = len(rows)
    if shared or lanes == 1:
        for index in range(size):
            value = _load(vectors, rows[0], index, DOUBLE)
            vectors.store(_in_all_lanes(vectors, value), block, index)
        return
    for start in _square_starts(size, lanes):
        square = _transposed(vectors, [_load(vectors, row, start, vectors.type) for row in rows])
        for column, vector in enumerate(square):
            vectors.store(vector, block, start + column)
    for index in range(size if size < lanes else 0):
        vector = ir.Constant(vectors.type, ir.Undefined)
        for lane, row in enumerate(rows):
            value = _load(vectors, row, index, DOUBLE)
            vector = vectors.ir.insert_element(vector, value, _lane(lane))
        vectors.store(vector, block, index)


def scatter(
    vectors: VectorBuilder,
    block: ir.Value,
    rows: Sequence[ir.Value],
    size: int,
    positions: Sequence[int] | None,
) -> None:
    """Write a block of vectors to rows of an array.

    Args:
        vectors: Builder to append to.
        block: Address of the block, `size` vectors.
        rows: Address of each lane's row.
        size: Numbers that are written to a row.
        positions: Where in a row each of them goes; None for one after another.
    """
    lanes = len(rows)
    whole = positions is None and 1 < lanes <= size
    for start in _square_starts(size, lanes) if whole else ():
        square = _transposed(vectors, [vectors.load(block, start + column) for column in range(lanes)])
        for row, vector in zip(rows, square, strict=True):
            _store(vectors, vector, row, start)
    for index, position in enumerate(() if whole else positions or range(size)):
        vector = vectors.load(block, index)
        for lane, row in enumerate(rows):
            value = vector if lanes == 1 else vectors.ir.extract_element(vector, _lane(lane))
            _store(vectors, value, row, position)


def _square_starts(size: int, lanes: int) -> Iterator[int]:
    """First columns of squares that cover a row; the last one overlaps its neighbor."""
    if size >= lanes:
        yield from range(0, size - lanes + 1, lanes)
        if size % lanes:
            yield size - lanes


def _transposed(vectors: VectorBuilder, rows: list[ir.Value]) -> list[ir.Value]:
    """Transpose a square of vectors: exchange off-diagonal blocks, halving their size."""
    lanes = len(rows)
    rows = list(rows)
    distance = lanes // 2
    while distance:
        for upper in range(lanes):
            if upper & distance:
                continue
            lower = upper + distance
            a, b = rows[upper], rows[lower]
            from_upper = [lane if not lane & distance else lanes + lane - distance for lane in range(lanes)]
            from_lower = [lane + distance if not lane & distance else lanes + lane for lane in range(lanes)]
            rows[upper] = vectors.ir.shuffle_vector(a, b, _mask(from_upper))
            rows[lower] = vectors.ir.shuffle_vector(a, b, _mask(from_lower))
        distance //= 2
    return rows


def _mask(lanes: Sequence[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))


def _lane(index: int) -> ir.Constant:
    return ir.IntType(32)(index)


def _in_all_lanes(vectors: VectorBuilder, value: ir.Value) -> ir.Value:
    if vectors.target.lanes == 1:
        return value
    vector: ir.Value = ir.Constant(vectors.type, ir.Undefined)
    for lane in range(vectors.target.lanes):
        vector = vectors.ir.insert_element(vector, value, _lane(lane))
    return vector


def _load(vectors: VectorBuilder, row: ir.Value, index: int, kind: ir.Type) -> ir.Value:
    address = vectors.ir.gep(row, [INDEX(index)], source_etype=DOUBLE)
    return vectors.ir.load(address, align=8, typ=kind)


def _store(vectors: VectorBuilder, value: ir.Value, row: ir.Value, index: int) -> None:
    vectors.ir.store(value, vectors.ir.gep(row, [INDEX(index)], source_etype=DOUBLE), align=8)
