"""Random numbers from many generators at once: NumPy's PCG64, compiled.

A vectorized environment draws its starts from one generator per copy, and each must give the very bits of
`numpy.random.Generator(PCG64(seed)).uniform(-1, 1)`, which a single environment uses. Calling a Python object
for each copy would cost more than the rest of a reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from dq_space_arm_env.common.code_cache import cache_key
from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.vector_builder import DOUBLE, INDEX, POINTER

_WIDE = ir.IntType(128)
# M. O'Neill, "PCG: A family of simple fast space-efficient statistically good algorithms for random number
# generation" (2014): the multiplier of the 128-bit generator with output XSL RR.
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
_WORD = (1 << 64) - 1


def generator_states(seeds: Sequence[int | None]) -> NDArray[np.uint64]:
    """States of NumPy's PCG64 for seeds (None: unpredictable), shape (len(seeds), 4).

    A row is state and increment, low word first. Raises ValueError for a negative seed.
    """
    return np.array([generator_state(np.random.PCG64(seed)) for seed in seeds]).reshape(-1, 4)


def generator_state(bits: np.random.BitGenerator) -> NDArray[np.uint64]:
    """State of a PCG64, shape (4,), see `generator_states`. Raises ValueError for another kind."""
    state: Any = bits.state
    if state["bit_generator"] != "PCG64":
        raise ValueError(f"np_random: a {state['bit_generator']}, should be the PCG64 of reset(seed=...)")
    values = state["state"]["state"], state["state"]["inc"]
    return np.array([word for value in values for word in (value & _WORD, value >> 64)], dtype=np.uint64)


def generator_of(state: NDArray[np.uint64]) -> np.random.Generator:
    """Make the generator with a state, shape (4,)."""
    bits, words = np.random.PCG64(), [int(word) for word in state]
    inner: Any = {"state": words[0] | words[1] << 64, "inc": words[2] | words[3] << 64}
    bits.state = {"bit_generator": "PCG64", "state": inner, "has_uint32": 0, "uinteger": 0}
    return np.random.Generator(bits)


@cache
def draws_kernel(count: int) -> native.NativeKernel:
    """Compile generators of `count` numbers, or load them from the cache.

    The indexed kernel advances `states` (rows of 4 uint64) and fills `draws` (rows of `count` float64) with
    uniform numbers in [-1, 1).
    """

    def build() -> tuple[bytes, dict[str, Any]]:
        metadata = {
            "inputs": [["states", 4, False, "uint64", False]],
            "outputs": [["draws", count, False, "float64", False]],
            "operations": 0,
            "indexed": True,
        }
        return native.compile_to_object(_assembly(count)), metadata

    key = cache_key("uniform_draws", Path(__file__).read_text(encoding="utf-8"), str(count))
    return native.load_or_build("uniform_draws", key, build)


def _assembly(count: int) -> str:
    module = ir.Module("uniform_draws")
    signature = ir.FunctionType(ir.VoidType(), [INDEX, INDEX, POINTER])
    kernel = ir.Function(module, signature, "uniform_draws")
    begin, end, buffers = kernel.args
    entry, head, body, draw, after, done = (
        kernel.append_basic_block(name) for name in ("entry", "head", "body", "draw", "after", "done")
    )
    builder = ir.IRBuilder(entry)

    def word(array: ir.Value, position: ir.Value) -> ir.Value:
        return builder.load(builder.gep(array, [position], source_etype=INDEX), typ=INDEX)

    index, states, draws = (builder.inttoptr(word(buffers, INDEX(i)), POINTER) for i in range(3))
    builder.branch(head)

    builder.position_at_end(head)
    position = builder.phi(INDEX)
    position.add_incoming(begin, entry)
    builder.cbranch(builder.icmp_signed("<", position, end), body, done)

    builder.position_at_end(body)
    row = word(index, position)
    state_address = builder.gep(states, [builder.mul(row, INDEX(4))], source_etype=INDEX)
    increment_address = builder.gep(state_address, [INDEX(2)], source_etype=INDEX)
    first = builder.load(state_address, align=8, typ=_WIDE)
    increment = builder.load(increment_address, align=8, typ=_WIDE)
    target = builder.gep(draws, [builder.mul(row, INDEX(count))], source_etype=DOUBLE)
    builder.branch(draw)

    builder.position_at_end(draw)
    number, state = builder.phi(INDEX), builder.phi(_WIDE)
    number.add_incoming(INDEX(0), body)
    state.add_incoming(first, body)
    advanced = builder.add(builder.mul(state, _WIDE(_MULTIPLIER)), increment)
    builder.store(_uniform(builder, advanced), builder.gep(target, [number], source_etype=DOUBLE), align=8)
    following = builder.add(number, INDEX(1))
    number.add_incoming(following, draw)
    state.add_incoming(advanced, draw)
    builder.cbranch(builder.icmp_signed("<", following, INDEX(count)), draw, after)

    builder.position_at_end(after)
    builder.store(advanced, state_address, align=8)
    position.add_incoming(builder.add(position, INDEX(1)), after)
    builder.branch(head)

    builder.position_at_end(done)
    builder.ret_void()
    return str(module)


def _uniform(builder: ir.IRBuilder, state: ir.Value) -> ir.Value:
    """A number in [-1, 1) from a state: output function XSL RR, then 53 bits."""
    high = builder.trunc(builder.lshr(state, _WIDE(64)), INDEX)
    folded = builder.xor(high, builder.trunc(state, INDEX))
    rotation = builder.trunc(builder.lshr(state, _WIDE(122)), INDEX)
    left = builder.and_(builder.sub(INDEX(64), rotation), INDEX(63))
    output = builder.or_(builder.lshr(folded, rotation), builder.shl(folded, left))
    unit = builder.uitofp(builder.lshr(output, INDEX(11)), DOUBLE)
    # Exact, like NumPy's -1 + 2 u: u is a multiple of 2^-53.
    return builder.fsub(builder.fmul(unit, ir.Constant(DOUBLE, 2.0**-52)), ir.Constant(DOUBLE, 1.0))
