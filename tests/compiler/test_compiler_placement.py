"""Placement of buffers: no two that are needed at the same time share memory, and others do."""

from itertools import combinations

import numpy as np
import pytest
from graph_interpreter import evaluate_program

from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import assembly, build_program
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Lifetime, Program, place


@pytest.mark.parametrize("seed", range(20))
def test_buffers_that_are_needed_at_the_same_time_do_not_overlap(seed):
    rng = np.random.default_rng(seed)
    sizes = {f"b{i}": int(rng.integers(0, 9)) for i in range(12)}
    lifetimes = {name: Lifetime(*sorted(rng.integers(-1, 8, 2).tolist())) for name in sizes}
    starts, total = place(sizes, lifetimes)
    for a, b in combinations(sizes, 2):
        if lifetimes[a].overlaps(lifetimes[b]):
            assert starts[a] + sizes[a] <= starts[b] or starts[b] + sizes[b] <= starts[a]
    needed = [sum(sizes[b] for b in sizes if lifetimes[b].first <= t <= lifetimes[b].last) for t in range(8)]
    assert max(needed) <= total <= sum(sizes.values())


def test_a_chain_of_calls_needs_room_for_two_links():
    twice = trace("twice", {"a": 5}, lambda a: {"b": [2.0 * entry for entry in a]})
    program = Program("chain", [Buffer("b0", 5)], [Buffer("b4", 5)])
    for i in range(4):
        program.call(twice, a=f"b{i}", b=f"b{i + 1}")
    assert place(program.scratch_sizes(), program.lifetimes())[1] == 10


# What a call must not find --------------------------------------------------------------------------------


def doubled():
    return trace("doubled", {"a": 3}, lambda a: {"b": [2.0 * entry for entry in a]})


def build(program):
    return assembly(program, 4)


def test_a_call_must_not_write_what_it_reads():
    """Arguments are noalias: LLVM may store before it loads."""
    program = Program("in_place", [Buffer("x", 3)], [Buffer("x_next", 3)])
    program.call(doubled(), a="x", b="x_next")
    program.call(doubled(), a="x_next", b="x_next")
    with pytest.raises(ValueError, match="'in_place': call 1 of graph 'doubled' writes buffer 'x_next'"):
        build(program)


def test_a_call_must_not_write_a_buffer_twice():
    both = trace("both", {"a": 3}, lambda a: {"b": a, "c": a})
    program = Program("twice", [Buffer("x", 3)], [Buffer("y", 3)])
    program.call(both, a="x", b="y", c="y")
    with pytest.raises(ValueError, match="shares memory with 'y', another of its arguments"):
        build(program)


def test_buffers_of_different_names_must_lie_apart_too():
    """A wrong lifetime would be found out, whatever became of the names."""
    program = Program("chain", [Buffer("x", 3)], [Buffer("z", 3)])
    program.call(doubled(), a="x", b="y")
    program.call(doubled(), a="y", b="z")
    program.check_memory({"x": 0, "y": 3, "z": 0})
    with pytest.raises(ValueError, match="graph 'doubled' writes buffer 'z', which shares memory with"):
        program.check_memory({"x": 0, "y": 3, "z": 5})


def test_what_starts_as_zero_must_stay_zero():
    """Memory is cleared once, not for every block of rows."""
    step = trace("step", {"a": 3, "old": 3}, lambda a, old: {"new": [a[i] + old[i] for i in range(3)]})
    program = Program("sum", [Buffer("a", 3)], [Buffer("sum", 3)])
    program.call(step, old="zero", new="sum")
    program.call(doubled(), a="sum", b="zero")
    with pytest.raises(ValueError, match="writes buffer 'zero', which starts as zero for all rows"):
        build(program)


def test_a_loop_inside_a_loop_is_refused():
    program = Program("nested", [Buffer("x", 3)], [Buffer("y", 3)])

    def nest():
        with program.repeated_while("outer"):
            program.call(doubled(), a="x", b="y")
            with program.repeated_while("inner"):
                program.call(doubled(), a="y", b="z")

    with pytest.raises(ValueError, match="'nested': a loop inside a loop"):
        nest()


@pytest.mark.parametrize("seed", range(30))
def test_random_programs_with_loops_compute_what_their_calls_say(seed):
    """Memory is reused wherever lifetimes allow; a buffer given up too early would change the numbers."""
    rng = np.random.default_rng(seed)
    program = random_program(rng)
    x = rng.normal(size=(11, 3))
    wanted = evaluate_program(program, {"x": x.T})["result"]
    kernel = native.NativeKernel(program.name, *build_program(program, 4))
    result = np.zeros_like(x)
    buffers = np.array([array.ctypes.data for array in (x, result)], dtype=np.int64)
    kernel.function(0, len(x), buffers.ctypes.data)
    np.testing.assert_allclose(result, np.array(wanted).T, rtol=1e-12)


def random_program(rng):
    """Some ten sums of two of the buffers before, some of them in a loop of three passes."""
    program = Program("random_calls", [Buffer("x", 3)], [Buffer("result", 3)])

    def mean(a, b):
        return {"c": [0.6 * p - 0.5 * q + 0.1 for p, q in zip(a, b, strict=True)]}

    def hand_on(last, left):
        return {"carried": [0.5 * entry for entry in last], "fewer": [left[0] - 1.0]}

    known = ["x"]

    def append(count):
        for _ in range(count):
            a, b = map(str, rng.choice(known, 2))
            known.append(f"b{len(known)}")
            program.call(trace("mean", {"a": 3, "b": 3}, mean), a=a, b=b, c=known[-1])

    append(rng.integers(1, 5))
    program.call(trace("begin", {"x": 3}, lambda x: {"left": [3.0], "carried": x}))
    known.append("carried")
    with program.repeated_while("left"):
        append(rng.integers(1, 5))
        program.call(trace("hand_on", {"last": 3, "left": 1}, hand_on), last=known[-1])
        program.call(trace("count", {"fewer": 1}, lambda fewer: {"left": fewer}))
    append(rng.integers(1, 5))
    program.call(trace("end", {"last": 3}, lambda last: {"result": last}), last=known[-1])
    return program
