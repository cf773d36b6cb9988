"""Vector code in LLVM IR for numba: loads and stores, sums in registers, loops over columns."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from dq_space_arm_env.common.host_machine import host_machine

LANES = host_machine().lanes
"""Numbers in double precision in one vector register of this processor; twice as many in single."""

TILE_ROWS = 3
"""Rows of a tile."""
TILE_VECTORS = 5 if LANES == 8 else 3
"""Most vectors in a row of a tile: nine sums hide the latency of an addition and fit in sixteen registers;
processors with vectors of eight numbers have 32."""

_INT32 = ir.IntType(32)
_CONTRACT = ("contract",)


class Emitter:
    """Emits the code of one call of an intrinsic; arguments are addressed by position.

    Attributes:
        lanes: How many numbers, of the type of the first argument, an array, are in a vector.
        vector: Type of a vector.
        zero: Vector of zeros.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.context, self.builder, self.arguments = context, builder, arguments
        self.index = context.get_value_type(types.intp)
        self._types = signature.args
        number = signature.args[0].dtype
        self._bytes = number.bitwidth // 8
        self.lanes = 8 * LANES // self._bytes
        self.vector = ir.VectorType(context.get_value_type(number), self.lanes)
        self.zero = ir.Constant(self.vector, [0.0] * self.lanes)
        self._mask_type = ir.VectorType(ir.IntType(1), self.lanes)

    def shape(self, position: int) -> list[Any]:
        """Extents of an array argument."""
        return list(cgutils.unpack_tuple(self.builder, self._array(position).shape))

    def entry(self, position: int, *indices: Any) -> Any:
        """Address of an entry of an array argument."""
        array_type, array = self._types[position], self._array(position)
        return cgutils.get_item_pointer(self.context, self.builder, array_type, array, indices)

    def load_vector(self, pointer: Any) -> Any:
        """Load a vector from an address."""
        place = self.builder.bitcast(pointer, self.vector.as_pointer())
        return self.builder.load(place, align=self._bytes)

    def store_vector(self, value: Any, pointer: Any) -> None:
        """Store a vector at an address."""
        place = self.builder.bitcast(pointer, self.vector.as_pointer())
        self.builder.store(value, place, align=self._bytes)

    def spread(self, scalar: Any) -> Any:
        """Broadcast a number to a vector."""
        vector_type = ir.VectorType(scalar.type, self.lanes)
        undefined, zeros = (
            ir.Constant(vector_type, ir.Undefined),
            ir.Constant(ir.VectorType(_INT32, self.lanes), None),
        )
        first = self.builder.insert_element(undefined, scalar, _INT32(0))
        return self.builder.shuffle_vector(first, undefined, zeros)

    def multiply_add(self, total: Any, left: Any, right: Any, sign: int) -> Any:
        """Total + sign * left * right, fused where the processor can."""
        product = self.builder.fmul(left, right, flags=_CONTRACT)
        combine = self.builder.fadd if sign > 0 else self.builder.fsub
        return combine(total, product, flags=_CONTRACT)

    def number(self, position: int, *indices: Any) -> Any:
        """An entry of an array argument."""
        return self.builder.load(self.entry(position, *indices))

    def add(self, position: Any, offset: int) -> Any:
        """An index plus an offset."""
        return self.builder.add(position, self.index(offset)) if offset else position

    def smaller(self, left: Any, right: Any) -> Any:
        """The smaller of two indices."""
        return self.builder.select(self.builder.icmp_signed("<", left, right), left, right)

    def larger(self, left: Any, right: Any) -> Any:
        """The larger of two indices."""
        return self.builder.select(self.builder.icmp_signed(">", left, right), left, right)

    def for_strips(self, begin: Any, end: Any, body: Callable[[Any, int], None]) -> None:
        """Emit a loop over columns: body(first column, number of vectors), as wide as a tile may be."""
        vectors = self.builder.sdiv(self.builder.sub(end, begin), self.index(self.lanes))
        whole = self.builder.sdiv(vectors, self.index(TILE_VECTORS))
        width = self.index(TILE_VECTORS * self.lanes)
        with cgutils.for_range(self.builder, whole, intp=self.index) as loop:
            body(self.builder.add(begin, self.builder.mul(loop.index, width)), TILE_VECTORS)
        rest = self.builder.srem(vectors, self.index(TILE_VECTORS))
        begin_rest = self.builder.add(begin, self.builder.mul(whole, width))
        for n_vectors in range(1, TILE_VECTORS):
            with self.builder.if_then(self.builder.icmp_signed("==", rest, self.index(n_vectors))):
                body(begin_rest, n_vectors)

    @contextmanager
    def for_vectors(self, end: Any) -> Iterator[Any]:
        """Emit a loop over the vectors of a row; the last may reach beyond the end."""
        zero, step = self.index(0), self.index(self.lanes)
        with cgutils.for_range_slice(self.builder, zero, end, step, intp=self.index) as (column, _):
            yield column

    def accumulate(
        self,
        sums: list[list[Any]],
        sign: int,
        first: Any,
        last: Any,
        factors: Callable[[Any], list[Any]],
        row: Callable[[Any], Any],
    ) -> list[list[Any]]:
        """Emit a loop over steps that adds sign * factors(step)[r] * row(step)[c] to sums[r][c]."""
        slots = [[cgutils.alloca_once_value(self.builder, value) for value in values] for values in sums]
        with cgutils.for_range_slice(self.builder, first, last, self.index(1), intp=self.index) as (step, _):
            vectors = self.load_row(row(step), len(slots[0]))
            for factor, totals in zip(factors(step), slots, strict=True):
                spread = self.spread(factor)
                for total, vector in zip(totals, vectors, strict=True):
                    old = self.builder.load(total)
                    self.builder.store(self.multiply_add(old, spread, vector, sign), total)
        return [[self.builder.load(slot) for slot in totals] for totals in slots]

    def load_row(self, pointer: Any, n_vectors: int) -> list[Any]:
        """Load the vectors of a tile's row."""
        return [self.load_vector(self._offset(pointer, c)) for c in range(n_vectors)]

    def store_row(self, values: Iterable[Any], pointer: Any) -> None:
        """Store the vectors of a tile's row."""
        for c, value in enumerate(values):
            self.store_vector(value, self._offset(pointer, c))

    def masks(self, position: int, column: Any, n_vectors: int) -> list[Any]:
        """Masks of the vectors that begin at a column of an array argument, which may have fewer columns."""
        extent = self.shape(position)[-1]
        columns = [self.add(column, c * self.lanes) for c in range(n_vectors)]
        return [self._mask(self.builder.sub(extent, first)) for first in columns]

    def load_masked(self, pointer: Any, masks: list[Any]) -> list[Any]:
        """Load the vectors of a tile's row, zeros where their masks are off."""
        arguments = [self.vector.as_pointer(), _INT32, self._mask_type, self.vector]
        load = self._masked_function("load", ir.FunctionType(self.vector, arguments))
        vectors = []
        for c, mask in enumerate(masks):
            address = self.builder.bitcast(self._offset(pointer, c), self.vector.as_pointer())
            vectors.append(self.builder.call(load, [address, _INT32(self._bytes), mask, self.zero]))
        return vectors

    def store_masked(self, value: Any, pointer: Any, n_numbers: Any) -> None:
        """Store the first n_numbers of a vector at an address."""
        arguments = [self.vector, self.vector.as_pointer(), _INT32, self._mask_type]
        store = self._masked_function("store", ir.FunctionType(ir.VoidType(), arguments))
        address = self.builder.bitcast(pointer, self.vector.as_pointer())
        self.builder.call(store, [value, address, _INT32(self._bytes), self._mask(n_numbers)])

    def _mask(self, n_numbers: Any) -> Any:
        """Mask of the lanes below a number."""
        lanes = ir.Constant(ir.VectorType(self.index, self.lanes), list(range(self.lanes)))
        return self.builder.icmp_signed("<", lanes, self.spread(n_numbers))

    def _masked_function(self, name: str, function_type: Any) -> Any:
        """LLVM's masked load or store of a vector."""
        name = f"llvm.masked.{name}.v{self.lanes}f{8 * self._bytes}.p0"
        return cgutils.get_or_insert_function(self.builder.module, function_type, name)

    def _offset(self, pointer: Any, n_vectors: int) -> Any:
        return self.builder.gep(pointer, [self.index(n_vectors * self.lanes)])

    def _array(self, position: int) -> Any:
        return self.context.make_array(self._types[position])(
            self.context, self.builder, self.arguments[position]
        )
