"""Forward mode on a graph: the derivative of its outputs along a direction of its inputs.

The tangent of a graph is linear in the direction, with coefficients that depend on the point only. So it
becomes two graphs: one that computes the outputs and the coefficients, done once, and one that applies the
coefficients, done for each direction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from dq_space_arm_env.compiler.graph import EXPRESSIONS, LIBRARY_FUNCTIONS, Graph, Node, graph_of

Expression = Any

TANGENT = ".tangent"  # suffix of an input's or output's name
COEFFICIENTS = ".coefficients"  # the buffer between both graphs


def _arctan2(f: Expression, y: Expression, x: Expression) -> tuple[Expression, Expression]:
    scale = 1 / (x * x + y * y)
    return x * scale, -y * scale


def _partials_by_casadi(operation: str, *arguments: Expression) -> tuple[Expression, ...]:
    """Partial derivatives of an operation of the C library."""
    symbols = [casadi.SX.sym(f"a_{i}") for i in range(len(arguments))]
    value = EXPRESSIONS[operation](*symbols)
    return tuple(casadi.substitute([casadi.jacobian(value, a) for a in symbols], symbols, list(arguments)))


# For each argument of a node of value f, its partial derivative; CasADi folds 1 and -1.
_PARTIALS: Mapping[str, Callable[..., tuple[Expression, ...]]] = {
    "add": lambda f, a, b: (1, 1),
    "subtract": lambda f, a, b: (1, -1),
    "multiply": lambda f, a, b: (b, a),
    "divide": lambda f, a, b: (1 / b, -f / b),
    "negate": lambda f, a: (-1,),
    "square": lambda f, a: (2 * a,),
    "twice": lambda f, a: (2,),
    "invert": lambda f, a: (-f * f,),
    "sqrt": lambda f, a: (0.5 / f,),
    "sin": lambda f, a: (casadi.cos(a),),
    "cos": lambda f, a: (-casadi.sin(a),),
    "arctan": lambda f, a: (1 / (1 + a * a),),
    "arctan2": _arctan2,
    "absolute": lambda f, a: (casadi.lt(0, a) - casadi.lt(a, 0),),  # 0 at 0
}

# Nodes that hand on one of their arguments: the condition under which it is the first, and the arguments. At
# a tie it is the one that the machine code returns.
SELECTIONS: Mapping[str, Callable[..., Expression]] = {
    "minimum": lambda a, b: casadi.lt(a, b),
    "maximum": lambda a, b: casadi.lt(b, a),
}

# Nodes that jump or stay: their derivative is zero.
_PIECEWISE_CONSTANT = ("sign", "floor", "less", "less_equal", "equal", "not_equal", "not", "and", "or")


def dependencies(graph: Graph) -> dict[str, frozenset[str]]:
    """For each output of a graph, the inputs by which it has a derivative: not those of conditions alone."""
    names = [name for name, _ in graph.inputs]
    found: list[frozenset[str]] = []
    for node in graph.nodes:
        if node.operation == "input":
            found.append(frozenset((names[node.slot[0]],)))
        else:
            found.append(frozenset().union(*(found[i] for i in varied_arguments(node))))
    return {
        name: frozenset().union(*(found[i] for i in indices))
        for (name, _), indices in zip(graph.outputs, graph.results, strict=True)
    }


def varied_arguments(node: Node) -> tuple[int, ...]:
    """Arguments by which a node has a derivative."""
    if node.operation in _PIECEWISE_CONSTANT:
        return ()
    return node.arguments[1:] if node.operation == "if_else_zero" else node.arguments


@dataclass(frozen=True)
class TangentGraphs:
    """The two graphs of a tangent."""

    values: Graph  # the outputs, and the coefficients if there are any
    tangent: Graph  # from tangents of inputs, and what its coefficients are, to tangents of outputs


def tangent_graphs(graph: Graph, inputs: Sequence[str], outputs: Sequence[str]) -> TangentGraphs:
    """Differentiate some outputs of a graph along a direction of some inputs.

    The tangent's inputs and outputs are named with `TANGENT`. It also takes those inputs of the graph that
    are coefficients themselves, and the others as the input `COEFFICIENTS`, an output of the graph of values.
    """
    given = {name: _symbols(name, size) for name, size in graph.inputs}
    directions = {name: _symbols(f"d_{name}", size) for name, size in graph.inputs if name in inputs}
    values, tangents = _differentiated(graph, given, directions)
    results = dict(zip((name for name, _ in graph.outputs), graph.results, strict=True))
    computed = {name: [values[i] for i in indices] for name, indices in results.items()}
    changes = {f"{name}{TANGENT}": [_or_zero(tangents[i]) for i in results[name]] for name in outputs}
    moved = {f"{name}{TANGENT}": direction for name, direction in directions.items()}
    joint = graph_of(f"{graph.name}_tangent", {**given, **moved}, {**computed, **changes})
    return TangentGraphs(*divided(joint, graph, len(graph.inputs), len(graph.outputs)))


def _symbols(name: str, size: int) -> list[Expression]:
    return [casadi.SX.sym(f"{name}_{i}") for i in range(size)]


def _or_zero(value: Expression | None) -> Expression:
    return 0.0 if value is None else value


def _differentiated(
    graph: Graph, given: Mapping[str, Sequence[Expression]], directions: Mapping[str, Sequence[Expression]]
) -> tuple[list[Expression], list[Expression | None]]:
    """Values and tangents of all nodes; None is a structural zero."""
    names = [name for name, _ in graph.inputs]
    values: list[Expression] = []
    tangents: list[Expression | None] = []
    for node in graph.nodes:
        name, entry = names[node.slot[0]] if names else "", node.slot[1]
        if node.operation == "input":
            values.append(given[name][entry])
            tangents.append(directions[name][entry] if name in directions else None)
        elif node.operation == "constant":
            values.append(casadi.SX(node.constant))
            tangents.append(None)
        else:
            arguments = [values[i] for i in node.arguments]
            values.append(EXPRESSIONS[node.operation](*arguments))
            changes = [tangents[i] if i in varied_arguments(node) else None for i in node.arguments]
            tangents.append(_tangent(node.operation, values[-1], arguments, changes))
    return values, tangents


def _tangent(
    operation: str, value: Expression, arguments: Sequence[Expression], changes: Sequence[Expression | None]
) -> Expression | None:
    """Tangent of a node, from those of its arguments."""
    if all(change is None for change in changes):
        return None
    if operation == "if_else_zero":
        # By selection, not multiplication: the branch that is not taken may be infinite.
        return casadi.if_else(arguments[0], changes[1], 0.0)
    if operation in SELECTIONS:
        is_first = SELECTIONS[operation](*arguments)
        first, second = (_or_zero(change) for change in changes)
        return casadi.if_else(is_first, first, second)
    total: Expression = 0.0
    for partial, change in zip(partials_of(operation, value, arguments), changes, strict=True):
        if change is not None:
            total = total + partial * change
    return total


def partials_of(operation: str, value: Expression, arguments: Sequence[Expression]) -> tuple[Expression, ...]:
    """Partial derivatives of a node that is neither a selection nor piecewise constant."""
    if operation in LIBRARY_FUNCTIONS:
        return _partials_by_casadi(operation, *arguments)
    return _PARTIALS[operation](value, *arguments)


def divided(joint: Graph, graph: Graph, n_inputs: int, n_outputs: int) -> tuple[Graph, Graph]:
    """Divide a graph of values and of what is linear in further inputs: what depends on none is done once.

    Args:
        joint: The first inputs and outputs are those of `graph`; the others follow.
        graph: The graph that was differentiated.
        n_inputs: Number of its inputs.
        n_outputs: Number of its outputs.

    Returns:
        Its values with the coefficients, an output named with `COEFFICIENTS` if there are any, and the linear
        part, which takes them as an input.
    """
    moving: set[int] = set()
    for index, node in enumerate(joint.nodes):
        is_direction = node.operation == "input" and node.slot[0] >= n_inputs
        if is_direction or any(i in moving for i in node.arguments):
            moving.add(index)
    results = [index for indices in joint.results[n_outputs:] for index in indices]
    read = {i for index in moving for i in joint.nodes[index].arguments} | set(results)
    coefficients = [
        index for index in sorted(read - moving) if joint.nodes[index].operation not in ("input", "constant")
    ]
    outputs = joint.outputs[:n_outputs]
    if coefficients:
        computed = (*outputs, (f"{graph.name}{COEFFICIENTS}", len(coefficients)))
        found = (*joint.results[:n_outputs], tuple(coefficients))
        values = _part(joint, f"{graph.name}_values", joint.inputs[:n_inputs], computed, found)
    else:
        values = graph
    return values, _applied(joint, graph.name, n_inputs, n_outputs, coefficients)


def _applied(joint: Graph, name: str, n_inputs: int, n_outputs: int, coefficients: Sequence[int]) -> Graph:
    """The part of a joint graph that depends on directions, with coefficients as an input."""
    nodes = list(joint.nodes)
    for entry, index in enumerate(coefficients):
        nodes[index] = Node("input", slot=(len(joint.inputs), entry))
    inputs = (*joint.inputs, (f"{name}{COEFFICIENTS}", len(coefficients)))
    whole = replace(joint, nodes=tuple(nodes), inputs=inputs)
    part = _part(whole, joint.name, inputs, joint.outputs[n_outputs:], joint.results[n_outputs:])
    read = {node.slot[0] for node in part.nodes if node.operation == "input"}
    kept = [i for i in range(len(inputs)) if i in read or n_inputs <= i < len(joint.inputs)]
    slots = {position: new for new, position in enumerate(kept)}
    moved = tuple(
        node._replace(slot=(slots[node.slot[0]], node.slot[1])) if node.operation == "input" else node
        for node in part.nodes
    )
    return replace(part, inputs=tuple(inputs[i] for i in kept), nodes=moved)


def _part(
    graph: Graph,
    name: str,
    inputs: tuple[tuple[str, int], ...],
    outputs: tuple[tuple[str, int], ...],
    results: tuple[tuple[int, ...], ...],
) -> Graph:
    """The nodes of a graph that some results need."""
    wanted = {index for indices in results for index in indices}
    for index in reversed(range(len(graph.nodes))):
        if index in wanted:
            wanted.update(graph.nodes[index].arguments)
    new_index = {index: new for new, index in enumerate(sorted(wanted))}
    nodes = tuple(
        graph.nodes[index]._replace(arguments=tuple(new_index[i] for i in graph.nodes[index].arguments))
        for index in sorted(wanted)
    )
    places = tuple(tuple(new_index[i] for i in indices) for indices in results)
    return Graph(name, inputs, outputs, nodes, places)
