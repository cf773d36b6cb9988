"""Loops and guards: every lane goes through as many passes as it needs; what no lane needs is passed over."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.cotangent import append_cotangents
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Guard, Program
from dq_space_arm_env.compiler.tangent import append_tangents


def divisor():
    """Greatest common divisor by Euclid's subtractions, and how many of them it takes."""
    program = Program("divisor", [Buffer("pair", 2)], [Buffer("passes", 1), Buffer("common", 2)])
    program.call(trace("divisor_begin", {"pair": 2}, lambda pair: {"values": pair, "count": [0.0]}))

    def subtract(values, count):
        a, b = values
        larger, smaller = casadi.fmax(a, b), casadi.fmin(a, b)
        going = larger > smaller
        moved = casadi.if_else(going, larger - smaller, larger)
        return {"moved": [moved, smaller], "counted": [count[0] + going], "unfinished": [moved != smaller]}

    def move(moved, counted):
        return {"values": moved, "count": counted}

    with program.repeated_while("unfinished"):
        program.call(trace("divisor_subtract", {"values": 2, "count": 1}, subtract))
        program.call(trace("divisor_move", {"moved": 2, "counted": 1}, move))
    sizes = {"values": 2, "count": 1}
    program.call(trace("divisor_end", sizes, lambda values, count: {"passes": count, "common": values}))
    return program


def expected_passes(a, b):
    passes = 0
    while a != b:
        a, b = max(a, b) - min(a, b), min(a, b)
        passes += 1
    return passes


PAIRS = np.random.default_rng(0).integers(1, 60, size=(61, 2)).astype(float)
PASSES = [expected_passes(*pair) for pair in PAIRS]


@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_lanes_leave_a_loop_when_they_are_done(lanes):
    assert max(PASSES) > 10 * min(PASSES)
    kernel = native.NativeKernel("divisor", *build_program(divisor(), lanes))
    passes, common = np.zeros(len(PAIRS)), np.zeros_like(PAIRS)
    buffers = np.array([array.ctypes.data for array in (PAIRS, passes, common)], dtype=np.int64)
    kernel.function(0, len(PAIRS), buffers.ctypes.data)
    np.testing.assert_array_equal(passes, PASSES)
    np.testing.assert_array_equal(common, np.gcd(*PAIRS.astype(int).T)[:, None] * [1, 1])


def guarded():
    """Tells which rows share a block with a negative number."""
    program = Program("guarded", [Buffer("x", 1)], [Buffer("ran", 1)])
    program.call(trace("guarded_begin", {"x": 1}, lambda x: {"is_negative": [x[0] < 0.0], "ran": [0.0]}))
    with program.only_where("is_negative"):
        program.call(trace("guarded_rest", {"x": 1}, lambda x: {"ran": [x[0] / x[0]]}))
    return program


@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_guarded_calls_run_for_blocks_with_a_lane_that_needs_them(lanes):
    x = np.random.default_rng(0).uniform(-0.1, 1.0, size=61)
    assert 0 < np.count_nonzero(x < 0.0) < len(x) // 4
    kernel = native.NativeKernel("guarded", *build_program(guarded(), lanes))
    ran = np.full(len(x), np.nan)
    buffers = np.array([array.ctypes.data for array in (x, ran)], dtype=np.int64)
    kernel.function(0, len(x), buffers.ctypes.data)
    expected = [(x[first : first + lanes] < 0.0).any() for first in range(0, len(x), lanes)]
    np.testing.assert_array_equal(ran, np.repeat(expected, lanes)[: len(x)])


def test_guards_move_with_their_program_and_their_operations_do_not_count():
    program = Program("whole", [Buffer("a", 1)], [Buffer("ran", 1)])
    program.call(trace("whole_begin", {"a": 1}, lambda a: {"x": [2.5 * a[0]]}))
    program.append(guarded(), is_negative="is_below")
    assert program.guards == [Guard(2, 3, "is_below")]
    assert program.operation_count == 2  # one product, one comparison, no quotient


def test_guards_are_not_nested_and_have_no_derivatives():
    program = guarded()
    with pytest.raises(ValueError, match="'guarded': a guard inside a guard"):  # noqa: SIM117
        with program.only_where("is_negative"):
            program.append(guarded(), ran="ran_too")
    with pytest.raises(ValueError, match="'guarded': a guard inside a loop"):  # noqa: SIM117
        with program.repeated_while("is_negative"):
            program.append(guarded(), ran="ran_thrice")
    with pytest.raises(ValueError, match="no call has written 'x', a guard's condition"):  # noqa: SIM117
        with program.only_where("x"):
            pass
    with pytest.raises(ValueError, match="'guarded' has a loop or a guard, which has no reverse"):
        append_cotangents(guarded(), {"ran": "x"}, ("x",))
    with pytest.raises(ValueError, match="'guarded' has a guard, which has no tangents"):
        append_tangents(guarded(), ("x",), "ran")
