"""Programs: graphs called one after another on the same block of lanes, and the loop over blocks around them.

A Runge-Kutta step evaluates the same acceleration four times. Tracing it as one graph would compile the same
thousand operations four times over; a `Program` compiles them once and calls them four times, on vectors that
stay in the first-level cache. The compiled program is a C function

    void kernel(int64 begin, int64 end, const int64 *buffers)

that, for every row k in [begin, end), reads row k of its input arrays and writes row k of its output arrays
(C-contiguous); `buffers` holds the arrays' addresses, inputs first. An indexed program works on the rows
index[begin], ..., index[end - 1] instead; the address of `index` (int64) comes before all others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from llvmlite import ir

from dq_space_arm_env.compiler.emit import (
    ELEMENTS,
    INDEX,
    POINTER,
    Target,
    VectorBuilder,
    emit_graph,
)
from dq_space_arm_env.compiler.graph import Graph
from dq_space_arm_env.compiler.placement import Lifetime, place
from dq_space_arm_env.compiler.transpose import ArrayAccess


@dataclass(frozen=True)
class Buffer:
    """An array that a program reads or writes.

    Attributes:
        name: Name by which the calls refer to it.
        size: Number of scalars that the graphs see per row.
        shared: True for an input with a single row that all rows read.
        positions: For an output, where in its row each scalar goes, when it is not simply one after another;
            entries of the row that no scalar goes to are left as they are.
        stride: Scalars per row of the array; `size` unless `positions` spreads them out.
        dtype: Type of the array's elements, "float64", "float32" or "bool"; empty for the type that the
            program computes in.
        by_column: For an output, whether the array holds one column after another, shape (size, rows). The
            entry after its address in `buffers` is then the number of elements from one column to the next.
    """

    name: str
    size: int
    shared: bool = False
    positions: tuple[int, ...] | None = None
    stride: int = 0
    dtype: str = ""
    by_column: bool = False

    def __post_init__(self) -> None:
        """Fill in the stride."""
        if not self.stride:
            object.__setattr__(self, "stride", self.size)


@dataclass(frozen=True)
class Call:
    """One graph applied to named buffers."""

    graph: Graph
    bindings: Mapping[str, str]


@dataclass(frozen=True)
class Loop:
    """A stretch of a program's calls that is repeated.

    Attributes:
        begin: Position of its first call.
        end: Position after its last call.
        condition: Buffer of one scalar. After each pass the calls are repeated if it is not zero in some
            lane; lanes in which it is zero must pass through them unchanged.
    """

    begin: int
    end: int
    condition: str


@dataclass
class Program:
    """A sequence of calls.

    Attributes:
        name: Name of the compiled function, an identifier.
        inputs: Arrays that are read.
        outputs: Arrays that are written.
        calls: The calls in order. A buffer that is neither input nor output is scratch; it starts as zero.
        indexed: Whether a list says which rows to work on.
        loops: Stretches of the calls that are repeated, one after another; what they touch lives through all
            passes.
    """

    name: str
    inputs: Sequence[Buffer]
    outputs: Sequence[Buffer]
    calls: list[Call] = field(default_factory=list)
    indexed: bool = False
    loops: list[Loop] = field(default_factory=list)

    def call(self, graph: Graph, **bindings: str) -> None:
        """Append a call.

        Args:
            graph: The graph to evaluate.
            bindings: Buffer for each input and output of the graph whose name differs from the buffer's.
        """
        self.calls.append(Call(graph, bindings))

    @contextmanager
    def repeated_while(self, condition: str) -> Iterator[None]:
        """Repeat the calls that are appended inside, which happens at least once.

        Args:
            condition: Buffer of one scalar, see `Loop`.

        Yields:
            Nothing.

        Raises:
            ValueError: If there is a loop inside.
        """
        begin = len(self.calls)
        yield
        if any(loop.begin >= begin for loop in self.loops):
            raise ValueError(f"program {self.name!r}: a loop inside a loop")
        self.loops.append(Loop(begin, len(self.calls), condition))

    @property
    def operation_count(self) -> int:
        """Arithmetic operations per row, over all calls; a loop counts once."""
        return sum(call.graph.operation_count for call in self.calls)

    def scratch_sizes(self) -> dict[str, int]:
        """Number of vectors of every buffer, scratch included.

        Raises:
            ValueError: If two calls disagree on the size of a buffer.
        """
        sizes = {buffer.name: buffer.size for buffer in (*self.inputs, *self.outputs)}
        for call in self.calls:
            for name, size in (*call.graph.inputs, *call.graph.outputs):
                buffer = call.bindings.get(name, name)
                if sizes.setdefault(buffer, size) != size:
                    raise ValueError(
                        f"program {self.name!r}: graph {call.graph.name!r} takes {size} scalars for "
                        f"{name!r}, buffer {buffer!r} has {sizes[buffer]}"
                    )
        return sizes

    def read_before_written(self) -> set[str]:
        """Scratch buffers that some call reads before any call has written them; they start as zero."""
        known = {buffer.name for buffer in self.inputs}
        early: set[str] = set()
        for call in self.calls:
            early.update({call.bindings.get(name, name) for name, _ in call.graph.inputs} - known)
            known.update(call.bindings.get(name, name) for name, _ in call.graph.outputs)
        return early

    def lifetimes(self) -> dict[str, Lifetime]:
        """When each buffer is needed: inputs from the start, outputs to the end, initial zeros always."""
        end = len(self.calls)
        always = self.read_before_written()
        used = {buffer.name: [-1] for buffer in self.inputs}
        loops = {number: loop for loop in self.loops for number in range(loop.begin, loop.end)}
        for number, call in enumerate(self.calls):
            # What is written in one pass of a loop may be read in the next one.
            span = (loops[number].begin, loops[number].end - 1) if number in loops else (number,)
            for name, _ in (*call.graph.inputs, *call.graph.outputs):
                used.setdefault(call.bindings.get(name, name), []).extend(span)
        for buffer in self.outputs:
            used.setdefault(buffer.name, [-1]).append(end)
        return {
            name: Lifetime(-1, end) if name in always else Lifetime(min(numbers), max(numbers))
            for name, numbers in used.items()
        }

    def check_memory(self, starts: Mapping[str, int]) -> None:
        """Make sure that the compiled calls find in memory what they should.

        The functions of graphs promise LLVM that what they write lies apart from all else that they are given
        (`noalias`): a call that breaks the promise gives wrong numbers without a word.

        Args:
            starts: Where each buffer begins, see `place`.

        Raises:
            ValueError: If a graph would write to memory that it also reads, or writes twice; or if a buffer
                that starts as zero is written, so that the next rows would not find it zero.
        """
        sizes, zeroed = self.scratch_sizes(), self.read_before_written()
        for number, call in enumerate(self.calls):
            where = f"program {self.name!r}: call {number} of graph {call.graph.name!r}"
            inputs, outputs = (
                [call.bindings.get(name, name) for name, size in arrays if size]
                for arrays in (call.graph.inputs, call.graph.outputs)
            )
            for position, written in enumerate(outputs):
                if written in zeroed:
                    raise ValueError(f"{where} writes buffer {written!r}, which starts as zero for all rows")
                for other in (*inputs, *outputs[:position]):
                    apart = (
                        starts[written] + sizes[written] <= starts[other]
                        or starts[other] + sizes[other] <= starts[written]
                    )
                    if not apart:
                        raise ValueError(
                            f"{where} writes buffer {written!r}, which shares memory with {other!r}, another "
                            "of its arguments"
                        )


def emit_program(module: ir.Module, program: Program, target: Target) -> None:
    """Add a program to a module as an external function of its name, with the graphs that it calls.

    The last block of a batch that is not a multiple of the lanes repeats its last row in the lanes left over:
    they read and write the same values as the lane that owns the row.

    Args:
        module: LLVM module to add to.
        program: The program.
        target: Lanes and instructions to use.

    Raises:
        ValueError: If two calls disagree on the size of a buffer, or arguments of one share memory.
    """
    sizes, zeroed = program.scratch_sizes(), program.read_before_written()
    functions: dict[str, ir.Function] = {}
    for call in program.calls:
        if call.graph.name not in functions:
            functions[call.graph.name] = emit_graph(module, call.graph, target)

    kernel = ir.Function(module, ir.FunctionType(ir.VoidType(), [INDEX, INDEX, POINTER]), program.name)
    begin, end, addresses = kernel.args
    entry = kernel.append_basic_block("entry")
    head, body, done = (kernel.append_basic_block(name) for name in ("head", "body", "done"))
    builder = ir.IRBuilder(entry)
    vectors = VectorBuilder(builder, target)
    # Each array's address, and the place on the stack of every buffer's vectors, stay fixed over the loop.
    arrays = _Arrays(builder, program, addresses)
    starts, total = place(sizes, program.lifetimes())
    program.check_memory(starts)
    stack = builder.alloca(vectors.type, size=INDEX(max(total, 1)))
    stack.align = vectors.alignment
    blocks = {name: vectors.address(stack, start) for name, start in starts.items()}
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
    for buffer in program.inputs:
        lanes = arrays.rows_of(buffer, rows, target)
        element = access[buffer.dtype or target.precision]
        element.gather(lanes, blocks[buffer.name], buffer.size, shared=buffer.shared)
    begins, ends = ({getattr(loop, key): loop for loop in program.loops} for key in ("begin", "end"))
    for position, call in enumerate(program.calls, start=1):
        if position - 1 in begins:
            repeated = kernel.append_basic_block("repeated")
            builder.branch(repeated)
            builder.position_at_end(repeated)
        names = [name for name, _ in (*call.graph.inputs, *call.graph.outputs)]
        builder.call(functions[call.graph.name], [blocks[call.bindings.get(name, name)] for name in names])
        if position in ends:
            after = kernel.append_basic_block("after")
            builder.cbranch(vectors.any_nonzero(blocks[ends[position].condition]), repeated, after)
            builder.position_at_end(after)
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
    builder.ret_void()


class _Arrays:
    """Where the arrays of a program are, read from `buffers` once."""

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
        """The row to work on at a position: itself, or what the list of rows says."""
        if self._index is None:
            return position
        slot = self._builder.gep(self._index, [position], source_etype=INDEX)
        return self._builder.load(slot, typ=INDEX)

    def rows_of(self, buffer: Buffer, rows: list[ir.Value], target: Target) -> list[ir.Value]:
        """Where the rows of a block of lanes begin in an array."""
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
