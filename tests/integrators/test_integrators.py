"""Integrators: order of convergence, exactness on the group, an independent code, invariants."""

import numpy as np
import pytest
from motions import convergence, exact_motion, free_body, moving_start, rollout

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.scene import INTEGRATORS


@pytest.mark.parametrize("scene", ["paper", "planar", "tip-load", "six-joint", "reaction-wheels"])
@pytest.mark.parametrize("name", ["symplectic_euler", "rk4", "momentum_rk4"])
def test_errors_fall_with_the_order_of_the_method(name, scene):
    order = INTEGRATORS[name].order
    first = 96 if order > 1 else 1024
    errors = convergence(compile_scene(scene), name, (first, 2 * first, 4 * first))
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(
    ("name", "refinement", "tolerance"),
    [
        ("rk4", 1, 2e-8),
        ("rk4", 16, 2e-12),
        ("momentum_rk4", 1, 2e-8),
        ("momentum_rk4", 16, 2e-12),
        ("rodas4", 16, 2e-12),
        ("gauss6", 1, 2e-12),
    ],
)
def test_agrees_with_dop853_on_the_vector_field_of_8_and_22(name, refinement, tolerance):
    kernels = compile_scene("paper")
    x, steps = moving_start(kernels, seed=3), 200 * refinement
    u = np.random.default_rng(2).uniform(-0.4, 0.4, kernels.n_u)
    final = rollout(kernels, x, np.tile(u, (steps, 1)), 3.0 / steps, name)[-1]
    np.testing.assert_allclose(final, exact_motion(kernels, x, u, 3.0), rtol=0, atol=tolerance)


@pytest.mark.sampled
@pytest.mark.parametrize("name", INTEGRATORS)
def test_the_pose_stays_a_unit_dual_quaternion(name):
    kernels = compile_scene("tumbling")
    x = kernels.layout.initial_state
    states = rollout(kernels, x, np.zeros((20_000, kernels.n_u)), 0.015, name)
    real, dual = states[:, :4], states[:, 4:8]
    assert np.abs(np.linalg.norm(real, axis=1) - 1.0).max() < 1e-15
    assert (np.abs((real * dual).sum(axis=1)) / (1.0 + np.linalg.norm(dual, axis=1))).max() < 1e-15


@pytest.mark.slow
def test_a_screw_motion_is_exact_whatever_the_step():
    """A single body spinning about a principal axis moves along a screw: no error (8).

    Collocation of the quaternion is the exception: it turns about the axis by an angle of its order.
    """
    kernels = free_body()
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.base_velocity] = [0.0, 0.0, 2.0, 0.0, 0.0, 0.3]
    for name in INTEGRATORS:
        final = rollout(kernels, x, np.zeros((2, kernels.n_u)), 0.7, name)[-1]
        angle, lift = 2.0 * 1.4, 0.3 * 1.4
        expected = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        expected += [-0.5 * lift * np.sin(angle / 2), 0, 0, 0.5 * lift * np.cos(angle / 2)]
        np.testing.assert_allclose(final[:8], expected, rtol=0, atol=2e-5 if name == "gauss6" else 5e-15)


def test_free_motion_of_1500_s_keeps_momentum_and_energy():
    """RK4 at 15 ms; the starts are four times as fast as the scene's own random ones.

    The drift grows with the fifth power of the rates; the bounds are what minimal coordinates reached on a
    robot of this kind and size.
    """
    kernels = compile_scene("paper")
    for seed in range(4):
        x = moving_start(kernels, seed, joint_rate=0.2, base_rate=0.05)
        states = rollout(kernels, x, np.zeros((100_000, kernels.n_u)), 0.015, "rk4")
        momentum, energy = kernels.momentum(states), kernels.energy(states)
        drift = np.abs(momentum - momentum[0])
        assert np.abs(energy / energy[0] - 1.0).max() < 2e-9
        assert drift[:, :3].max() < 6e-9
        assert drift[:, 3:].max() < 1e-8
        assert np.abs(np.linalg.norm(states[:, :4], axis=1) - 1.0).max() < 2e-15
        # The arm really moved: this is no test of a body at rest.
        assert np.ptp(states[:, kernels.layout.state.joint_angles], axis=0).min() > 1.0


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["momentum_rk4", "rodas4", "gauss6"])
def test_an_environment_steps_by_the_method_that_its_scene_names(name):
    scene = load_scene("planar").replace(simulation={"dt": 0.015, "steps": 20, "integrator": name})
    kernels, env = compile_scene(scene), DQSpaceArmEnv(scene)
    env.reset(seed=0)
    x, rng = env.state.copy(), np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1.0, 1.0, kernels.n_u)
        _, _, terminated, _, _ = env.step(action)
        x = kernels.step(x, kernels.layout.to_control(action))
        np.testing.assert_allclose(env.state, x, rtol=1e-13, atol=1e-14)
    assert terminated


@pytest.mark.parametrize("name", [name for name, entry in INTEGRATORS.items() if entry.curvature != name])
def test_methods_without_second_derivatives_say_so(name):
    with pytest.raises(ValueError, match=f"integrator: '{name}' has no second derivatives"):
        compile_scene("paper").kernel("lagrangian_hessian", integrator=name)
