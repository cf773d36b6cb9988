"""Loops in programs: every lane goes through as many passes as it needs, and none more."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program


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
