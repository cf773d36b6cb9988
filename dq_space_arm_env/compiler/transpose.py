"""Between arrays and registers: rows of an array become vectors with one row per lane, and back.

Arrays hold one state after another, vectors one number of several states. Squares of as many columns as rows
are transposed in registers, by exchanging ever smaller blocks; moving the numbers one by one would cost more
than a step of the dynamics. Elements are converted on the way where the array's type differs from the
arithmetic's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from llvmlite import ir

from dq_space_arm_env.compiler.vector_builder import (
    BYTES,
    ELEMENTS,
    INDEX,
    POINTER,
    BlockBuilder,
    vector_type,
)

INT32 = ir.IntType(32)


class ArrayAccess:
    """Reads and writes of arrays with elements of one type, appended to a basic block."""

    def __init__(self, vectors: BlockBuilder, dtype: str) -> None:
        self.vectors = vectors
        self.dtype = dtype
        self.element = ELEMENTS[dtype]
        self.lanes = vectors.target.lanes

    def gather(self, rows: Sequence[ir.Value], block: ir.Value, size: int, *, shared: bool) -> None:
        """Read rows, one address per lane, into a block of `size` vectors; `shared`: all lanes have one."""
        vectors, lanes = self.vectors, self.lanes
        width = _square_width(size, lanes)
        if shared or width == 1:
            for index in range(size):
                if shared:
                    values = [self._load(rows[0], index, 1)] * lanes
                else:
                    values = [self._load(row, index, 1) for row in rows]
                vectors.store(self._computed(self._assembled(values)), block, index)
            return
        for start in _square_starts(size, width):
            groups = [
                self._transposed([self._load(row, start, width) for row in rows[first : first + width]])
                for first in range(0, lanes, width)
            ]
            for column, parts in enumerate(zip(*groups, strict=True)):
                vectors.store(self._computed(self._joined(list(parts))), block, start + column)

    def scatter(
        self, block: ir.Value, rows: Sequence[ir.Value], size: int, positions: Sequence[int] | None
    ) -> None:
        """Write a block of `size` vectors to rows, at `positions` in each (None: consecutively)."""
        for run in _runs(positions or range(size)):
            width = _square_width(len(run), self.lanes)
            for start in _square_starts(len(run), width):
                columns = [self._stored(block, index) for _, index in run[start : start + width]]
                self._scatter_square(columns, rows, run[start][0])

    def _scatter_square(self, columns: list[ir.Value], rows: Sequence[ir.Value], position: int) -> None:
        """Write vectors side by side, in squares of as many lanes."""
        width = len(columns)
        if width == 1:
            for lane, row in enumerate(rows):
                self._store(self._lane_of(columns[0], lane), row, position)
            return
        for first in range(0, self.lanes, width):
            square = self._transposed([self._part(column, first, width) for column in columns])
            for row, vector in zip(rows[first : first + width], square, strict=True):
                self._store(vector, row, position)

    def scatter_columns(
        self, block: ir.Value, array: ir.Value, pitch: ir.Value, rows: Sequence[ir.Value], size: int
    ) -> None:
        """Write a block of vectors to rows of an array stored by column, `pitch` elements apart."""
        builder = self.vectors.ir
        for index in range(size):
            column = builder.gep(array, [builder.mul(pitch, INDEX(index))], source_etype=self.element)
            vector = self._stored(block, index)
            for lane, row in enumerate(rows):
                address = builder.gep(column, [row], source_etype=self.element)
                builder.store(self._lane_of(vector, lane), address, align=BYTES[self.dtype])

    def scatter_adjacent(
        self, block: ir.Value, array: ir.Value, pitch: ir.Value, row: ir.Value, end: ir.Value, size: int
    ) -> None:
        """Write a block of vectors to adjacent rows `row` .. `end` - 1 of an array stored by column."""
        builder = self.vectors.ir
        for index in range(size):
            offset = builder.add(builder.mul(pitch, INDEX(index)), row)
            address = builder.gep(array, [offset], source_etype=self.element)
            self._masked_store(self._stored(block, index), address, builder.sub(end, row))

    def _masked_store(self, value: ir.Value, address: ir.Value, count: ir.Value) -> None:
        """Store the first `count` lanes."""
        builder, lanes = self.vectors.ir, self.lanes
        truths = ir.VectorType(ir.IntType(1), lanes)
        indices = ir.Constant(ir.VectorType(INDEX, lanes), list(range(lanes)))
        limit = self._filled(count, lanes)
        mask = builder.icmp_signed("<", indices, limit)
        code = {"float64": "f64", "float32": "f32", "bool": "i8"}[self.dtype]
        signature = ir.FunctionType(ir.VoidType(), [value.type, POINTER, INT32, truths])
        name = f"llvm.masked.store.v{lanes}{code}.p0"
        function = builder.module.globals.get(name) or ir.Function(builder.module, signature, name)
        builder.call(function, [value, address, INT32(BYTES[self.dtype]), mask])

    def _filled(self, value: ir.Value, lanes: int) -> ir.Value:
        builder = self.vectors.ir
        kind = ir.VectorType(value.type, lanes)
        first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, INT32(0))
        return builder.shuffle_vector(first, first, _mask([0] * lanes))

    # Conversions between the array's elements and the numbers that are computed in.

    def _computed(self, vector: ir.Value) -> ir.Value:
        """Convert elements to numbers."""
        builder, wanted = self.vectors.ir, self.vectors.type
        if self.dtype == "bool":
            return builder.uitofp(vector, wanted)
        if self.dtype == self.vectors.target.precision:
            return vector
        return builder.fptrunc(vector, wanted) if self.dtype == "float64" else builder.fpext(vector, wanted)

    def _stored(self, block: ir.Value, index: int) -> ir.Value:
        """A vector of a block converted to elements; a truth value is whether the number is not zero."""
        builder, wanted = self.vectors.ir, vector_type(self.element, self.lanes)
        vector = self.vectors.load(block, index)
        if self.dtype == "bool":
            return builder.zext(self.vectors.nonzero(vector), wanted)
        if self.dtype == self.vectors.target.precision:
            return vector
        return builder.fptrunc(vector, wanted) if self.dtype == "float32" else builder.fpext(vector, wanted)

    # Vectors of elements.

    def _transposed(self, rows: list[ir.Value]) -> list[ir.Value]:
        """Transpose a square of vectors: exchange off-diagonal blocks, halving their size."""
        width = len(rows)
        distance = width // 2
        while distance:
            for upper in range(width):
                if upper & distance:
                    continue
                lower = upper + distance
                a, b = rows[upper], rows[lower]
                from_upper = [i if not i & distance else width + i - distance for i in range(width)]
                from_lower = [i + distance if not i & distance else width + i for i in range(width)]
                rows[upper] = self.vectors.ir.shuffle_vector(a, b, _mask(from_upper))
                rows[lower] = self.vectors.ir.shuffle_vector(a, b, _mask(from_lower))
            distance //= 2
        return rows

    def _joined(self, parts: list[ir.Value]) -> ir.Value:
        """Concatenate vectors."""
        while len(parts) > 1:
            width = 2 * parts[0].type.count
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [self.vectors.ir.shuffle_vector(a, b, _mask(range(width))) for a, b in pairs]
        return parts[0]

    def _part(self, vector: ir.Value, first: int, width: int) -> ir.Value:
        """Consecutive lanes of a vector."""
        if width == self.lanes:
            return vector
        return self.vectors.ir.shuffle_vector(vector, vector, _mask(range(first, first + width)))

    def _assembled(self, values: Sequence[ir.Value]) -> ir.Value:
        """A vector from the value of each lane."""
        if len(values) == 1:
            return values[0]
        vector: ir.Value = ir.Constant(vector_type(self.element, self.lanes), ir.Undefined)
        for lane, value in enumerate(values):
            vector = self.vectors.ir.insert_element(vector, value, INT32(lane))
        return vector

    def _lane_of(self, vector: ir.Value, lane: int) -> ir.Value:
        return vector if self.lanes == 1 else self.vectors.ir.extract_element(vector, INT32(lane))

    def _load(self, row: ir.Value, index: int, width: int) -> ir.Value:
        address = self.vectors.ir.gep(row, [INDEX(index)], source_etype=self.element)
        return self.vectors.ir.load(address, align=BYTES[self.dtype], typ=vector_type(self.element, width))

    def _store(self, value: ir.Value, row: ir.Value, index: int) -> None:
        address = self.vectors.ir.gep(row, [INDEX(index)], source_etype=self.element)
        self.vectors.ir.store(value, address, align=BYTES[self.dtype])


def _runs(positions: Sequence[int]) -> list[list[tuple[int, int]]]:
    """Runs of consecutive positions in ascending order, each position with its number in the sequence."""
    runs: list[list[tuple[int, int]]] = []
    for position, index in sorted(zip(positions, range(len(positions)), strict=True)):
        if runs and runs[-1][-1][0] + 1 == position:
            runs[-1].append((position, index))
        else:
            runs.append([(position, index)])
    return runs


def _square_width(size: int, lanes: int) -> int:
    """Largest power of two that fits in both a row and a vector."""
    width = 1
    while 2 * width <= min(size, lanes):
        width *= 2
    return width


def _square_starts(size: int, width: int) -> Iterator[int]:
    """First columns of squares that cover a row; the last one overlaps its neighbor."""
    yield from range(0, size - width + 1, width)
    if size % width:
        yield size - width


def _mask(lanes: Sequence[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(INT32, len(lanes)), list(lanes))
