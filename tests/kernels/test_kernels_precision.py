"""Single precision: arrays, bits of lanes, and how many digits are left."""

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from scripts.benchmarks.robots import robots


def in_single_precision(scene):
    scene = load_scene(scene)
    return scene.replace(simulation={"precision": "float32"})


@pytest.mark.sampled
@pytest.mark.parametrize("scene", robots())
def test_results_are_single_and_near_those_in_double_precision(scene, draw):
    kernels, states, inputs = draw(scene, 40)
    single = compile_scene(in_single_precision(scene))
    for name in ("forward_dynamics", "step", "cost"):
        exact = getattr(kernels, name)(states, inputs)
        rounded = getattr(single, name)(states, inputs)
        assert rounded.dtype == np.float32
        scale = np.abs(exact).max(axis=-1, keepdims=True)
        assert (np.abs(rounded - exact) <= 3e-5 * scale).all(), name
        assert not np.array_equal(rounded, exact)


@pytest.mark.parametrize("scene", ["paper", "planar", "payload"])
def test_batches_give_the_bits_of_single_states(scene, draw):
    _, states, inputs = draw(scene, 35)
    single = compile_scene(in_single_precision(scene))
    one_by_one = [single.step(x, u) for x, u in zip(states, inputs, strict=True)]
    np.testing.assert_array_equal(single.step(states, inputs), one_by_one)


def test_the_papers_maneuver_of_15_s_keeps_four_digits(draw):
    single, double = compile_scene(in_single_precision("paper")), compile_scene("paper")
    x = y = double.layout.initial_state
    u = 0.1 * double.layout.control_limit * np.sin(np.arange(double.n_u))
    for _ in range(1000):
        x, y = double.step(x, u), single.step(y, u)
    assert np.abs(x - y).max() < 2e-4 * np.abs(x).max()


def test_vectors_hold_twice_as_many_numbers():
    assert compile_scene(in_single_precision("paper")).lanes == 2 * compile_scene("paper").lanes
