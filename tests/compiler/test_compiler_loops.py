"""Loops in programs: every lane goes through as many passes as it needs, and none more."""

import casadi
import numpy as np
import pytest
from graph_interpreter import evaluate_program

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
    end = trace("divisor_end", sizes, lambda values, count: {"passes": count, "common": values})
    program.call(end)
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
def test_lanes_leave_a_loop_when_they_are_done(lanes, tmp_path, monkeypatch):
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path))
    assert max(PASSES) > 10 * min(PASSES)
    kernel = native.load_or_build("divisor", f"divisor-{lanes}", lambda: build_program(divisor(), lanes))
    passes, common = np.zeros(len(PAIRS)), np.zeros_like(PAIRS)
    buffers = np.array([array.ctypes.data for array in (PAIRS, passes, common)], dtype=np.int64)
    kernel.function(0, len(PAIRS), buffers.ctypes.data)
    np.testing.assert_array_equal(passes, PASSES)
    np.testing.assert_array_equal(common, np.gcd(*PAIRS.astype(int).T)[:, None] * [1, 1])


def test_the_interpreter_of_the_tests_loops_as_well():
    result = evaluate_program(divisor(), {"pair": PAIRS.T})
    np.testing.assert_array_equal(result["passes"][0], PASSES)


def test_a_loop_counts_once_among_the_operations():
    program = divisor()
    assert program.operation_count == sum(call.graph.operation_count for call in program.calls)
    assert [(loop.begin, loop.end, loop.condition) for loop in program.loops] == [(1, 3, "unfinished")]
