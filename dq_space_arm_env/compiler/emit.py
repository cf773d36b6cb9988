"""From expression graphs to LLVM: each graph becomes a function that operates on vectors of lanes.

A lane is one state of a batch, or one time step of a trajectory. The vectors are explicit (`<8 x double>` or
`<16 x float>` with AVX-512), so nothing depends on an optimizer's loop vectorization, and the scalar kernel
(one lane) computes exactly the bits of each lane of the batched one: fused multiply-adds are chosen here, not
by the back end.
"""

from __future__ import annotations

from llvmlite import ir

from dq_space_arm_env.compiler.elementary import arctangent2, sine_cosine
from dq_space_arm_env.compiler.graph import LIBRARY_FUNCTIONS, Graph, Node, use_counts
from dq_space_arm_env.compiler.vector_builder import Target, VectorBuilder, WrittenFunction

_COMPARISONS = {"less": "<", "less_equal": "<=", "equal": "==", "not_equal": "!="}
_LOGICAL = {"not", "and", "or", *_COMPARISONS}
_LARGE_GRAPH = 4_000
"""Nodes above which a function is divided into blocks: a single one takes LLVM up to three times as long."""
_LONGEST_BLOCK = 1_000
"""Nodes of such a block."""


class _GraphEmitter:
    """Walks a graph's nodes once and emits each when a reader asks for it."""

    def __init__(self, graph: Graph, builder: VectorBuilder) -> None:
        self.graph, self.builder = graph, builder
        count = len(graph.inputs)
        self.inputs, outputs = builder.pointers[:count], builder.pointers[count:]
        self.places: dict[int, list[tuple[str, int]]] = {}
        for pointer, indices in zip(outputs, graph.results, strict=True):
            for position, index in enumerate(indices):
                self.places.setdefault(index, []).append((pointer, position))
        self.uses = use_counts(graph)
        self.values: list[str | None] = [None] * len(graph.nodes)
        self.angles: dict[int, tuple[str, str]] = {}

    def run(self) -> None:
        """Emit every node except products that a sum absorbs into a fused multiply-add.

        A result is stored as soon as it is computed, to free its register.
        """
        divided = len(self.graph.nodes) > _LARGE_GRAPH
        for index, node in enumerate(self.graph.nodes):
            if divided and index % _LONGEST_BLOCK == 0:
                self.builder.begin_block()
            if not self._is_fusible(index) or index in self.places:
                self.values[index] = self._emit(node)
            for pointer, position in self.places.get(index, ()):
                self.builder.store(self.value(index), pointer, position)
        self.builder.end()

    def value(self, index: int) -> str:
        """The emitted value of a node, as a number in every lane."""
        value = self.values[index]
        if value is None:
            value = self.values[index] = self._emit(self.graph.nodes[index])
        if self.graph.nodes[index].operation in _LOGICAL:
            return self.builder.number(value)
        return value

    def _truth(self, index: int) -> str:
        if self.graph.nodes[index].operation in _LOGICAL:
            value = self.values[index]
            assert value is not None
            return value
        return self.builder.compare("!=", self.value(index), self.builder.constant(0.0))

    def _is_fusible(self, index: int) -> bool:
        """Whether a node is a product or square that exactly one node reads."""
        operation = self.graph.nodes[index].operation
        return self.builder.target.fused and operation in ("multiply", "square") and self.uses[index] == 1

    def _factors(self, index: int) -> tuple[str, str]:
        arguments = self.graph.nodes[index].arguments
        return self.value(arguments[0]), self.value(arguments[-1])

    def _emit_sum(self, left: int, right: int, *, subtract: bool) -> str:
        """Emit left + right or left - right, fused with the product where one of them is fusible."""
        builder = self.builder
        if not subtract and (choice := self._choice(left, right)):
            condition, if_true, if_false = choice
            return builder.select(self._truth(condition), self.value(if_true), self.value(if_false))
        if self.values[right] is None and self._is_fusible(right):
            a, b = self._factors(right)
            return builder.multiply_add(builder.negate(a) if subtract else a, b, self.value(left))
        if self.values[left] is None and self._is_fusible(left):
            a, b = self._factors(left)
            addend = self.value(right)
            return builder.multiply_add(a, b, builder.negate(addend) if subtract else addend)
        operation = builder.subtract if subtract else builder.add
        return operation(self.value(left), self.value(right))

    def _choice(self, left: int, right: int) -> tuple[int, int, int] | None:
        """Condition and branches of a choice, which CasADi writes as (c ? a : 0) + (!c ? b : 0)."""
        nodes = self.graph.nodes
        first, second = nodes[left], nodes[right]
        if first.operation == second.operation == "if_else_zero":
            for (condition, if_true), (negation, if_false) in (
                (first.arguments, second.arguments),
                (second.arguments, first.arguments),
            ):
                if nodes[negation] == Node("not", (condition,)):
                    return condition, if_true, if_false
        return None

    def _emit(self, node: Node) -> str:
        builder, operation, arguments = self.builder, node.operation, node.arguments
        match operation:
            case "input":
                return builder.load(self.inputs[node.slot[0]], node.slot[1])
            case "constant":
                return builder.constant(node.constant)
            case "add" | "subtract":
                return self._emit_sum(*arguments, subtract=operation == "subtract")
            case "sin" | "cos":
                if arguments[0] not in self.angles:
                    self.angles[arguments[0]] = sine_cosine(builder, self.value(arguments[0]))
                return self.angles[arguments[0]][operation == "cos"]
            case "not":
                return builder.opposite(self._truth(arguments[0]))
            case "and" | "or":
                combine = builder.both if operation == "and" else builder.either
                return combine(self._truth(arguments[0]), self._truth(arguments[1]))
            case "if_else_zero":
                return builder.select(
                    self._truth(arguments[0]), self.value(arguments[1]), builder.constant(0.0)
                )
        values = [self.value(argument) for argument in arguments]
        if operation in _COMPARISONS:
            return builder.compare(_COMPARISONS[operation], *values)
        return self._emit_arithmetic(operation, values)

    def _emit_arithmetic(self, operation: str, values: list[str]) -> str:
        builder = self.builder
        if operation in LIBRARY_FUNCTIONS:
            return builder.library(LIBRARY_FUNCTIONS[operation], *values)
        match operation:
            case "multiply":
                return builder.multiply(values[0], values[1])
            case "divide":
                return builder.divide(values[0], values[1])
            case "negate":
                return builder.negate(values[0])
            case "square":
                return builder.multiply(values[0], values[0])
            case "twice":
                return builder.add(values[0], values[0])
            case "invert":
                return builder.divide(builder.constant(1.0), values[0])
            case "sqrt":
                return builder.sqrt(values[0])
            case "absolute":
                return builder.absolute(values[0])
            case "sign":
                zero, one = builder.constant(0.0), builder.constant(1.0)
                size = builder.select(builder.compare("!=", values[0], zero), one, values[0])
                return builder.negate_if(builder.compare("<", values[0], zero), size)
            case "floor":
                return builder.floor(values[0])
            case "arctan":
                return arctangent2(builder, values[0], builder.constant(1.0))
            case "arctan2":
                return arctangent2(builder, values[0], values[1])
            case "minimum":
                return builder.select(builder.compare("<", values[0], values[1]), values[0], values[1])
            case "maximum":
                return builder.select(builder.compare(">", values[0], values[1]), values[0], values[1])
        raise NotImplementedError(f"no instruction for operation {operation!r}")


def emit_graph(module: ir.Module, graph: Graph, target: Target) -> ir.Function:
    """Add a graph to a module as an internal function of one pointer per input, then per output."""
    function = WrittenFunction(module, graph.name, len(graph.inputs) + len(graph.outputs))
    _GraphEmitter(graph, VectorBuilder(function, target)).run()
    return function
