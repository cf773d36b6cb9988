"""From a program to machine code: the loop over rows, LLVM's module, the object file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from llvmlite import ir

from dq_space_arm_env.common.host_machine import host_machine
from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.emit import emit_graph
from dq_space_arm_env.compiler.program import Buffer, Program, place
from dq_space_arm_env.compiler.transpose import ArrayAccess
from dq_space_arm_env.compiler.vector_builder import ELEMENTS, INDEX, POINTER, BlockBuilder, Target

_LARGEST_FRAME = 2**18
"""Bytes of a program's scratch memory on the stack, of which a thread may have half a megabyte."""


def assembly(program: Program, lanes: int, precision: str = "float64") -> str:
    """LLVM assembly of a program that works on `lanes` rows at a time, before optimization."""
    module = ir.Module(program.name)
    emit_program(module, program, Target(lanes, host_machine().fused, precision))
    return str(module)


def build_program(program: Program, lanes: int, precision: str = "float64") -> tuple[bytes, dict[str, Any]]:
    """Compile a program; returns the object file and the metadata that `kernels.bound.BoundKernel` reads."""

    def noted(buffer: Buffer) -> list[Any]:
        return [
            buffer.name,
            buffer.size if buffer.by_column else buffer.stride,
            buffer.shared,
            buffer.dtype or precision,
            buffer.by_column,
        ]

    metadata = {
        "inputs": [noted(buffer) for buffer in program.inputs],
        "outputs": [noted(buffer) for buffer in program.outputs],
        "operations": program.operation_count,
        "indexed": program.indexed,
    }
    return native.compile_to_object(assembly(program, lanes, precision)), metadata


def emit_program(module: ir.Module, program: Program, target: Target) -> None:
    """Add a program to a module as an external function, with the graphs that it calls.

    The last block of a batch that is not a multiple of the lanes repeats its last row in the lanes left over:
    they read and write the same values as the lane that owns the row.
    """
    sizes, zeroed = program.scratch_sizes(), program.read_before_written()
    functions = {name: emit_graph(module, graph, target) for name, graph in program.graphs().items()}
    kernel = ir.Function(module, ir.FunctionType(ir.VoidType(), [INDEX, INDEX, POINTER]), program.name)
    begin, end, addresses = kernel.args
    entry = kernel.append_basic_block("entry")
    head, body, done = (kernel.append_basic_block(name) for name in ("head", "body", "done"))
    builder = ir.IRBuilder(entry)
    vectors = BlockBuilder(builder, target)
    # Each array's address, and the place on the stack of every buffer's vectors, stay fixed over the loop.
    arrays = _Arrays(builder, program, addresses)
    starts, total = place(sizes, program.lifetimes())
    program.check_memory(starts)
    scratch, borrowed = _scratch(vectors, max(total, 1))
    blocks = {name: vectors.address(scratch, start) for name, start in starts.items()}
    for name in zeroed:
        _clear(builder, blocks[name], vectors.alignment * sizes[name])
    builder.branch(head)

    builder.position_at_end(head)
    row = builder.phi(INDEX)
    row.add_incoming(begin, entry)
    builder.cbranch(builder.icmp_signed("<", row, end), body, done)

    builder.position_at_end(body)
    last = builder.sub(end, INDEX(1))
    rows = [arrays.row_number(_clamped(builder, row, lane, last)) for lane in range(target.lanes)]
    access = {dtype: ArrayAccess(vectors, dtype) for dtype in ELEMENTS}
    read = program.read_buffers()
    for buffer in program.inputs:
        if buffer.name not in read:
            continue
        lanes = arrays.rows_of(buffer, rows, target)
        element = access[buffer.dtype or target.precision]
        element.gather(lanes, blocks[buffer.name], buffer.size, shared=buffer.shared)
    _emit_calls(vectors, kernel, program, functions, blocks)
    for buffer in program.outputs:
        element, block = access[buffer.dtype or target.precision], blocks[buffer.name]
        if buffer.by_column:
            address, pitch = arrays.addresses[buffer.name], arrays.pitches[buffer.name]
            if program.indexed or target.lanes == 1:
                element.scatter_columns(block, address, pitch, rows, buffer.size)
            else:
                element.scatter_adjacent(block, address, pitch, row, end, buffer.size)
        else:
            element.scatter(block, arrays.rows_of(buffer, rows, target), buffer.size, buffer.positions)
    row.add_incoming(builder.add(row, INDEX(target.lanes)), builder.block)
    builder.branch(head)

    builder.position_at_end(done)
    if borrowed is not None:
        builder.call(ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), "free"), [borrowed])
    builder.ret_void()


def _scratch(vectors: BlockBuilder, count: int) -> tuple[ir.Value, ir.Value | None]:
    """Memory for so many vectors: on the stack, or, where threads might overflow theirs, to be freed."""
    builder, size = vectors.ir, count * vectors.alignment
    if size <= _LARGEST_FRAME:
        stack = builder.alloca(vectors.type, size=INDEX(count))
        stack.align = vectors.alignment
        return stack, None
    allocate = ir.Function(builder.module, ir.FunctionType(POINTER, [INDEX]), "malloc")
    borrowed = builder.call(allocate, [INDEX(size + vectors.alignment)])
    beyond = builder.add(builder.ptrtoint(borrowed, INDEX), INDEX(vectors.alignment - 1))
    return builder.inttoptr(builder.and_(beyond, INDEX(-vectors.alignment)), POINTER), borrowed


def _emit_calls(
    vectors: BlockBuilder,
    kernel: ir.Function,
    program: Program,
    functions: Mapping[str, ir.Function],
    blocks: Mapping[str, ir.Value],
) -> None:
    """Emit the calls of a program on its blocks of vectors, with the loops and guards around them."""
    builder = vectors.ir
    for position, call in enumerate(program.calls):
        for guard in program.guards:
            if guard.begin == position:
                needed, passed = (kernel.append_basic_block(name) for name in ("needed", "passed"))
                builder.cbranch(vectors.any_nonzero(blocks[guard.condition]), needed, passed)
                builder.position_at_end(needed)
        for loop in program.loops:
            if loop.begin == position:
                repeated = kernel.append_basic_block("repeated")
                builder.branch(repeated)
                builder.position_at_end(repeated)
        names = [name for name, _ in (*call.graph.inputs, *call.graph.outputs)]
        builder.call(functions[call.graph.name], [blocks[call.bindings.get(name, name)] for name in names])
        for loop in program.loops:
            if loop.end == position + 1:
                after = kernel.append_basic_block("after")
                builder.cbranch(vectors.any_nonzero(blocks[loop.condition]), repeated, after)
                builder.position_at_end(after)
        for guard in program.guards:
            if guard.end == position + 1:
                builder.branch(passed)
                builder.position_at_end(passed)


class _Arrays:
    """Addresses of the arrays of a program, read from `buffers` once."""

    def __init__(self, builder: ir.IRBuilder, program: Program, buffers: ir.Value) -> None:
        self._builder = builder
        self._position = 0
        self._buffers = buffers
        self._index = builder.inttoptr(self._next(), POINTER) if program.indexed else None
        self.addresses: dict[str, ir.Value] = {}
        self.pitches: dict[str, ir.Value] = {}
        for buffer in (*program.inputs, *program.outputs):
            self.addresses[buffer.name] = builder.inttoptr(self._next(), POINTER)
            if buffer.by_column:
                self.pitches[buffer.name] = self._next()

    def _next(self) -> ir.Value:
        slot = self._builder.gep(self._buffers, [INDEX(self._position)], source_etype=INDEX)
        self._position += 1
        return self._builder.load(slot, typ=INDEX)

    def row_number(self, position: ir.Value) -> ir.Value:
        """Row at a position: itself, or the entry of the list of rows."""
        if self._index is None:
            return position
        slot = self._builder.gep(self._index, [position], source_etype=INDEX)
        return self._builder.load(slot, typ=INDEX)

    def rows_of(self, buffer: Buffer, rows: list[ir.Value], target: Target) -> list[ir.Value]:
        """Addresses of the rows of a block of lanes."""
        array = self.addresses[buffer.name]
        if buffer.shared:
            return [array] * len(rows)
        element = ELEMENTS[buffer.dtype or target.precision]
        stride = INDEX(buffer.stride)
        return [
            self._builder.gep(array, [self._builder.mul(row, stride)], source_etype=element) for row in rows
        ]


def _clear(builder: ir.IRBuilder, block: ir.Value, size: int) -> None:
    """Set a block of the stack to zero."""
    arguments = [POINTER, ir.IntType(8), INDEX, ir.IntType(1)]
    signature = ir.FunctionType(ir.VoidType(), arguments)
    memset = builder.module.declare_intrinsic("llvm.memset.p0.i64", (), signature)
    builder.call(memset, [block, ir.IntType(8)(0), INDEX(size), ir.IntType(1)(0)])


def _clamped(builder: ir.IRBuilder, row: ir.Value, lane: int, last: ir.Value) -> ir.Value:
    if lane == 0:
        return row
    wanted = builder.add(row, INDEX(lane))
    return builder.select(builder.icmp_signed("<", wanted, last), wanted, last)
