"""Expression graphs: a function as a flat list of scalar operations.

A model function is written over plain scalars. `trace` runs it once on CasADi symbols: constants fold,
structural zeros disappear, common subexpressions are shared, and the rest is a `Graph`, a list of elementary
operations in static single assignment form. It is all the emitter (`emit`) needs; neither module knows
robots.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi

from dq_space_arm_env.algebra.symbolic import symbols

Expression = Any  # a CasADi SX scalar, or a Python float that a trace folded


class Node(NamedTuple):
    """One operation: its name, the nodes it reads, and its constant or input position."""

    operation: str
    arguments: tuple[int, ...] = ()
    constant: float = 0.0
    slot: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Graph:
    """A traced function."""

    name: str  # an identifier
    inputs: tuple[tuple[str, int], ...]  # name and size of each vector
    outputs: tuple[tuple[str, int], ...]
    nodes: tuple[Node, ...]  # in evaluation order
    results: tuple[tuple[int, ...], ...]  # for each output, the nodes of its scalars

    @property
    def operation_count(self) -> int:
        """Number of arithmetic operations: all nodes but inputs and constants."""
        return sum(node.operation not in ("input", "constant") for node in self.nodes)


LIBRARY_FUNCTIONS: Mapping[str, str] = {
    "exp": "exp",
    "log": "log",
    "power": "pow",
    "tan": "tan",
    "arcsin": "asin",
    "arccos": "acos",
    "sinh": "sinh",
    "cosh": "cosh",
    "tanh": "tanh",
    "arcsinh": "asinh",
    "arccosh": "acosh",
    "arctanh": "atanh",
    "log1p": "log1p",
    "expm1": "expm1",
}
"""Operations that the C library computes, lane by lane, under its names, which are CasADi's too."""

_OPERATION_NAMES = {
    **{getattr(casadi, f"OP_{name.upper()}"): key for key, name in LIBRARY_FUNCTIONS.items()},
    casadi.OP_CONSTPOW: "power",
    casadi.OP_ADD: "add",
    casadi.OP_SUB: "subtract",
    casadi.OP_MUL: "multiply",
    casadi.OP_DIV: "divide",
    casadi.OP_NEG: "negate",
    casadi.OP_SQ: "square",
    casadi.OP_TWICE: "twice",
    casadi.OP_INV: "invert",
    casadi.OP_SQRT: "sqrt",
    casadi.OP_SIN: "sin",
    casadi.OP_COS: "cos",
    casadi.OP_ATAN: "arctan",
    casadi.OP_ATAN2: "arctan2",
    casadi.OP_FABS: "absolute",
    casadi.OP_SIGN: "sign",
    casadi.OP_FLOOR: "floor",
    casadi.OP_FMIN: "minimum",
    casadi.OP_FMAX: "maximum",
    casadi.OP_LT: "less",
    casadi.OP_LE: "less_equal",
    casadi.OP_EQ: "equal",
    casadi.OP_NE: "not_equal",
    casadi.OP_NOT: "not",
    casadi.OP_AND: "and",
    casadi.OP_OR: "or",
    casadi.OP_IF_ELSE_ZERO: "if_else_zero",
}


EXPRESSIONS: Mapping[str, Callable[..., Expression]] = {
    **{key: getattr(casadi, name, casadi.power) for key, name in LIBRARY_FUNCTIONS.items()},
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "negate": lambda a: -a,
    "square": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "invert": lambda a: 1 / a,
    "sqrt": casadi.sqrt,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "arctan": casadi.atan,
    "arctan2": casadi.atan2,
    "absolute": casadi.fabs,
    "sign": casadi.sign,
    "floor": casadi.floor,
    "minimum": casadi.fmin,
    "maximum": casadi.fmax,
    "less": casadi.lt,
    "less_equal": casadi.le,
    "equal": casadi.eq,
    "not_equal": casadi.ne,
    "not": casadi.logic_not,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "if_else_zero": lambda condition, a: casadi.if_else(condition, a, 0.0),
}
"""Operations of nodes as CasADi expressions of their arguments."""


def trace(
    name: str,
    inputs: Mapping[str, int],
    function: Callable[..., Mapping[str, Sequence[Expression]]],
    **given: Sequence[Expression],
) -> Graph:
    """Trace a function of inputs of the given sizes, called with a list of symbols for each.

    It returns a sequence of scalars per output. `given` are further inputs, by symbols that the function
    already holds; empty ones are left out. Raises NotImplementedError for operations without an instruction.
    """
    traced = {key: symbols(key, size) for key, size in inputs.items()}
    outputs = function(**traced)
    return graph_of(
        name, {**traced, **{key: list(values) for key, values in given.items() if values}}, outputs
    )


def graph_of(
    name: str, inputs: Mapping[str, Sequence[Expression]], outputs: Mapping[str, Sequence[Expression]]
) -> Graph:
    """Trace the operations from the symbols of each input to the expressions of each output."""
    flat = [casadi.SX(value) for values in outputs.values() for value in values]
    shared = casadi.cse(casadi.vertcat(*flat)) if flat else casadi.SX(0, 1)
    arguments = [casadi.vertcat(*values) if len(values) else casadi.SX(0, 1) for values in inputs.values()]
    # A structurally zero output entry would be dropped from the result's sparsity pattern.
    function = casadi.Function(name, arguments, [casadi.densify(shared)])
    nodes, results = _static_single_assignment(function)
    split, start = [], 0
    for values in outputs.values():
        split.append(tuple(results[start : start + len(values)]))
        start += len(values)
    return Graph(
        name=name,
        inputs=tuple((key, len(values)) for key, values in inputs.items()),
        outputs=tuple((key, len(values)) for key, values in outputs.items()),
        nodes=nodes,
        results=tuple(split),
    )


def unknown_operation(function: casadi.Function) -> str | None:
    """CasADi's name of the first operation of a function without an instruction; None if all have one."""
    known = {casadi.OP_CONST, casadi.OP_INPUT, casadi.OP_OUTPUT, casadi.OP_HYPOT, *_OPERATION_NAMES}
    operations = (function.instruction_id(k) for k in range(function.n_instructions()))
    return next((_casadi_name(each) for each in operations if each not in known), None)


def _casadi_name(operation: int) -> str:
    names = (key for key, value in vars(casadi).items() if key[:3] == "OP_" and value == operation)
    return next(names, str(operation))


def _static_single_assignment(function: casadi.Function) -> tuple[tuple[Node, ...], list[int]]:
    """Turn CasADi's instructions on a reused work vector into nodes written once.

    CasADi stores a repeated subexpression once, but reuses registers, and it reads an input or builds a
    constant again wherever that is cheaper; both are merged here.
    """
    nodes: list[Node] = []
    index: dict[Node, int] = {}
    register: dict[int, int] = {}
    results = [-1] * function.nnz_out()

    def add(node: Node) -> int:
        found = index.setdefault(node, len(nodes))
        if found == len(nodes):
            nodes.append(node)
        return found

    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        reads, writes = function.instruction_input(k), function.instruction_output(k)
        if operation == casadi.OP_CONST:
            register[writes[0]] = add(Node("constant", constant=function.instruction_constant(k)))
        elif operation == casadi.OP_INPUT:
            register[writes[0]] = add(Node("input", slot=(reads[0], reads[1])))
        elif operation == casadi.OP_OUTPUT:
            results[writes[1]] = register[reads[0]]
        elif operation == casadi.OP_HYPOT:
            first, second = (add(Node("square", (register[r],))) for r in reads)
            register[writes[0]] = add(Node("sqrt", (add(Node("add", (first, second))),)))
        elif operation in _OPERATION_NAMES:
            register[writes[0]] = add(Node(_OPERATION_NAMES[operation], tuple(register[r] for r in reads)))
        else:
            raise NotImplementedError(
                f"graph {function.name()!r} holds CasADi operation {_casadi_name(operation)}, "
                "which the emitter has no instruction for"
            )
    return tuple(nodes), results


def use_counts(graph: Graph) -> Counter[int]:
    """Count the readers of each node, other nodes and results."""
    counts: Counter[int] = Counter()
    for node in graph.nodes:
        counts.update(node.arguments)
    for indices in graph.results:
        counts.update(indices)
    return counts
