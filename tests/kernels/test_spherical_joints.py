"""Spherical joints in machine code: quaternions of unit length, both signs, starts, what is refused."""

import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, SceneError, compile_scene, load_scene
from dq_space_arm_env.environment.disturbances import Disturbances
from dq_space_arm_env.environment.rollouts import StateFeedback, rollout
from dq_space_arm_env.scene import draw_initial_state
from dq_space_arm_env.scene.start import unit_quaternions


@pytest.fixture(scope="module")
def kernels():
    return compile_scene("heavy-wrist")


def moving(kernels, seed=0):
    """A state in fast motion, and where its quaternion is."""
    (where,), rng = unit_quaternions(kernels.scene), np.random.default_rng(seed)
    x = kernels.layout.initial_state.copy()
    x[where] = rng.normal(size=4)
    x[where] /= np.linalg.norm(x[where])
    x[kernels.layout.state.base_velocity.start :] = 0.5 * rng.normal(size=12)
    return x, where


def test_the_quaternion_keeps_its_length_and_the_momentum_stays(kernels):
    x, where = moving(kernels)
    states = kernels.simulate(x, np.zeros(kernels.n_u), steps=10_000)
    assert np.abs(np.linalg.norm(states[:, where], axis=1) - 1.0).max() < 1e-15
    drift = kernels.momentum(states[100]) - kernels.momentum(x)
    assert np.abs(drift).max() < 1e-7  # of rk4 in steps of 15 ms


def test_pushes_and_noise_leave_the_quaternion_a_rotation(kernels):
    venv, rng = DQSpaceArmVectorEnv(2, kernels.scene), np.random.default_rng(0)
    (where,), layout = unit_quaternions(kernels.scene), kernels.layout
    venv.reset(seed=0)
    before, increments = venv.states, 0.1 * rng.normal(size=(2, kernels.n_t))
    increments[1, : layout.tangent.base_velocity.start] = 0.0
    venv.perturb(increments)
    np.testing.assert_allclose(np.linalg.norm(venv.states[0, where]), 1.0, rtol=0, atol=1e-15)
    assert np.abs(venv.states[0, where] - before[0, where]).max() > 0.01
    np.testing.assert_array_equal(venv.states[1, where], before[1, where])
    np.testing.assert_allclose(np.linalg.norm(venv.observe()[:, :4], axis=1), 1.0, rtol=0, atol=1e-14)
    lengths = []

    def act(states, step):
        lengths.append(np.linalg.norm(states[0, where]))
        return np.zeros((1, kernels.n_u))

    noise = Disturbances(kernels.scene, rng, measurement=0.1)
    rollout(StateFeedback(act), kernels.scene, disturbances=noise, steps=3)
    np.testing.assert_allclose(lengths, 1.0, rtol=0, atol=1e-15)


def test_q_and_its_negative_move_alike(kernels):
    x, where = moving(kernels)
    u = np.random.default_rng(1).normal(size=kernels.n_u)
    other = x.copy()
    other[where] *= -1.0
    one, two = kernels.step(x, u), kernels.step(other, u)
    two[where] *= -1.0
    np.testing.assert_array_equal(one, two)


def test_the_dense_motion_has_quaternions_of_unit_length(kernels):
    x, where = moving(kernels)
    motion = kernels.integrate(x, np.zeros(kernels.n_u), 0.5, rtol=1e-8, atol=1e-10)
    states = motion.sol(np.linspace(0.0, 0.5, 7))
    assert np.abs(np.linalg.norm(states[:, where], axis=1) - 1.0).max() < 1e-15
    steps = kernels.simulate(x, np.zeros(kernels.n_u), steps=2000, dt=0.5 / 2000)
    np.testing.assert_allclose(states[-1], steps[-1], rtol=0, atol=1e-7)


def test_starts_have_the_sign_of_a_scalar_part_above_zero():
    scene = load_scene("heavy-wrist").replace({"spread.joint_angles": 3.0})
    (where,), rng = unit_quaternions(scene), np.random.default_rng(0)
    for _ in range(20):
        q = draw_initial_state(scene, rng)[where]
        assert q[0] >= 0.0
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)


def test_a_start_that_is_no_rotation_and_other_integrators_are_refused(kernels):
    x, where = moving(kernels)
    with DQSpaceArmEnv("heavy-wrist") as env:
        env.reset(options={"initial_state": x})
        x[where] *= 1.1
        with pytest.raises(ValueError, match=r"a spherical joint with \|q\| = 1.1 \(entries 11 to 14\)"):
            env.reset(options={"initial_state": x})
    with pytest.raises(ValueError, match="'gauss6' has no quaternions among its angles"):
        kernels.step(x, np.zeros(kernels.n_u), integrator="gauss6")
    with pytest.raises(SceneError, match="a spherical joint turns out of the plane"):
        load_scene("planar").replace(
            {"links.0.joint_type": "spherical"}, initial_state={"joint_angles": (), "joint_rates": ()}
        )
