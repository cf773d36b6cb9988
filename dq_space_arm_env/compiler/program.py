"""Programs: graphs called one after another on the same block of lanes.

A Runge-Kutta step evaluates the same acceleration four times. Traced as one graph, the same thousand
operations would be compiled four times over; a `Program` compiles them once and calls them four times, on
vectors that stay in the first-level cache. The compiled program is a C function

    void kernel(int64 begin, int64 end, const int64 *buffers)

that, for every row k in [begin, end), reads row k of its input arrays and writes row k of its output arrays
(C-contiguous); `buffers` holds the arrays' addresses, inputs first. An indexed program works on the rows
index[begin], ..., index[end - 1] instead; the address of `index` (int64) comes before all others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TypeVar

from dq_space_arm_env.compiler.graph import Graph


@dataclass(frozen=True)
class Lifetime:
    """First and last call between which a buffer must keep its content, inclusive."""

    first: int  # call that writes it; -1: before all calls
    last: int  # call that needs it last

    def overlaps(self, other: Lifetime) -> bool:
        return self.first <= other.last and other.first <= self.last


@dataclass(frozen=True)
class Buffer:
    """An array that a program reads or writes."""

    name: str
    size: int  # scalars per row that the graphs see
    shared: bool = False  # an input with a single row that all rows read
    # For an output, the place of each scalar in its row, if not consecutive; other entries are left as they
    # are.
    positions: tuple[int, ...] | None = None
    stride: int = 0  # scalars per row of the array; `size` unless `positions` spreads them out
    dtype: str = ""  # "float64", "float32" or "bool"; empty for the program's precision
    # For an output, the array is stored by column, shape (size, rows). The entry after its address in
    # `buffers` is then the number of elements from one column to the next.
    by_column: bool = False

    def __post_init__(self) -> None:
        if not self.stride:
            object.__setattr__(self, "stride", self.size)


@dataclass(frozen=True)
class Call:
    """One graph applied to named buffers."""

    graph: Graph
    bindings: Mapping[str, str]


@dataclass(frozen=True)
class Loop:
    """A repeated stretch of a program's calls."""

    begin: int  # its first call
    end: int  # one past its last call
    # Buffer of one scalar: the calls repeat while it is nonzero in some lane; lanes in which it is zero must
    # pass through them unchanged.
    condition: str


@dataclass(frozen=True)
class Guard:
    """A stretch of a program's calls that is passed over while no lane of a block needs it."""

    begin: int  # its first call
    end: int  # one past its last call
    # Buffer of one scalar: the calls run if it is nonzero in some lane, then for all lanes of the block.
    condition: str


Stretch = TypeVar("Stretch", Loop, Guard)


@dataclass
class Program:
    """A sequence of calls."""

    name: str  # of the compiled function, an identifier
    inputs: Sequence[Buffer]
    outputs: Sequence[Buffer]
    calls: list[Call] = field(default_factory=list)  # a buffer that is neither input nor output is scratch
    indexed: bool = False  # a list says which rows to work on
    loops: list[Loop] = field(default_factory=list)  # the buffers they touch live through all passes
    guards: list[Guard] = field(default_factory=list)  # around single calls or whole loops
    held: set[str] = field(default_factory=set)  # buffers that derivatives take as constants, see `tangent`

    def call(self, graph: Graph, **bindings: str) -> None:
        """Append a call; `bindings` map names of the graph to buffers of other names."""
        self.calls.append(Call(graph, bindings))

    def append(self, other: Program, **buffers: str) -> None:
        """Append the calls of another program; `buffers` map names of its buffers to others."""
        begin = len(self.calls)

        def moved(stretch: Stretch) -> Stretch:
            condition = buffers.get(stretch.condition, stretch.condition)
            return replace(stretch, begin=begin + stretch.begin, end=begin + stretch.end, condition=condition)

        self.loops += map(moved, other.loops)
        self.guards += map(moved, other.guards)
        self.held |= {buffers.get(name, name) for name in other.held}
        for call in other.calls:
            names = [name for name, _ in (*call.graph.inputs, *call.graph.outputs)]
            bound = {name: call.bindings.get(name, name) for name in names}
            self.call(call.graph, **{name: buffers.get(buffer, buffer) for name, buffer in bound.items()})

    @contextmanager
    def repeated_while(self, condition: str) -> Iterator[None]:
        """Repeat the calls appended inside, at least once, while `condition` is set; see `Loop`."""
        begin = len(self.calls)
        yield
        for stretches, what in ((self.loops, "loop"), (self.guards, "guard")):
            if any(stretch.begin >= begin for stretch in stretches):
                raise ValueError(f"program {self.name!r}: a {what} inside a loop")
        self.loops.append(Loop(begin, len(self.calls), condition))

    @contextmanager
    def only_where(self, condition: str) -> Iterator[None]:
        """Run the calls appended inside only if `condition` is set in some lane of a block; see `Guard`.

        What they alone write is arbitrary where they do not run. Earlier calls have to write the condition.
        """
        begin = len(self.calls)
        if condition not in self._written():
            raise ValueError(f"program {self.name!r}: no call has written {condition!r}, a guard's condition")
        yield
        if any(guard.end > begin for guard in self.guards):
            raise ValueError(f"program {self.name!r}: a guard inside a guard")
        self.guards.append(Guard(begin, len(self.calls), condition))

    def _written(self) -> set[str]:
        return {call.bindings.get(name, name) for call in self.calls for name, _ in call.graph.outputs}

    @property
    def is_straight(self) -> bool:
        """Whether all calls run once."""
        return not self.loops and not self.guards

    @property
    def operation_count(self) -> int:
        """Arithmetic operations per row over all calls but guarded ones; a loop counts once."""
        guarded = {number for guard in self.guards for number in range(guard.begin, guard.end)}
        return sum(
            call.graph.operation_count for number, call in enumerate(self.calls) if number not in guarded
        )

    def graphs(self) -> dict[str, Graph]:
        """Graphs by name: calls of one name run one function; ValueError if they have several graphs."""
        found: dict[str, Graph] = {}
        for call in self.calls:
            known = found.setdefault(call.graph.name, call.graph)
            # Numbers of graphs may be NaN, which equals nothing.
            if known is not call.graph and repr(known) != repr(call.graph):
                raise ValueError(
                    f"program {self.name!r}: calls of two graphs named {call.graph.name!r}, should have "
                    "names of their own"
                )
        return found

    def scratch_sizes(self) -> dict[str, int]:
        """Number of vectors of every buffer, scratch included; ValueError if two calls disagree."""
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
        """Scratch buffers read before any call has written them; they start as zero."""
        known = {buffer.name for buffer in self.inputs}
        early: set[str] = set()
        for call in self.calls:
            early.update({call.bindings.get(name, name) for name, _ in call.graph.inputs} - known)
            known.update(call.bindings.get(name, name) for name, _ in call.graph.outputs)
        return early

    def read_buffers(self) -> set[str]:
        """Buffers of which some call reads an entry, or that are outputs as they are."""
        found = {buffer.name for buffer in self.outputs}
        for call in self.calls:
            slots = {node.slot[0] for node in call.graph.nodes if node.operation == "input"}
            names = (call.graph.inputs[slot][0] for slot in slots)
            found.update(call.bindings.get(name, name) for name in names)
        return found

    def lifetimes(self) -> dict[str, Lifetime]:
        """Lifetimes of the buffers: inputs from the start, outputs to the end, initial zeros always."""
        end = len(self.calls)
        always = self.read_before_written()
        used = {buffer.name: [-1] for buffer in self.inputs}
        loops = {number: loop for loop in self.loops for number in range(loop.begin, loop.end)}
        for number, call in enumerate(self.calls):
            # A buffer written in one pass of a loop may be read in the next.
            span = (loops[number].begin, loops[number].end - 1) if number in loops else (number,)
            for name, _ in (*call.graph.inputs, *call.graph.outputs):
                used.setdefault(call.bindings.get(name, name), []).extend(span)
        for guard in self.guards:
            used[guard.condition].append(guard.begin)
        for buffer in self.outputs:
            used.setdefault(buffer.name, [-1]).append(end)
        return {
            name: Lifetime(-1, end) if name in always else Lifetime(min(numbers), max(numbers))
            for name, numbers in used.items()
        }

    def check_memory(self, starts: Mapping[str, int]) -> None:
        """Refuse calls that write to memory they also read, and writes to buffers that start as zero.

        Functions of graphs promise LLVM that their outputs overlap nothing else they are given (`noalias`): a
        call that breaks the promise silently gives wrong numbers.
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


def place(sizes: Mapping[str, int], lifetimes: Mapping[str, Lifetime]) -> tuple[dict[str, int], int]:
    """Place buffers in one block of memory, sharing it between lifetimes; returns their starts and its size.

    First fit, the largest first. The vectors between calls fill the caches: the less room they take, the
    better.
    """
    starts: dict[str, int] = {}
    for name in sorted(sizes, key=lambda name: -sizes[name]):
        start = 0
        taken = [other for other in starts if lifetimes[name].overlaps(lifetimes[other])]
        for other in sorted(taken, key=starts.__getitem__):
            if starts[other] - start >= sizes[name]:
                break
            start = max(start, starts[other] + sizes[other])
        starts[name] = start
    return starts, max((starts[name] + sizes[name] for name in starts), default=0)
