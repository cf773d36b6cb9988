"""Machine code that fills faces into a picture: a depth buffer with several samples per pixel, in LLVM.

The picture is drawn row by row. A row's samples are 64-bit integers, zero where nothing is: inverse depth as
a float in the upper half, color in the lower. Positive floats compare like their bits, so the larger integer
is the nearer sample whatever the order of the faces, and one vector comparison decides for many samples.
After the last face each pixel becomes the mean of its samples, and the buffer is cleared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from llvmlite import ir

from dq_space_arm_env.common.code_cache import cache_key
from dq_space_arm_env.compiler import native

LANES = 8  # samples processed at a time; the buffer of a row is a multiple of them long
FACE_COLUMNS = 29  # numbers per face, in the order in which `_Rasterizer.fill_row` reads them

_INDEX, _WORD, _BYTE = ir.IntType(64), ir.IntType(32), ir.IntType(8)
_DOUBLE, _FLOAT, _POINTER = ir.DoubleType(), ir.FloatType(), ir.PointerType()
_SIGNATURE = ir.FunctionType(ir.VoidType(), [_INDEX, _INDEX, _POINTER])
_INDICES, _WORDS, _FLOATS = (ir.VectorType(scalar, LANES) for scalar in (_INDEX, _WORD, _FLOAT))
_NAME = "fill_faces"
# Sums of red and blue share 32 bits, as do those of green and the number of samples.
_TWO_BYTES = 0x00FF00FF
_COVERED = 1 << 24


@cache
def fill_kernel(samples: int) -> native.NativeKernel:
    """Compile the code for `samples` per pixel and direction, 1 to 15, or load it from the cache.

    The kernel's rows are those of the picture. Its buffers: first and last row of samples plus one of each
    face, (faces, 2) int32; numbers of each face, (faces, FACE_COLUMNS) float64; samples of a row of pixels,
    (samples, LANES * n) uint64, zero before and after; the picture, (height, width, 3) uint8. Then follow the
    number of faces, LANES * n and the width as plain integers.
    """

    def build() -> tuple[bytes, dict[str, Any]]:
        return native.compile_to_object(_assembly(samples)), {}

    key = cache_key(_NAME, Path(__file__).read_text(encoding="utf-8"), str(samples))
    return native.load_or_build(_NAME, key, build)


def _assembly(samples: int) -> str:
    module = ir.Module(_NAME)
    function = ir.Function(module, _SIGNATURE, _NAME)
    _Rasterizer(ir.IRBuilder(function.append_basic_block("entry")), samples).emit(*function.args)
    return str(module)


class _Rasterizer:
    """Emits the function; values in it have the names of the kernel's buffers."""

    def __init__(self, builder: ir.IRBuilder, samples: int) -> None:
        self.builder = builder
        self.samples = samples

    def emit(self, begin: ir.Value, end: ir.Value, buffers: ir.Value) -> None:
        builder = self.builder
        words = [self.read(buffers, i, _INDEX) for i in range(7)]
        rows, faces, keys, image = (builder.inttoptr(word, _POINTER) for word in words[:4])
        count, stride, width = words[4:]
        columns = builder.mul(width, _INDEX(self.samples))
        left_end, right_end = builder.alloca(_INDEX), builder.alloca(_INDEX)
        with self.loop(begin, end) as row:
            # Columns of samples between which faces of this row lie.
            builder.store(stride, left_end)
            builder.store(_INDEX(0), right_end)
            low = builder.mul(row, _INDEX(self.samples))
            high = builder.add(low, _INDEX(self.samples))
            with self.loop(_INDEX(0), count) as face:
                place = builder.mul(face, _INDEX(2))
                first = self.larger(builder.sext(self.read(rows, place, _WORD), _INDEX), low)
                last = builder.sext(self.read(rows, builder.add(place, _INDEX(1)), _WORD), _INDEX)
                last = self.smaller(last, high)
                numbers = builder.gep(faces, [builder.mul(face, _INDEX(FACE_COLUMNS))], source_etype=_DOUBLE)
                with self.loop(first, last) as sample_row:
                    offset = builder.mul(builder.sub(sample_row, low), stride)
                    line = builder.gep(keys, [offset], source_etype=_INDEX)
                    left, right = self.fill_row(numbers, sample_row, line, columns)
                    builder.store(self.smaller(builder.load(left_end, typ=_INDEX), left), left_end)
                    builder.store(self.larger(builder.load(right_end, typ=_INDEX), right), right_end)
            first = builder.udiv(builder.load(left_end, typ=_INDEX), _INDEX(self.samples))
            end_sample = builder.add(builder.load(right_end, typ=_INDEX), _INDEX(self.samples - 1))
            last = self.smaller(builder.udiv(end_sample, _INDEX(self.samples)), width)
            line = builder.gep(image, [builder.mul(builder.mul(row, width), _INDEX(3))], source_etype=_BYTE)
            with self.loop(first, last) as column:
                self.resolve(keys, stride, column, line)
        builder.ret_void()

    def fill_row(
        self, numbers: ir.Value, sample_row: ir.Value, line: ir.Value, end: ir.Value
    ) -> tuple[ir.Value, ir.Value]:
        """Draw a row of samples of a face; return its first column, and its last plus one."""
        builder = self.builder
        place = iter(range(FACE_COLUMNS))

        def number() -> ir.Value:
            return self.read(numbers, next(place), _DOUBLE)

        middle = builder.fadd(builder.sitofp(sample_row, _DOUBLE), _DOUBLE(0.5))

        def at_middle() -> ir.Value:
            """Affine function of the row: value at 0 and slope."""
            return builder.fadd(number(), builder.fmul(number(), middle))

        lefts = [at_middle() for _ in range(4)]
        rights = [at_middle() for _ in range(4)]
        left, right = lefts[0], rights[0]
        for other_left, other_right in zip(lefts[1:], rights[1:], strict=True):
            left = builder.select(builder.fcmp_ordered(">", other_left, left), other_left, left)
            right = builder.select(builder.fcmp_ordered("<", other_right, right), other_right, right)
        first, last = self.sample_after(left, end), self.sample_after(right, end)

        # Inverse depth, red, green, blue at the first sample in double precision, from there on in single.
        start = builder.fadd(builder.sitofp(first, _DOUBLE), _DOUBLE(0.5))
        functions = []
        for _ in range(4):
            at_row, slope = at_middle(), number()
            value = builder.fadd(at_row, builder.fmul(slope, start))
            functions.append((self.spread(value), self.spread(slope)))
        sieve = self.vector(builder.fptosi(number(), _INDEX), _INDICES)
        steps = ir.Constant(_INDICES, list(range(LANES)))

        first_chunk = builder.and_(first, _INDEX(-LANES))
        with self.loop(first_chunk, last, LANES) as chunk:
            columns = builder.add(self.vector(chunk, _INDICES), steps)
            inside = builder.and_(
                builder.icmp_signed(">=", columns, self.vector(first, _INDICES)),
                builder.icmp_signed("<", columns, self.vector(last, _INDICES)),
            )
            # A face with a sieve covers every other sample, like a chessboard.
            parity = builder.and_(builder.add(columns, self.vector(sample_row, _INDICES)), sieve)
            zero = ir.Constant(_INDICES, [0] * LANES)
            inside = builder.and_(inside, builder.icmp_signed("==", parity, zero))
            along = builder.sitofp(builder.sub(columns, self.vector(first, _INDICES)), _FLOATS)
            nearness, *channels = (
                builder.fadd(value, builder.fmul(slope, along)) for value, slope in functions
            )
            # A rounding error below zero would count as nearest of all.
            positive = builder.fcmp_ordered(">", nearness, self.constant(0.0))
            nearness = builder.select(positive, nearness, self.constant(0.0))
            depth = builder.zext(builder.bitcast(nearness, _WORDS), _INDICES)
            key = builder.or_(
                builder.shl(depth, ir.Constant(_INDICES, [32] * LANES)),
                builder.zext(self.packed(channels), _INDICES),
            )
            key = builder.select(inside, key, zero)
            address = builder.gep(line, [chunk], source_etype=_INDEX)
            present = builder.load(address, align=8, typ=_INDICES)
            nearer = builder.select(builder.icmp_unsigned(">", key, present), key, present)
            builder.store(nearer, address, align=8)
        return first, last

    def resolve(self, keys: ir.Value, stride: ir.Value, column: ir.Value, line: ir.Value) -> None:
        """Make a pixel the mean of its samples, with the old color for those without a face."""
        builder, samples = self.builder, self.samples
        longs, words = ir.VectorType(_INDEX, samples), ir.VectorType(_WORD, samples)
        pair = ir.Constant(words, [_TWO_BYTES] * samples)
        even = odd = ir.Constant(words, [0] * samples)
        start = builder.mul(column, _INDEX(samples))
        for row in range(samples):
            place = builder.add(start, builder.mul(stride, _INDEX(row)))
            address = builder.gep(keys, [place], source_etype=_INDEX)
            color = builder.trunc(builder.load(address, align=8, typ=longs), words)
            builder.store(ir.Constant(longs, [0] * samples), address, align=8)
            even = builder.add(even, builder.and_(color, pair))
            shifted = builder.lshr(color, ir.Constant(words, [8] * samples))
            odd = builder.add(odd, builder.and_(shifted, pair))
        even_sum, odd_sum = self.total(even), self.total(odd)
        low = _WORD(0xFFFF)
        uncovered = builder.sub(_WORD(samples**2), builder.lshr(odd_sum, _WORD(16)))
        sums = builder.and_(even_sum, low), builder.and_(odd_sum, low), builder.lshr(even_sum, _WORD(16))
        for channel, drawn in enumerate(sums):
            position = builder.add(builder.mul(column, _INDEX(3)), _INDEX(channel))
            address = builder.gep(line, [position], source_etype=_BYTE)
            behind = builder.zext(builder.load(address, typ=_BYTE), _WORD)
            whole = builder.add(drawn, builder.mul(uncovered, behind))
            rounded = builder.udiv(builder.add(whole, _WORD(samples**2 // 2)), _WORD(samples**2))
            builder.store(builder.trunc(rounded, _BYTE), address)

    def packed(self, channels: Sequence[ir.Value]) -> ir.Value:
        """Colors, 0 to 255, as bytes red, green, blue and one to count the sample."""
        builder = self.builder
        bottom, top = self.constant(0.0), self.constant(255.0)
        packed = ir.Constant(_WORDS, [_COVERED] * LANES)
        for shift, channel in zip((0, 8, 16), channels, strict=True):
            positive = builder.select(builder.fcmp_ordered(">", channel, bottom), channel, bottom)
            bounded = builder.select(builder.fcmp_ordered("<", positive, top), positive, top)
            byte = builder.fptosi(builder.fadd(bounded, self.constant(0.5)), _WORDS)
            packed = builder.or_(packed, builder.shl(byte, ir.Constant(_WORDS, [shift] * LANES)))
        return packed

    def sample_after(self, x: ir.Value, end: ir.Value) -> ir.Value:
        """First column whose center is not left of x, 0 to end."""
        builder = self.builder
        largest = builder.sitofp(end, _DOUBLE)
        ceiling = builder.module.declare_intrinsic("llvm.ceil", [_DOUBLE])
        column = builder.call(ceiling, [builder.fsub(x, _DOUBLE(0.5))])
        # Ordered comparisons are false for NaN, which becomes 0.
        column = builder.select(builder.fcmp_ordered(">", column, _DOUBLE(0.0)), column, _DOUBLE(0.0))
        return builder.fptosi(
            builder.select(builder.fcmp_ordered("<", column, largest), column, largest), _INDEX
        )

    def total(self, vector: ir.Value) -> ir.Value:
        entries = [self.builder.extract_element(vector, _WORD(i)) for i in range(self.samples)]
        total = entries[0]
        for entry in entries[1:]:
            total = self.builder.add(total, entry)
        return total

    def read(self, array: ir.Value, place: ir.Value | int, kind: ir.Type) -> ir.Value:
        index = _INDEX(place) if isinstance(place, int) else place
        return self.builder.load(self.builder.gep(array, [index], source_etype=kind), typ=kind)

    def larger(self, one: ir.Value, other: ir.Value) -> ir.Value:
        return self.builder.select(self.builder.icmp_signed(">", one, other), one, other)

    def smaller(self, one: ir.Value, other: ir.Value) -> ir.Value:
        return self.builder.select(self.builder.icmp_signed("<", one, other), one, other)

    def vector(self, scalar: ir.Value, kind: ir.VectorType) -> ir.Value:
        """A vector of equal entries."""
        single = self.builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, _WORD(0))
        places = ir.Constant(ir.VectorType(_WORD, LANES), [0] * LANES)
        return self.builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), places)

    def spread(self, value: ir.Value) -> ir.Value:
        return self.vector(self.builder.fptrunc(value, _FLOAT), _FLOATS)

    @staticmethod
    def constant(value: float) -> ir.Constant:
        return ir.Constant(_FLOATS, [value] * LANES)

    @contextmanager
    def loop(self, first: ir.Value, last: ir.Value, step: int = 1) -> Iterator[ir.Value]:
        """Loop over first, first + step, ... below last; what is emitted in the `with` block is its body."""
        builder = self.builder
        before = builder.block
        head, body, after = (builder.append_basic_block(name) for name in ("head", "body", "after"))
        builder.branch(head)
        builder.position_at_end(head)
        counter = builder.phi(_INDEX)
        counter.add_incoming(first, before)
        builder.cbranch(builder.icmp_signed("<", counter, last), body, after)
        builder.position_at_end(body)
        yield counter
        counter.add_incoming(builder.add(counter, _INDEX(step)), builder.block)
        builder.branch(head)
        builder.position_at_end(after)
