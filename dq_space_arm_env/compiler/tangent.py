"""Tangent programs: exact derivatives of a program's results by some of its inputs, in forward mode.

Beside each call of a graph stand calls of its tangent, one for each entry of the inputs (a direction). All
directions run the same machine code on other buffers: the tangent of buffer `k1` in direction 3 is `k1.3`.
Buffers that do not depend on the inputs, or that no wanted result depends on, have no tangents.

Loops repeat the tangents with the values, as long as the values ask for it. The result is the derivative of
the passes taken. An iteration to a fixed point stops when the values have converged; their tangents converge
at the same rate but later, so append a few more passes after the loop. Buffers that a program names in
`held`, such as the chosen lengths of substeps, count as constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dq_space_arm_env.compiler.forward_mode import (
    COEFFICIENTS,
    TANGENT,
    TangentGraphs,
    dependencies,
    tangent_graphs,
)
from dq_space_arm_env.compiler.graph import Graph, trace
from dq_space_arm_env.compiler.program import Call, Loop, Program

Names = tuple[str, ...]
"""Names of the tangent buffers of a buffer, one for each direction."""


def append_tangents(program: Program, by: Sequence[str], of: str) -> Names | None:
    """Add the calls that compute the derivatives of a buffer by the entries of inputs.

    Append own calls on the tangent buffers, see `append_for_each`, and gather them in an output, see
    `append_matrix`.

    Args:
        program: The program, changed in place; its results stay the same up to rounding.
        by: Names of the inputs, float numbers that no call overwrites.
        of: Name of the buffer to differentiate, as it is after the last call.

    Returns:
        The names of its tangent buffers, one for each entry of the inputs, in their order; None if it does
        not depend on them.

    Raises:
        ValueError: The program has no such input or buffer, overwrites the input, has tangents already, or
            has a guard.
    """
    transformation = _Transformation(program, by, of)
    program.calls, program.loops = transformation.calls, transformation.loops
    return transformation.names(of)


def append_for_each(program: Program, graph: Graph, key: str, tangents: Names, output: str) -> Names:
    """Append a call of a graph for each direction.

    Args:
        program: A program with tangents.
        graph: A graph with a single output.
        key: Name of its input that is a tangent.
        tangents: The tangent buffers.
        output: Name of the graph's results; `.0`, `.1` ... are added.

    Returns:
        The names of the results.
    """
    ((result, _),) = graph.outputs
    names = tuple(f"{output}.{number}" for number in range(len(tangents)))
    for tangent, name in zip(tangents, names, strict=True):
        program.call(graph, **{key: tangent, result: name})
    return names


def append_matrix(program: Program, tangents: Names | None, shape: tuple[int, int], output: str) -> None:
    """Append the call that gathers tangents of m numbers in one buffer, shape (m, directions), row by row.

    Args:
        program: A program with tangents.
        tangents: The tangent buffers; None for a derivative of zero.
        shape: Numbers of a tangent, and directions.
        output: Name of the buffer; entry i of direction j is its number i * directions + j.
    """
    size, count = shape

    def gather(**columns: Sequence[object]) -> dict[str, list[object]]:
        if tangents is None:
            return {output: [0.0] * (size * count)}
        return {output: [columns[f"d{j}"][i] for i in range(size) for j in range(count)]}

    sizes = {f"d{j}": size for j in range(count)} if tangents is not None else {}
    bindings = dict(zip(sizes, tangents or (), strict=True))
    program.call(trace(f"{program.name}_{output}_matrix", sizes, gather), **bindings)


class _Transformation:
    """The calls of a program with those of its tangents."""

    def __init__(self, program: Program, by: Sequence[str], of: str) -> None:
        self._program, self._by = program, by
        self._sizes = program.scratch_sizes()
        self._check(of)
        self._dependencies = {name: dependencies(graph) for name, graph in program.graphs().items()}
        self._live = self._active() & self._needed(of)
        self._graphs = self._tangent_graphs()
        self._count = sum(self._sizes[name] for name in by)
        self.calls: list[Call] = []
        self._seeded = not any(name in self._live for name in by)
        self._append_first_zeros()
        begins, places = {loop.begin for loop in program.loops}, []
        for number, call in enumerate(program.calls):
            if number in begins:
                self._append_seeds()
            places.append(len(self.calls))
            self._append(number, call)
        places.append(len(self.calls))
        self.loops = [Loop(places[loop.begin], places[loop.end], loop.condition) for loop in program.loops]

    def _check(self, of: str) -> None:
        program = self._program
        inputs = {buffer.name: buffer.dtype for buffer in program.inputs}
        if program.guards:
            raise ValueError(f"program {program.name!r} has a guard, which has no tangents")
        for name in self._by:
            if name not in inputs or inputs[name] == "bool":
                raise ValueError(f"program {program.name!r} has no input {name!r} of float numbers")
        if any(f"{name}.0" in self._sizes for name in (*self._by, of)):
            raise ValueError(f"program {program.name!r} has tangents already")
        if of not in self._sizes:
            raise ValueError(f"program {program.name!r} has no buffer {of!r} to differentiate")
        for call in program.calls:
            for name in set(self._by) & set(bound(call, call.graph.outputs).values()):
                raise ValueError(f"program {program.name!r}: {call.graph.name!r} overwrites {name!r}")

    def names(self, buffer: str) -> Names | None:
        """Names of a buffer's tangents, None where they are zero."""
        return tuple(f"{buffer}.{j}" for j in range(self._count)) if buffer in self._live else None

    # Which buffers have tangents.

    def _links(self) -> list[tuple[str, str]]:
        """Buffers that a call reads and writes, where the latter has a derivative by the former."""
        links = []
        for call in self._program.calls:
            read, written = (bound(call, arrays) for arrays in (call.graph.inputs, call.graph.outputs))
            for output, inputs in self._dependencies[call.graph.name].items():
                if written[output] not in self._program.held:
                    links += [(read[name], written[output]) for name in inputs]
        return links

    def _active(self) -> set[str]:
        """Buffers that depend on the input."""
        return reached(set(self._by), self._links())

    def _needed(self, of: str) -> set[str]:
        """Buffers on which the wanted one depends."""
        return reached({of}, [(after, before) for before, after in self._links()])

    def _tangent_graphs(self) -> dict[str, TangentGraphs]:
        """Tangents by name of the graph, for whatever any of its calls needs."""
        graphs = self._program.graphs()
        inputs: dict[str, set[str]] = {}
        outputs: dict[str, set[str]] = {}
        for call in self._program.calls:
            name = call.graph.name
            read, written = self._live_names(call)
            if read and written:
                inputs.setdefault(name, set()).update(read)
                outputs.setdefault(name, set()).update(written)
        return {
            name: tangent_graphs(graphs[name], sorted(inputs[name]), sorted(outputs[name])) for name in inputs
        }

    def _live_names(self, call: Call) -> tuple[list[str], list[str]]:
        """Names of a call's inputs and outputs that have tangents."""
        read, written = (bound(call, arrays) for arrays in (call.graph.inputs, call.graph.outputs))
        return [k for k, v in read.items() if v in self._live], [
            k for k, v in written.items() if v in self._live
        ]

    # The calls.

    def _append_first_zeros(self) -> None:
        """Append the tangents of other inputs, if calls overwrite these and give them others."""
        for buffer in self._program.inputs:
            if buffer.name in self._live and buffer.name not in self._by:
                self._append_zeros(buffer.name)

    def _append_seeds(self) -> None:
        """Append the directions themselves: the columns of the identity."""
        if self._seeded:
            return
        self._seeded, first = True, 0
        for name in self._by:
            size = self._sizes[name]
            if name in self._live:
                rows = {f"d{j}": [float(first + i == j) for i in range(size)] for j in range(self._count)}
                graph = trace(f"{self._program.name}_{name}_directions", {}, lambda rows=rows: rows)
                self.calls.append(Call(graph, dict(zip(rows, self.names(name) or (), strict=True))))
            first += size

    def _append_zeros(self, buffer: str) -> None:
        size = self._sizes[buffer]
        graph = trace(f"{self._program.name}_no_tangent_{size}", {}, lambda: {"zero": [0.0] * size})
        self.calls += [Call(graph, {"zero": name}) for name in self.names(buffer) or ()]

    def _append(self, number: int, call: Call) -> None:
        """Append a call and those of its tangents."""
        read, written = self._live_names(call)
        if not (read and written):
            self.calls.append(call)
            for name in written:
                self._append_zeros(call.bindings.get(name, name))
            return
        graphs = self._graphs[call.graph.name]
        key = f"{call.graph.name}{COEFFICIENTS}"
        coefficients = {key: f"{call.graph.name}.{number}{COEFFICIENTS}"}
        self.calls.append(replace(call, graph=graphs.values, bindings={**call.bindings, **coefficients}))
        self._append_seeds()
        for direction in range(self._count):
            bindings = {**call.bindings, **coefficients}
            for name, size in (*graphs.tangent.inputs, *graphs.tangent.outputs):
                if name.endswith(TANGENT):
                    bindings[name] = self._tangent_buffer(call, name.removesuffix(TANGENT), size, direction)
            self.calls.append(Call(graphs.tangent, bindings))

    def _tangent_buffer(self, call: Call, name: str, size: int, direction: int) -> str:
        """Buffer of a tangent in a call; zeros, or one that no one reads, where this call needs none."""
        buffer = call.bindings.get(name, name)
        if buffer in self._live:
            return f"{buffer}.{direction}"
        is_input = any(name == key for key, _ in call.graph.inputs)
        return f"no_tangent_{size}" if is_input else f"unread_{name}"


def bound(call: Call, arrays: Sequence[tuple[str, int]]) -> dict[str, str]:
    """Buffers by the graph's names."""
    return {name: call.bindings.get(name, name) for name, _ in arrays}


def reached(start: set[str], links: Sequence[tuple[str, str]]) -> set[str]:
    """What the links lead to from the start."""
    found = set(start)
    while more := {after for before, after in links if before in found} - found:
        found |= more
    return found
