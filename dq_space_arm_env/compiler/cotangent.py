"""Cotangent programs: products of row vectors with the derivative of a program's results, in reverse mode.

After the calls of a program follow those of its cotangents, in reverse order: the cotangent of what a call
has read is the sum over all calls that have read it. Loops are refused, since the reverse of an unknown
number of passes needs unknown memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dq_space_arm_env.compiler.forward_mode import COEFFICIENTS, dependencies
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Call, Program
from dq_space_arm_env.compiler.reverse_mode import COTANGENT, CotangentGraphs, cotangent_graphs
from dq_space_arm_env.compiler.tangent import bound, reached


def append_cotangents(program: Program, of: Mapping[str, str], by: Sequence[str]) -> None:
    """Add the calls that multiply the derivatives of some buffers by inputs with row vectors from the left.

    Args:
        program: The program, changed in place; its results stay the same up to rounding.
        of: For each buffer to differentiate, as it is after the last call, the buffer that holds its
            cotangent: an input, or what a call writes that depends on no cotangent.
        by: Names of the inputs. The products are the buffers of these names with `COTANGENT`.

    Raises:
        ValueError: The program has a loop or a guard, or no such inputs or buffers.
    """
    if not program.is_straight:
        raise ValueError(f"program {program.name!r} has a loop or a guard, which has no reverse")
    sizes = program.scratch_sizes()
    for name in (*of, *of.values()):
        if name not in sizes:
            raise ValueError(f"program {program.name!r} has no buffer {name!r}")
    for name in by:
        if name not in {buffer.name for buffer in program.inputs}:
            raise ValueError(f"program {program.name!r} has no input {name!r}")
    _Transformation(program, of, by).append()


class _Transformation:
    """The cotangents of a program."""

    def __init__(self, program: Program, of: Mapping[str, str], by: Sequence[str]) -> None:
        self._program, self._by = program, by
        self._calls = _written_once(program)
        self._sizes = replace(program, calls=self._calls).scratch_sizes()
        # What the derivatives are of and by, and the buffers between them.
        links = self._links()
        self._live = reached(set(by), links) & reached(set(of), [(b, a) for a, b in links])
        # Buffers whose sum is the cotangent of a buffer.
        self._parts: dict[str, list[str]] = {name: [seed] for name, seed in of.items()}
        self._graphs = self._cotangent_graphs()

    def append(self) -> None:
        """Append the calls to the program."""
        program, forward = self._program, []
        for number, call in enumerate(self._calls):
            graphs = self._graphs.get(call.graph.name)
            if graphs is not None and self._is_live(call):
                bindings = {**call.bindings, **self._coefficients(number, call)}
                call = replace(call, graph=graphs.values, bindings=bindings)
            forward.append(call)
        program.calls = forward
        for number, call in reversed(list(enumerate(self._calls))):
            if self._is_live(call):
                self._append_reverse(number, call)
        for name in self._by:
            self._append_sum(name, f"{name}{COTANGENT}")

    def _links(self) -> list[tuple[str, str]]:
        """Buffers that a call reads and writes, where the latter has a derivative by the former."""
        links = []
        for call in self._calls:
            read, written = bound(call, call.graph.inputs), bound(call, call.graph.outputs)
            for output, inputs in dependencies(call.graph).items():
                if written[output] not in self._program.held:
                    links += [(read[name], written[output]) for name in inputs]
        return links

    def _live_names(self, call: Call) -> tuple[list[str], list[str]]:
        """Names of a call's inputs and outputs that have cotangents."""
        read, written = bound(call, call.graph.inputs), bound(call, call.graph.outputs)
        return [k for k, v in read.items() if v in self._live], [
            k for k, v in written.items() if v in self._live
        ]

    def _is_live(self, call: Call) -> bool:
        return all(self._live_names(call))

    def _cotangent_graphs(self) -> dict[str, CotangentGraphs]:
        """Cotangents by name of the graph, for whatever any of its calls needs."""
        graphs = self._program.graphs()
        inputs: dict[str, set[str]] = {}
        outputs: dict[str, set[str]] = {}
        for call in filter(self._is_live, self._calls):
            read, written = self._live_names(call)
            inputs.setdefault(call.graph.name, set()).update(read)
            outputs.setdefault(call.graph.name, set()).update(written)
        return {
            name: cotangent_graphs(graphs[name], sorted(outputs[name]), sorted(inputs[name]))
            for name in inputs
        }

    def _coefficients(self, number: int, call: Call) -> dict[str, str]:
        return {f"{call.graph.name}{COEFFICIENTS}": f"{call.graph.name}.{number}{COEFFICIENTS}"}

    def _append_reverse(self, number: int, call: Call) -> None:
        """Append the call that turns cotangents of a call's outputs to those of its inputs."""
        graph = self._graphs[call.graph.name].cotangent
        read, written = self._live_names(call)
        bindings = {**call.bindings, **self._coefficients(number, call)}
        for name, size in graph.inputs:
            output = name.removesuffix(COTANGENT)
            if output in written:
                bindings[name] = self._sum(call.bindings[output])
            elif output != name:
                bindings[name] = f"no_cotangent_{size}"  # never written: zeros
        for name, _ in graph.outputs:
            key = name.removesuffix(COTANGENT)
            bindings[name] = f"{name}.{number}"
            if key in read:
                self._parts.setdefault(call.bindings[key], []).append(bindings[name])
        self._program.calls.append(Call(graph, bindings))

    def _sum(self, buffer: str) -> str:
        """Buffer of a buffer's cotangent, appended if it has several parts."""
        parts = self._parts[buffer]
        if len(parts) > 1:
            self._append_sum(buffer, f"{buffer}{COTANGENT}")
            self._parts[buffer] = [f"{buffer}{COTANGENT}"]
        return self._parts[buffer][0]

    def _append_sum(self, buffer: str, name: str) -> None:
        parts, size = self._parts.get(buffer, []), self._sizes[buffer]
        keys = [f"part{i}" for i in range(len(parts))]

        def total(**given: list[object]) -> dict[str, list[object]]:
            columns = zip(*given.values(), strict=True)
            return {"sum": [_added(column) for column in columns] if given else [0.0] * size}

        graph = trace(f"sum_of_{len(parts)}_by_{size}", dict.fromkeys(keys, size), total)
        self._program.call(graph, **dict(zip(keys, parts, strict=True)), sum=name)


def _added(terms: Sequence[object]) -> object:
    total = terms[0]
    for term in terms[1:]:
        total = total + term  # type: ignore[operator]
    return total


def _written_once(program: Program) -> list[Call]:
    """The calls, with a name for each version of a buffer: its own for an input's first, else the last."""
    writes: dict[str, int] = {}
    for call in program.calls:
        for buffer in bound(call, call.graph.outputs).values():
            writes[buffer] = writes.get(buffer, 0) + 1
    inputs = {buffer.name for buffer in program.inputs}
    version = dict.fromkeys(writes, 0)

    def present(buffer: str) -> str:
        """Name of what a buffer holds before the next write."""
        done = version.get(buffer, 0)
        keeps_name = done == 0 if buffer in inputs else done == writes.get(buffer, 0)
        return buffer if keeps_name else f"{buffer}.version.{done}"

    calls = []
    for call in program.calls:
        bindings = {name: present(buffer) for name, buffer in bound(call, call.graph.inputs).items()}
        for name, buffer in bound(call, call.graph.outputs).items():
            version[buffer] += 1
            bindings[name] = present(buffer)
        calls.append(replace(call, bindings=bindings))
    return calls
