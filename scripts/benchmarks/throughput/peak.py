"""The arithmetic peak of one core, measured: fused multiply-adds on full-width vectors that never wait.

A fused multiply-add is ready some cycles after its issue, and a core issues several of them per cycle: only
enough independent ones keep it busy. Their number, and how many vectors fit into the registers, depend on the
processor: the best rate of several numbers counts. The share of this peak that a kernel reaches tells how
much of the core it uses.
"""

import time
from collections.abc import Iterator

import numpy as np
from llvmlite import ir

from dq_space_arm_env.common.host_machine import host_machine
from dq_space_arm_env.compiler.native import NativeKernel, compile_to_object
from scripts.benchmarks.harness import Row

PRECISIONS = ("float64", "float32")
ACCUMULATORS = (8, 10, 12, 16, 24)
"""Independent sums that are tried; 16 or 32 vector registers are what processors have."""

_NAME = "multiply_add_peak"
_INDEX, _POINTER = ir.IntType(64), ir.PointerType()
_TRIAL_SECONDS = 0.003


class MultiplyAdd:
    """Machine code that computes s <- a s + b on many independent vectors s."""

    def __init__(self, precision: str, accumulators: int) -> None:
        self.precision, self.accumulators = precision, accumulators
        self.lanes = host_machine().lanes * 8 // np.dtype(precision).itemsize
        assembly = _assembly(precision, self.lanes, accumulators)
        self._kernel = NativeKernel(_NAME, compile_to_object(assembly), {})

    def run(self, sums: np.ndarray, a: float, b: float, count: int) -> None:
        """Replace each number s of an array by a s + b, several times."""
        constants = np.array([a, b], dtype=self.precision)
        buffers = np.array([sums.ctypes.data, constants.ctypes.data], dtype=np.int64)
        self._kernel.function(0, count, buffers.ctypes.data)

    def operations_per_ns(self, repeats: int) -> float:
        sums = np.zeros((self.accumulators, self.lanes), dtype=self.precision)

        def seconds(count: int) -> float:
            start = time.perf_counter()
            self.run(sums, 0.5, 1.0, count)  # tends to 2: neither overflow nor denormal numbers
            return time.perf_counter() - start

        count = 1000
        while (trial := seconds(count)) < 0.1 * _TRIAL_SECONDS:
            count *= 4
        count = max(1, round(count * _TRIAL_SECONDS / trial))
        best = min(seconds(count) for _ in range(repeats))
        return 2e-9 * sums.size * count / best


def measure_peak(repeats: int) -> Iterator[Row]:
    """The peak of this process's core for each precision; a multiply-add is two operations."""
    for precision in PRECISIONS:
        candidates = [MultiplyAdd(precision, count) for count in ACCUMULATORS]
        rates = [candidate.operations_per_ns(repeats) for candidate in candidates]
        best = int(np.argmax(rates))
        yield {
            "table": "peaks",
            "precision": precision,
            "lanes": candidates[best].lanes,
            "accumulators": ACCUMULATORS[best],
            "operations_per_ns": rates[best],
        }


def _assembly(precision: str, lanes: int, accumulators: int) -> str:
    """LLVM assembly: a loop over rows as in every kernel, here over repetitions, at least one."""
    module = ir.Module(_NAME)
    vector = ir.VectorType(ir.DoubleType() if precision == "float64" else ir.FloatType(), lanes)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [_INDEX, _INDEX, _POINTER]), _NAME)
    begin, end, addresses = function.args
    entry, body, done = (function.append_basic_block(name) for name in ("entry", "body", "done"))

    builder = ir.IRBuilder(entry)
    sums, constants = (_buffer(builder, addresses, position) for position in range(2))
    a, b = (_spread(builder, constants, position, vector) for position in range(2))
    alignment = np.dtype(precision).itemsize
    places = [builder.gep(sums, [_INDEX(k)], source_etype=vector) for k in range(accumulators)]
    loaded = [builder.load(place, align=alignment, typ=vector) for place in places]
    builder.branch(body)

    builder.position_at_end(body)
    row = builder.phi(_INDEX)
    values = [builder.phi(vector) for _ in places]
    updated = [_multiply_add(builder, value, a, b) for value in values]
    following = builder.add(row, _INDEX(1))
    for phi, before, after in zip((row, *values), (begin, *loaded), (following, *updated), strict=True):
        phi.add_incoming(before, entry)
        phi.add_incoming(after, body)
    builder.cbranch(builder.icmp_signed("<", following, end), body, done)

    builder.position_at_end(done)
    for place, result in zip(places, updated, strict=True):
        builder.store(result, place, align=alignment)
    builder.ret_void()
    return str(module)


def _buffer(builder: ir.IRBuilder, addresses: ir.Value, position: int) -> ir.Value:
    slot = builder.gep(addresses, [_INDEX(position)], source_etype=_INDEX)
    return builder.inttoptr(builder.load(slot, typ=_INDEX), _POINTER)


def _spread(builder: ir.IRBuilder, constants: ir.Value, position: int, vector: ir.VectorType) -> ir.Value:
    """One number in every lane; read at run time, so that the compiler cannot simplify with it."""
    place = builder.gep(constants, [_INDEX(position)], source_etype=vector.element)
    number = builder.load(place, typ=vector.element)
    single = builder.insert_element(ir.Constant(vector, ir.Undefined), number, _INDEX(0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
    return builder.shuffle_vector(single, ir.Constant(vector, ir.Undefined), lanes)


def _multiply_add(builder: ir.IRBuilder, value: ir.Value, a: ir.Value, b: ir.Value) -> ir.Value:
    """Fused where the processor can, as in the kernels."""
    if not host_machine().fused:
        return builder.fadd(builder.fmul(value, a), b)
    vector = value.type
    name = f"llvm.fma.v{vector.count}f{64 if isinstance(vector.element, ir.DoubleType) else 32}"
    intrinsic = builder.module.globals.get(name)
    if intrinsic is None:
        intrinsic = ir.Function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
    return builder.call(intrinsic, [value, a, b])
