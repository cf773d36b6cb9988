"""Traced graphs evaluated with as many digits as mpmath is set to: the same equations without rounding."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath

from dq_space_arm_env.compiler.graph import Graph

Number = Any  # an mpmath number

_OPERATIONS: Mapping[str, Callable[..., Number]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "negate": operator.neg,
    "square": lambda a: a * a,
    "twice": lambda a: a + a,
    "invert": lambda a: 1 / a,
    "sqrt": mpmath.sqrt,
    "sin": mpmath.sin,
    "cos": mpmath.cos,
}


def evaluate(graph: Graph, *inputs: Sequence[Number]) -> list[list[Number]]:
    """Evaluate a graph.

    Args:
        graph: A graph without branches.
        *inputs: The scalars of each of its inputs.

    Returns:
        The scalars of each of its outputs, mpmath numbers.

    Raises:
        KeyError: If the graph has an operation that is not arithmetic, a root, a sine or a cosine.
    """
    values: list[Number] = []
    for node in graph.nodes:
        if node.operation == "constant":
            values.append(mpmath.mpf(node.constant))
        elif node.operation == "input":
            values.append(mpmath.mpf(inputs[node.slot[0]][node.slot[1]]))
        else:
            values.append(_OPERATIONS[node.operation](*(values[index] for index in node.arguments)))
    return [[values[index] for index in indices] for indices in graph.results]
