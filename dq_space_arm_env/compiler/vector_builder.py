"""Vector arithmetic in LLVM: one operation on every lane, appended to a basic block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from llvmlite import ir

INDEX = ir.IntType(64)
DOUBLE = ir.DoubleType()
POINTER = ir.PointerType()
# Types of array elements by name; truth values take a byte.
ELEMENTS: Mapping[str, ir.Type] = {"float64": DOUBLE, "float32": ir.FloatType(), "bool": ir.IntType(8)}
BYTES = {"float64": 8, "float32": 4, "bool": 1}


@dataclass(frozen=True)
class Target:
    """Vector width, instructions and precision of the generated code."""

    lanes: int  # 1 gives scalar code
    fused: bool  # the processor has fused multiply-add
    precision: str = "float64"  # or "float32"


def vector_type(element: ir.Type, lanes: int) -> ir.Type:
    """Type of a vector; one lane is a plain number."""
    return ir.VectorType(element, lanes) if lanes > 1 else element


class VectorBuilder:
    """Arithmetic on vectors of `lanes` numbers, appended to one basic block."""

    def __init__(self, builder: ir.IRBuilder, target: Target) -> None:
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
        return self.ir.fadd(a, b)

    def subtract(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.ir.fsub(a, b)

    def multiply(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.ir.fmul(a, b)

    def divide(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.ir.fdiv(a, b)

    def negate(self, a: ir.Value) -> ir.Value:
        return self.ir.fneg(a)

    def multiply_add(self, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        """Emit a b + c, rounded once if the processor can."""
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

    def library(self, name: str, *arguments: ir.Value) -> ir.Value:
        """Emit a call of a function of the C library for each lane."""
        element = ELEMENTS[self.target.precision]
        full_name = name if self.target.precision == "float64" else f"{name}f"
        function = self.ir.module.globals.get(full_name)
        if function is None:
            signature = ir.FunctionType(element, [element] * len(arguments))
            function = ir.Function(self.ir.module, signature, full_name)
        if self.target.lanes == 1:
            return self.ir.call(function, arguments)
        result = ir.Constant(self.type, ir.Undefined)
        for lane in range(self.target.lanes):
            place = ir.IntType(32)(lane)
            entries = [self.ir.extract_element(argument, place) for argument in arguments]
            result = self.ir.insert_element(result, self.ir.call(function, entries), place)
        return result

    def sqrt(self, a: ir.Value) -> ir.Value:
        return self._intrinsic("llvm.sqrt", a)

    def absolute(self, a: ir.Value) -> ir.Value:
        return self._intrinsic("llvm.fabs", a)

    def floor(self, a: ir.Value) -> ir.Value:
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
        return self.ir.or_(a, b)

    def select(self, condition: ir.Value, if_true: ir.Value, if_false: ir.Value) -> ir.Value:
        return self.ir.select(condition, if_true, if_false)

    def negate_if(self, condition: ir.Value, a: ir.Value) -> ir.Value:
        """Emit -a where the condition holds, else a."""
        return self.select(condition, self.negate(a), a)

    def any_nonzero(self, base: ir.Value) -> ir.Value:
        """Emit a single truth value: whether any lane of a buffer's first vector is nonzero."""
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
