"""Random states and inputs of scenes."""

import numpy as np
import pytest

from dq_space_arm_env import compile_scene
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.scene.start import unit_quaternions


def random_states(kernels, count, seed=0, scale=1.0):
    """States all over the place: any attitude, positions of metres, rates of about 1 rad/s."""
    rng = np.random.default_rng(seed)
    layout = kernels.layout
    x = rng.normal(size=(count, kernels.n_x)) * scale
    for row in x:
        twist = rng.normal(size=6)
        if layout.planar:
            twist[[0, 1, 5]] = 0.0
        pose = np.array(screw.exponential(tuple(twist.tolist())))
        row[layout.state.pose] = pose[[0, 3, 5, 6]] if layout.planar else pose
    for where in unit_quaternions(kernels.scene):
        x[:, where] /= np.linalg.norm(x[:, where], axis=1, keepdims=True)
    return x


def random_inputs(kernels, count, seed=1):
    return np.random.default_rng(seed).normal(size=(count, kernels.n_u))


@pytest.fixture
def draw():
    def states_and_inputs(scene, count, seed=0):
        kernels = compile_scene(scene)
        return kernels, random_states(kernels, count, seed), random_inputs(kernels, count, seed + 1)

    return states_and_inputs
