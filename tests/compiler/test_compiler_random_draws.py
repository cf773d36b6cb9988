"""Compiled random numbers: the bits of NumPy's generators."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dq_space_arm_env.compiler.random_draws import draws_kernel, generator_states


def draw(states, rows, count):
    rows = np.array(rows, dtype=np.int64)
    draws = np.full((len(states), count), 9.0)
    buffers = np.array([array.ctypes.data for array in (rows, states, draws)], dtype=np.int64)
    draws_kernel(count).function(0, len(rows), buffers.ctypes.data)
    return draws


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 2**128), min_size=1, max_size=5), st.sampled_from([1, 7, 20]))
def test_numbers_are_those_of_numpy_call_after_call(seeds, count):
    states = generator_states(seeds)
    generators = [np.random.Generator(np.random.PCG64(seed)) for seed in seeds]
    for _ in range(3):
        expected = [generator.uniform(-1.0, 1.0, count) for generator in generators]
        np.testing.assert_array_equal(draw(states, range(len(seeds)), count), expected)


def test_only_the_generators_in_the_list_go_on():
    states = generator_states([1, 2, 3, 4])
    before = states.copy()
    draws = draw(states, [3, 1], 5)
    np.testing.assert_array_equal(states[[0, 2]], before[[0, 2]])
    assert (states[[1, 3]] != before[[1, 3]]).any(axis=1).all()
    assert (draws[[0, 2]] == 9.0).all()
    np.testing.assert_array_equal(draws[3], np.random.Generator(np.random.PCG64(4)).uniform(-1, 1, 5))


def test_without_a_seed_generators_differ():
    states = generator_states([None, None])
    assert (states[0] != states[1]).any()


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="non-negative"):
        generator_states([-1])
