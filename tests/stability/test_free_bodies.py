"""Reaction wrenches (21) and accelerations against bodies cut free with 50 digits, masses far apart.

The equations run over plain numbers here; benchmark `stability` holds the machine code to bounds as tight.
"""

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.vector_field import split_state

pytest.importorskip("mpmath")

from scripts.benchmarks.peers.robot import beyond_rigid_bodies
from scripts.benchmarks.robots import robots
from scripts.benchmarks.stability.free_bodies import free_bodies
from scripts.benchmarks.stability.masses import samples
from scripts.benchmarks.stability.reactions import LIGHTEST, acceleration_error, wrench_error
from scripts.benchmarks.stability.references import accelerations, linear_system
from scripts.benchmarks.stability.scenes import random_arm

RATIOS = (1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e8, 1e12)  # base to arm


def errors(scene, seed=0):
    """Errors of wrenches and accelerations, each part relative to its own size."""
    sample = samples(scene, seed + 1)[seed]
    exact = free_bodies(sample)
    field = EquationsOfMotion(sample.tree, sample.kernels.layout)
    y, u = split_state(field, sample.state.tolist())[1], sample.control.tolist()
    found = np.array(field.reaction_wrenches(y, u)), np.array(field.accelerations(y, u))
    return wrench_error(found[0], exact), acceleration_error(found[1], exact)


@pytest.mark.parametrize("name", [name for name in robots() if not beyond_rigid_bodies(load_scene(name))])
def test_free_bodies_agree_with_every_shipped_robot(name):
    """Wrists, payloads, wrenches at the tip and a planar base are in both."""
    (sample,) = samples(load_scene(name), 1)
    exact = free_bodies(sample)
    for found, right in (
        (sample.kernels.reaction_wrenches(sample.state, sample.control), exact.reactions[:, :5].ravel()),
        (sample.kernels.forward_dynamics(sample.state, sample.control), exact.accelerations),
    ):
        assert np.abs(found - right).max() < 2e-15 * np.abs(right).max()


def test_free_bodies_agree_with_kanes_equations():
    for sample in samples(load_scene("payload"), 3):
        right = accelerations(linear_system(sample.tree, sample.motion), sample.motion)
        np.testing.assert_allclose(free_bodies(sample).accelerations, right, rtol=1e-14)


@pytest.mark.sampled
@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("joints", [1, 3])
def test_wrenches_and_accelerations_keep_their_digits_at_any_mass_of_the_base(joints, ratio):
    for seed in range(3):
        wrenches, parts = errors(random_arm([ratio, *[1.0 / joints] * joints], seed), seed)
        assert wrenches < 2e-14
        assert parts < 1e-13


@pytest.mark.parametrize("ratio", [LIGHTEST, 1.0 / LIGHTEST])
def test_six_joints_and_a_payload_keep_their_digits_too(ratio):
    for masses, payload in (([ratio, *[1.0] * 6], 0.0), ([1.0] * 4, ratio)):
        wrenches, parts = errors(random_arm(masses, 0, payload))
        assert wrenches < 1e-13
        assert parts < 2e-13


@pytest.mark.parametrize("light", [1e-6, LIGHTEST])
def test_heavy_and_light_bodies_in_turn_keep_their_digits(light):
    for masses in ([1.0, light, 1.0, light], [light, 1.0, light, 1.0], [light, light, 1.0, light, light]):
        wrenches, parts = errors(random_arm(masses, 1))
        assert wrenches < 3e-14
        assert parts < 1e-14
