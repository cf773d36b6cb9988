"""Integrators: order of convergence, exactness on the group, an independent code, invariants."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.integrators import INTEGRATORS


def rollout(kernels, x, controls, dt, integrator):
    """States along a sequence of inputs: the scalar kernel walks down rows that it has just written."""
    steps = len(controls)
    states = np.empty((steps + 1, kernels.n_x))
    states[0], h = x, np.array([dt])
    arrays = (states, np.ascontiguousarray(controls), h, states[1:])
    buffers = np.array([array.ctypes.data for array in arrays], dtype=np.int64)
    kernels.kernel("step", integrator=integrator, lanes=1).native.function(0, steps, buffers.ctypes.data)
    return states


def moving_start(kernels, seed=0, joint_rate=0.4, base_rate=0.15):
    rng = np.random.default_rng(seed)
    layout, x = kernels.layout.state, kernels.layout.initial_state.copy()
    x[layout.joint_rates] = rng.uniform(
        -joint_rate, joint_rate, layout.joint_rates.stop - layout.joint_rates.start
    )
    x[layout.base_velocity] = rng.uniform(
        -base_rate, base_rate, layout.base_velocity.stop - layout.base_velocity.start
    )
    return x


@pytest.mark.parametrize("scene", ["paper", "planar", "tip-load", "six-joint"])
@pytest.mark.parametrize("name", ["symplectic_euler", "rk4"])
def test_errors_fall_with_the_order_of_the_method(name, scene):
    kernels = compile_scene(scene)
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)
    end = 1.2
    reference = rollout(kernels, x, np.tile(u, (8192, 1)), end / 8192, "rk4")[-1]
    errors = []
    first = 96 if INTEGRATORS[name].order > 1 else 1024
    for steps in (first, 2 * first, 4 * first):
        final = rollout(kernels, x, np.tile(u, (steps, 1)), end / steps, name)[-1]
        errors.append(np.linalg.norm(kernels.difference(reference, final)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(INTEGRATORS[name].order, abs=0.15)


def test_rk4_agrees_with_dop853_on_the_vector_field_of_8_and_22():
    kernels = compile_scene("paper")
    layout = kernels.layout.state
    x = moving_start(kernels, seed=3)
    u = np.random.default_rng(2).uniform(-0.4, 0.4, kernels.n_u)

    def field(_, state):
        a = kernels.forward_dynamics(state, u)
        pose_rate = dq.derivative(tuple(state[layout.pose]), tuple(state[layout.base_velocity]))
        rates = state[layout.joint_rates]
        return np.concatenate([pose_rate, rates, u[-3:], a])

    exact = solve_ivp(field, (0.0, 3.0), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    final = rollout(kernels, x, np.tile(u, (200, 1)), 0.015, "rk4")[-1]
    np.testing.assert_allclose(final, exact, atol=2e-8)
    finer = rollout(kernels, x, np.tile(u, (3200, 1)), 0.015 / 16, "rk4")[-1]
    np.testing.assert_allclose(finer, exact, atol=2e-12)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_the_pose_stays_a_unit_dual_quaternion(name):
    kernels = compile_scene("tumbling")
    x = kernels.layout.initial_state
    states = rollout(kernels, x, np.zeros((20_000, kernels.n_u)), 0.015, name)
    real, dual = states[:, :4], states[:, 4:8]
    assert np.abs(np.linalg.norm(real, axis=1) - 1.0).max() < 1e-15
    assert (np.abs((real * dual).sum(axis=1)) / (1.0 + np.linalg.norm(dual, axis=1))).max() < 1e-15


def test_a_screw_motion_is_exact_whatever_the_step():
    """A single body spinning about a principal axis moves along a screw: no error (8)."""
    scene = load_scene("paper").replace(
        links=[], wrist=None, actuators={"base_force": {"limit": 1.0}}, initial_state={}, spread={}
    )
    kernels = compile_scene(scene)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.base_velocity] = [0.0, 0.0, 2.0, 0.0, 0.0, 0.3]
    for name in INTEGRATORS:
        final = rollout(kernels, x, np.zeros((2, kernels.n_u)), 0.7, name)[-1]
        angle, lift = 2.0 * 1.4, 0.3 * 1.4
        expected = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        expected += [-0.5 * lift * np.sin(angle / 2), 0, 0, 0.5 * lift * np.cos(angle / 2)]
        np.testing.assert_allclose(final[:8], expected, atol=1e-15)


@pytest.mark.parametrize("scene", ["paper", "six-joint", "planar"])
def test_time_reversal_returns_to_the_start(scene):
    kernels = compile_scene(scene)
    x = moving_start(kernels)
    still = np.zeros((400, kernels.n_u))
    end = rollout(kernels, x, still, 0.015, "rk4")[-1]
    back = rollout(kernels, end, still, -0.015, "rk4")[-1]
    assert np.linalg.norm(kernels.difference(x, back)) < 1e-8


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
        assert np.abs(np.linalg.norm(states[:, :4], axis=1) - 1.0).max() < 6e-13
        # The arm really moved: this is no test of a body at rest.
        assert np.ptp(states[:, kernels.layout.state.joint_angles], axis=0).min() > 1.0


def test_joint_torques_do_not_change_the_momentum():
    """Joint torques are internal: whatever they do, the system's momentum stays."""
    kernels = compile_scene("free-floating")
    x = moving_start(kernels)
    rng = np.random.default_rng(4)
    states = rollout(kernels, x, rng.uniform(-1.0, 1.0, (1000, kernels.n_u)), 0.015, "rk4")
    momentum = kernels.momentum(states)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-7)
