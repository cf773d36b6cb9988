"""Vector arithmetic in LLVM: one operation on every lane.

`VectorBuilder` writes the functions of graphs, tens of thousands of instructions, as text: an object for each
takes llvmlite five times as long, and LLVM is given text all the same. `BlockBuilder` appends the few
instructions around them to functions of `llvmlite.ir`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from llvmlite import ir

INDEX = ir.IntType(64)
DOUBLE = ir.DoubleType()
POINTER = ir.PointerType()
# Types of array elements by name; truth values take a byte.
ELEMENTS: Mapping[str, ir.Type] = {"float64": DOUBLE, "float32": ir.FloatType(), "bool": ir.IntType(8)}
BYTES = {"float64": 8, "float32": 4, "bool": 1}

_ORDERED = {"<": "olt", "<=": "ole", "==": "oeq", ">": "ogt", ">=": "oge"}


@dataclass(frozen=True)
class Target:
    """Vector width, instructions and precision of the generated code."""

    lanes: int  # 1 gives scalar code
    fused: bool  # the processor has fused multiply-add
    precision: str = "float64"  # or "float32"


def vector_type(element: ir.Type, lanes: int) -> ir.Type:
    """Type of a vector; one lane is a plain number."""
    return ir.VectorType(element, lanes) if lanes > 1 else element


class BlockBuilder:
    """Access to buffers of vectors, appended to a function of `llvmlite.ir`."""

    def __init__(self, builder: ir.IRBuilder, target: Target) -> None:
        self.ir = builder
        self.target = target
        self.type: ir.Type = vector_type(ELEMENTS[target.precision], target.lanes)
        self.alignment = BYTES[target.precision] * target.lanes

    def nonzero(self, vector: ir.Value) -> ir.Value:
        """Emit a truth value per lane: whether it is not zero, as NaN is not."""
        lanes = self.target.lanes
        zero = ir.Constant(self.type, [0.0] * lanes if lanes > 1 else 0.0)
        return self.ir.fcmp_unordered("!=", vector, zero)

    def any_nonzero(self, base: ir.Value) -> ir.Value:
        """Emit a single truth value: whether any lane of a buffer's first vector is nonzero."""
        found = self.nonzero(self.load(base, 0))
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


class WrittenFunction(ir.Function):
    """An internal function of pointers to memory that does not overlap, whose body is given as text."""

    def __init__(self, module: ir.Module, name: str, pointers: int) -> None:
        super().__init__(module, ir.FunctionType(ir.VoidType(), [POINTER] * pointers), name)
        self.lines: list[str] = []

    def __str__(self) -> str:
        """The function in LLVM's assembly."""
        pointers = ", ".join(f"ptr noalias %p{i}" for i in range(len(self.args)))
        head = f'define internal void @"{self.name}"({pointers})\n{{\nentry:\n'
        return head + "\n".join(self.lines) + "\n}\n"


class VectorBuilder:
    """Arithmetic on vectors of `lanes` numbers or truth values, appended to a function; values are names."""

    def __init__(self, function: WrittenFunction, target: Target) -> None:
        self.target = target
        self.pointers = [f"%p{i}" for i in range(len(function.args))]
        self._module, self._lines = function.module, function.lines
        self._values, self._blocks = 0, 0
        self._constants: dict[float, str] = {}
        self._element, self._alignment = ELEMENTS[target.precision], BYTES[target.precision] * target.lanes
        self._type = str(vector_type(self._element, target.lanes))
        self._truths = str(vector_type(ir.IntType(1), target.lanes))

    def _emit(self, instruction: str) -> str:
        """Append an instruction and name its value; LLVM wants these numbers to be consecutive."""
        name = f"%{self._values}"
        self._values += 1
        self._lines.append(f"  {name} = {instruction}")
        return name

    def end(self) -> None:
        """End the function."""
        self._lines.append("  ret void")
        if self._blocks:
            self._lines += ["unreached:", "  ret void"]

    def begin_block(self) -> None:
        """Continue in a new block if an address is not zero: LLVM would merge blocks without a condition."""
        here = self._emit(f"icmp ne ptr {self.pointers[0]}, null")
        self._blocks += 1
        following = f"block{self._blocks}"
        self._lines += [f"  br i1 {here}, label %{following}, label %unreached", f"{following}:"]

    def constant(self, value: float) -> str:
        """A vector with the same value in every lane."""
        if value == 0.0 or value not in self._constants:  # zeros of both signs are equal
            number = value
            if self.target.precision == "float32":
                (number,) = struct.unpack("f", struct.pack("f", value))
            text = f"0x{struct.pack('>d', number).hex().upper()}"
            self._constants[value] = text if self.target.lanes == 1 else f"splat ({self._element} {text})"
        return self._constants[value]

    def add(self, a: str, b: str) -> str:
        return self._emit(f"fadd {self._type} {a}, {b}")

    def subtract(self, a: str, b: str) -> str:
        return self._emit(f"fsub {self._type} {a}, {b}")

    def multiply(self, a: str, b: str) -> str:
        return self._emit(f"fmul {self._type} {a}, {b}")

    def divide(self, a: str, b: str) -> str:
        return self._emit(f"fdiv {self._type} {a}, {b}")

    def negate(self, a: str) -> str:
        return self._emit(f"fneg {self._type} {a}")

    def multiply_add(self, a: str, b: str, c: str) -> str:
        """Emit a b + c, rounded once if the processor can."""
        if not self.target.fused:
            return self.add(self.multiply(a, b), c)
        return self._intrinsic("fma", a, b, c)

    def _intrinsic(self, name: str, *arguments: str) -> str:
        lanes, bits = self.target.lanes, 8 * BYTES[self.target.precision]
        full_name = f"llvm.{name}.v{lanes}f{bits}" if lanes > 1 else f"llvm.{name}.f{bits}"
        return self._call(full_name, vector_type(self._element, lanes), arguments)

    def _call(self, name: str, kind: ir.Type, arguments: Sequence[str]) -> str:
        """Emit a call of a function of numbers or vectors of a type, declared in the module."""
        if name not in self._module.globals:
            ir.Function(self._module, ir.FunctionType(kind, [kind] * len(arguments)), name)
        given = ", ".join([f"{kind} {argument}" for argument in arguments])
        return self._emit(f"call {kind} @{name}({given})")

    def library(self, name: str, *arguments: str) -> str:
        """Emit a call of a function of the C library for each lane."""
        element = self._element
        full_name = name if self.target.precision == "float64" else f"{name}f"
        if self.target.lanes == 1:
            return self._call(full_name, element, arguments)
        result = "undef"
        for lane in range(self.target.lanes):
            entries = [
                self._emit(f"extractelement {self._type} {argument}, i32 {lane}") for argument in arguments
            ]
            value = self._call(full_name, element, entries)
            result = self._emit(f"insertelement {self._type} {result}, {element} {value}, i32 {lane}")
        return result

    def sqrt(self, a: str) -> str:
        return self._intrinsic("sqrt", a)

    def absolute(self, a: str) -> str:
        return self._intrinsic("fabs", a)

    def floor(self, a: str) -> str:
        return self._intrinsic("floor", a)

    def round(self, a: str) -> str:
        """Emit the nearest integer, ties to even."""
        return self._intrinsic("rint", a)

    def compare(self, relation: str, a: str, b: str) -> str:
        """Emit a truth value per lane; every comparison with NaN but `!=` is false."""
        condition = "une" if relation == "!=" else _ORDERED[relation]
        return self._emit(f"fcmp {condition} {self._type} {a}, {b}")

    def either(self, a: str, b: str) -> str:
        return self._emit(f"or {self._truths} {a}, {b}")

    def both(self, a: str, b: str) -> str:
        return self._emit(f"and {self._truths} {a}, {b}")

    def opposite(self, a: str) -> str:
        """Emit the negation of truth values."""
        return self._emit(
            f"xor {self._truths} {a}, {'true' if self.target.lanes == 1 else 'splat (i1 true)'}"
        )

    def number(self, truth: str) -> str:
        """Emit 1 for true, 0 for false."""
        return self._emit(f"uitofp {self._truths} {truth} to {self._type}")

    def select(self, condition: str, if_true: str, if_false: str) -> str:
        return self._emit(
            f"select {self._truths} {condition}, {self._type} {if_true}, {self._type} {if_false}"
        )

    def negate_if(self, condition: str, a: str) -> str:
        """Emit -a where the condition holds, else a."""
        return self.select(condition, self.negate(a), a)

    def load(self, base: str, index: int) -> str:
        """Emit a read of vector number `index` of a buffer."""
        address = self._address(base, index)
        return self._emit(f"load {self._type}, ptr {address}, align {self._alignment}")

    def store(self, value: str, base: str, index: int) -> None:
        """Emit a write of vector number `index` of a buffer."""
        address = self._address(base, index)
        self._lines.append(f"  store {self._type} {value}, ptr {address}, align {self._alignment}")

    def _address(self, base: str, index: int) -> str:
        return self._emit(f"getelementptr {self._type}, ptr {base}, i64 {index}")
