"""From expression graphs to LLVM: each graph becomes a function whose operations act on vectors of lanes.

A lane is one state of a batch, or one time step of a trajectory. The vectors are explicit (`<8 x double>` or
`<16 x float>` where the processor has AVX-512), so nothing depends on an optimizer that may or may not
vectorize a loop, and the scalar kernel (one lane) computes exactly the bits that each lane of the batched one
does: fused multiply-adds are chosen here, not by the back end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from llvmlite import ir

from dq_space_arm_env.compiler.elementary import arctangent2, sine_cosine
from dq_space_arm_env.compiler.graph import Graph, Node, use_counts

INDEX = ir.IntType(64)
DOUBLE = ir.DoubleType()
POINTER = ir.PointerType()
# Types of array elements by name; truth values take a byte.
ELEMENTS: Mapping[str, ir.Type] = {"float64": DOUBLE, "float32": ir.FloatType(), "bool": ir.IntType(8)}
BYTES = {"float64": 8, "float32": 4, "bool": 1}


@dataclass(frozen=True)
class Target:
    """What the generated code is made for.

    Attributes:
        lanes: Number of lanes of a vector; 1 gives scalar code.
        fused: Whether the processor has a fused multiply-add instruction.
        precision: What it computes in, "float64" or "float32".
    """

    lanes: int
    fused: bool
    precision: str = "float64"


def vector_type(element: ir.Type, lanes: int) -> ir.Type:
    """Type of a vector; one lane is a plain number."""
    return ir.VectorType(element, lanes) if lanes > 1 else element


class VectorBuilder:
    """Arithmetic on vectors of `lanes` numbers, appended to one basic block."""

    def __init__(self, builder: ir.IRBuilder, target: Target) -> None:
        """Append to `builder`, for `target`."""
        self.ir = builder
        self.target = target
        self.type: ir.Type = vector_type(ELEMENTS[target.precision], target.lanes)
        self.alignment = BYTES[target.precision] * target.lanes

    def constant(self, value: float) -> ir.Constant:
        """A vector with the same value in every lane."""
        if self.target.lanes == 1:
            return ir.Constant(self.type, value)
        return ir.Constant(self.type, [value] * self.target.lanes)

    def add(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit a + b."""
        return self.ir.fadd(a, b)

    def subtract(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit a - b."""
        return self.ir.fsub(a, b)

    def multiply(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit a b."""
        return self.ir.fmul(a, b)

    def divide(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit a / b."""
        return self.ir.fdiv(a, b)

    def negate(self, a: ir.Value) -> ir.Value:
        """Emit -a."""
        return self.ir.fneg(a)

    def multiply_add(self, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        """Emit a b + c, rounded once where the processor can."""
        if not self.target.fused:
            return self.add(self.multiply(a, b), c)
        return self._intrinsic("llvm.fma", a, b, c)

    def _intrinsic(self, name: str, *arguments: ir.Value) -> ir.Value:
        lanes, bits = self.target.lanes, 8 * BYTES[self.target.precision]
        full_name = f"{name}.v{lanes}f{bits}" if lanes > 1 else f"{name}.f{bits}"
        function = self.ir.module.globals.get(full_name)
        if function is None:
            signature = ir.FunctionType(self.type, [self.type] * len(arguments))
            function = ir.Function(self.ir.module, signature, full_name)
        return self.ir.call(function, arguments)

    def sqrt(self, a: ir.Value) -> ir.Value:
        """Emit the square root."""
        return self._intrinsic("llvm.sqrt", a)

    def absolute(self, a: ir.Value) -> ir.Value:
        """Emit |a|."""
        return self._intrinsic("llvm.fabs", a)

    def floor(self, a: ir.Value) -> ir.Value:
        """Emit the largest integer not above a."""
        return self._intrinsic("llvm.floor", a)

    def round(self, a: ir.Value) -> ir.Value:
        """Emit the nearest integer, ties to even."""
        return self._intrinsic("llvm.rint", a)

    def compare(self, relation: str, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit a truth value per lane; every comparison with NaN but `!=` is false."""
        if relation == "!=":
            return self.ir.fcmp_unordered(relation, a, b)
        return self.ir.fcmp_ordered(relation, a, b)

    def either(self, a: ir.Value, b: ir.Value) -> ir.Value:
        """Emit the logical or of two truth values."""
        return self.ir.or_(a, b)

    def select(self, condition: ir.Value, if_true: ir.Value, if_false: ir.Value) -> ir.Value:
        """Emit a choice per lane."""
        return self.ir.select(condition, if_true, if_false)

    def negate_if(self, condition: ir.Value, a: ir.Value) -> ir.Value:
        """Emit -a where the condition holds, else a."""
        return self.select(condition, self.negate(a), a)

    def any_nonzero(self, base: ir.Value) -> ir.Value:
        """Emit whether the first vector of a buffer has a lane that is not zero: a single truth value."""
        found = self.compare("!=", self.load(base, 0), self.constant(0.0))
        if self.target.lanes == 1:
            return found
        bits = ir.IntType(self.target.lanes)
        return self.ir.icmp_unsigned("!=", self.ir.bitcast(found, bits), bits(0))

    def address(self, base: ir.Value, index: int) -> ir.Value:
        """Address of vector number `index` of a buffer."""
        return self.ir.gep(base, [INDEX(index)], source_etype=self.type)

    def load(self, base: ir.Value, index: int) -> ir.Value:
        """Emit a read of vector number `index` of a buffer."""
        return self.ir.load(self.address(base, index), align=self.alignment, typ=self.type)

    def store(self, value: ir.Value, base: ir.Value, index: int) -> None:
        """Emit a write of vector number `index` of a buffer."""
        self.ir.store(value, self.address(base, index), align=self.alignment)


_COMPARISONS = {"less": "<", "less_equal": "<=", "equal": "==", "not_equal": "!="}
_LOGICAL = {"not", "and", "or", *_COMPARISONS}


class _GraphEmitter:
    """Walks a graph's nodes once and emits each of them when a reader asks for it."""

    def __init__(self, graph: Graph, builder: VectorBuilder, pointers: Sequence[ir.Value]) -> None:
        self.graph = graph
        self.builder = builder
        self.inputs, outputs = pointers[: len(graph.inputs)], pointers[len(graph.inputs) :]
        self.places: dict[int, list[tuple[ir.Value, int]]] = {}
        for pointer, indices in zip(outputs, graph.results, strict=True):
            for position, index in enumerate(indices):
                self.places.setdefault(index, []).append((pointer, position))
        self.uses = use_counts(graph)
        self.values: list[ir.Value | None] = [None] * len(graph.nodes)
        self.angles: dict[int, tuple[ir.Value, ir.Value]] = {}

    def run(self) -> None:
        """Emit every node except products that the sum reading them absorbs into a fused multiply-add.

        A result is stored as soon as it is there, so that it occupies no register until the end.
        """
        for index, node in enumerate(self.graph.nodes):
            if not self._is_fusible(index) or index in self.places:
                self.values[index] = self._emit(node)
            for pointer, position in self.places.get(index, ()):
                self.builder.store(self.value(index), pointer, position)

    def value(self, index: int) -> ir.Value:
        """The emitted value of a node, as a number in every lane."""
        value = self.values[index]
        if value is None:
            value = self.values[index] = self._emit(self.graph.nodes[index])
        if self.graph.nodes[index].operation in _LOGICAL:
            return self.builder.ir.uitofp(value, self.builder.type)
        return value

    def _truth(self, index: int) -> ir.Value:
        if self.graph.nodes[index].operation in _LOGICAL:
            value = self.values[index]
            assert value is not None
            return value
        return self.builder.compare("!=", self.value(index), self.builder.constant(0.0))

    def _is_fusible(self, index: int) -> bool:
        """Whether a node is a product, or a square, that exactly one node reads."""
        operation = self.graph.nodes[index].operation
        return self.builder.target.fused and operation in ("multiply", "square") and self.uses[index] == 1

    def _factors(self, index: int) -> tuple[ir.Value, ir.Value]:
        arguments = self.graph.nodes[index].arguments
        return self.value(arguments[0]), self.value(arguments[-1])

    def _emit_sum(self, left: int, right: int, *, subtract: bool) -> ir.Value:
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
        """Condition and branches of a choice, which CasADi writes as the sum (c ? a : 0) + (!c ? b : 0)."""
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

    def _emit(self, node: Node) -> ir.Value:
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
                return builder.ir.not_(self._truth(arguments[0]))
            case "and" | "or":
                combine = builder.ir.and_ if operation == "and" else builder.ir.or_
                return combine(self._truth(arguments[0]), self._truth(arguments[1]))
            case "if_else_zero":
                return builder.select(
                    self._truth(arguments[0]), self.value(arguments[1]), builder.constant(0.0)
                )
        values = [self.value(argument) for argument in arguments]
        if operation in _COMPARISONS:
            return builder.compare(_COMPARISONS[operation], *values)
        return self._emit_arithmetic(operation, values)

    def _emit_arithmetic(self, operation: str, values: list[ir.Value]) -> ir.Value:
        builder = self.builder
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
            case "arctan2":
                return arctangent2(builder, values[0], values[1])
            case "minimum":
                return builder.select(builder.compare("<", values[0], values[1]), values[0], values[1])
            case "maximum":
                return builder.select(builder.compare(">", values[0], values[1]), values[0], values[1])
        raise NotImplementedError(f"no instruction for operation {operation!r}")


def emit_graph(module: ir.Module, graph: Graph, target: Target) -> ir.Function:
    """Add a graph to a module as an internal function.

    Args:
        module: LLVM module to add to.
        graph: The graph.
        target: Lanes and instructions to use.

    Returns:
        The function: one pointer per input, then one per output, each to consecutive vectors of lanes.
    """
    count = len(graph.inputs) + len(graph.outputs)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER] * count), graph.name)
    function.linkage = "internal"
    for argument in function.args:
        argument.add_attribute("noalias")
    builder = VectorBuilder(ir.IRBuilder(function.append_basic_block("entry")), target)
    _GraphEmitter(graph, builder, function.args).run()
    builder.ir.ret_void()
    return function
