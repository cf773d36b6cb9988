"""Reverse mode on a graph: the product of a row vector with the derivative of its outputs by its inputs.

The vector has an entry, a cotangent, for each entry of the outputs; the product has one for each entry of
the inputs, and takes a few times the work of the graph however many inputs there are. Like a tangent it is
linear, with coefficients that depend on the point only, and divided in the same way, see `forward_mode`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from dq_space_arm_env.compiler.forward_mode import (
    SELECTIONS,
    divided,
    partials_of,
    varied_arguments,
)
from dq_space_arm_env.compiler.graph import EXPRESSIONS, Graph, Node, graph_of

Expression = Any

COTANGENT = ".cotangent"  # suffix of an input's or output's name


@dataclass(frozen=True)
class CotangentGraphs:
    """The two graphs of a product with a derivative from the left."""

    values: Graph  # the outputs, and the coefficients if there are any
    cotangent: Graph  # from cotangents of outputs, and what its coefficients are, to cotangents of inputs


def cotangent_graphs(graph: Graph, outputs: Sequence[str], inputs: Sequence[str]) -> CotangentGraphs:
    """Differentiate some outputs of a graph by some inputs, multiplied from the left.

    The product's inputs and outputs are named with `COTANGENT`. It also takes inputs and coefficients of the
    graph as in `forward_mode.tangent_graphs`.
    """
    given = {name: _symbols(name, size) for name, size in graph.inputs}
    seeds = {name: _symbols(f"c_{name}", size) for name, size in graph.outputs if name in outputs}
    values = _values(graph, given)
    results = dict(zip((name for name, _ in graph.outputs), graph.results, strict=True))
    cotangents = _accumulated(graph, values, [(results[name], seed) for name, seed in seeds.items()])
    computed = {name: [values[i] for i in indices] for name, indices in results.items()}
    products = {
        f"{name}{COTANGENT}": [cotangents.get((slot, entry), 0.0) for entry in range(size)]
        for slot, (name, size) in enumerate(graph.inputs)
        if name in inputs
    }
    moved = {f"{name}{COTANGENT}": seed for name, seed in seeds.items()}
    joint = graph_of(f"{graph.name}_cotangent", {**given, **moved}, {**computed, **products})
    joint = _with_shared_reciprocals(joint)
    return CotangentGraphs(*divided(joint, graph, len(graph.inputs), len(graph.outputs)))


def _symbols(name: str, size: int) -> list[Expression]:
    return [casadi.SX.sym(f"{name}_{i}") for i in range(size)]


def _values(graph: Graph, given: Mapping[str, Sequence[Expression]]) -> list[Expression]:
    """Values of all nodes."""
    names = [name for name, _ in graph.inputs]
    values: list[Expression] = []
    for node in graph.nodes:
        if node.operation == "input":
            values.append(given[names[node.slot[0]]][node.slot[1]])
        elif node.operation == "constant":
            values.append(casadi.SX(node.constant))
        else:
            arguments = [values[i] for i in node.arguments]
            values.append(EXPRESSIONS[node.operation](*arguments))
    return values


def _accumulated(
    graph: Graph,
    values: Sequence[Expression],
    seeds: Sequence[tuple[Sequence[int], Sequence[Expression]]],
) -> dict[tuple[int, int], Expression]:
    """Cotangents of the inputs by slot; what is missing is a structural zero."""
    found: dict[int, Expression] = {}
    inputs: dict[tuple[int, int], Expression] = {}
    for indices, seed in seeds:
        for index, entry in zip(indices, seed, strict=True):
            found[index] = found[index] + entry if index in found else entry
    for index in reversed(range(len(graph.nodes))):
        if index not in found:
            continue
        node, cotangent = graph.nodes[index], found.pop(index)
        if node.operation == "input":
            inputs[node.slot] = cotangent
        elif node.operation != "constant":
            arguments = [values[i] for i in node.arguments]
            for argument, share in _shares(node, values[index], arguments, cotangent):
                found[argument] = found[argument] + share if argument in found else share
    return inputs


def _shares(
    node: Node, value: Expression, arguments: Sequence[Expression], cotangent: Expression
) -> list[tuple[int, Expression]]:
    """What a node's cotangent adds to those of its arguments."""
    varied = varied_arguments(node)
    if not varied:
        return []
    if node.operation == "if_else_zero":
        # By selection, not multiplication: the branch that is not taken may be infinite.
        return [(node.arguments[1], casadi.if_else(arguments[0], cotangent, 0.0))]
    if node.operation in SELECTIONS:
        is_first = SELECTIONS[node.operation](*arguments)
        first, second = node.arguments
        return [
            (first, casadi.if_else(is_first, cotangent, 0.0)),
            (second, casadi.if_else(is_first, 0.0, cotangent)),
        ]
    partials = partials_of(node.operation, value, arguments)
    return [(i, partial * cotangent) for i, partial in zip(node.arguments, partials, strict=True)]


def _with_shared_reciprocals(graph: Graph) -> Graph:
    """Multiply by reciprocals in place of dividing: a derivative divides many numbers by the same pivots.

    A division takes the time of some ten products.
    """
    nodes: list[Node] = []
    index: dict[Node, int] = {}
    moved: list[int] = []

    def add(node: Node) -> int:
        if node not in index:
            index[node] = len(nodes)
            nodes.append(node)
        return index[node]

    for node in graph.nodes:
        arguments = tuple(moved[i] for i in node.arguments)
        if node.operation == "divide":
            reciprocal = add(Node("invert", arguments[1:]))
            moved.append(add(Node("multiply", (arguments[0], reciprocal))))
        else:
            moved.append(add(node._replace(arguments=arguments)))
    results = tuple(tuple(moved[i] for i in indices) for indices in graph.results)
    return replace(graph, nodes=tuple(nodes), results=results)
