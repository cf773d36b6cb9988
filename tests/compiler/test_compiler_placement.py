"""Placement of buffers: no two that are needed at the same time share memory, and others do."""

from itertools import combinations

import numpy as np
import pytest

from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.placement import Lifetime, place
from dq_space_arm_env.compiler.program import Buffer, Program


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


def test_what_starts_as_zero_keeps_its_memory():
    step = trace("step", {"a": 1, "old": 1}, lambda a, old: {"new": [a[0] + old[0]]})
    program = Program("keeping", [Buffer("a", 1)], [Buffer("sum", 1)])
    program.call(step, old="zero", new="b")
    program.call(step, old="b", new="sum")
    lifetimes = program.lifetimes()
    assert all(lifetimes["zero"].overlaps(lifetimes[name]) for name in ("a", "b", "sum"))
