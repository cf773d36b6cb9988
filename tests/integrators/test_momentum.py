"""Methods that keep the momentum: exactness over many steps, impulses, stiff joints, long walks."""

import numpy as np
import pytest
from motions import free_body, moving_start, rollout, simulated

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.algebra.poses import to_rotation_and_position
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.integrators.momentum_coordinates import rotation_matrix, rotation_rate

METHODS = ("momentum_rk4", "rodas4", "gauss6")
SLOW = {"joint_rate": 0.2, "base_rate": 0.05}


def drift(kernels, states):
    momentum = kernels.momentum(states)
    return np.abs(momentum - momentum[0]).max()


def internal_torques(kernels, count, seed=4):
    """Random torques of the joints; base actuators are off."""
    u = np.zeros((count, kernels.n_u))
    where = kernels.layout.control.joint_torque
    u[:, where] = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, where.stop - where.start))
    return u


def slow_walk(kernels, u, steps, integrator, every=100):
    return kernels.simulate(moving_start(kernels, **SLOW), u, steps, integrator=integrator, every=every)


def center_of_mass(kernels, states):
    """Center of mass of base and links in inertial axes, from the poses of their frames."""
    tree = KinematicTree.from_scene(kernels.scene)
    bodies = tree.bodies
    poses = kernels.frame_poses(states)
    total = np.zeros((len(states), 3))
    for k, row in enumerate(poses):
        for body, pose in zip(bodies, row, strict=False):
            attitude, position = to_rotation_and_position(tuple(pose))
            offset = rotations.rotate(attitude, tuple(body.center_of_mass))
            total[k] += body.mass * (np.array(position) + np.array(offset))
    return total / sum(body.mass for body in bodies)


@pytest.mark.sampled
@pytest.mark.parametrize("scene", ["paper", "free-floating", "planar", "six-joint", "payload"])
@pytest.mark.parametrize("name", METHODS)
def test_internal_torques_keep_the_momentum_to_rounding(name, scene):
    kernels = compile_scene(scene)
    torques = internal_torques(kernels, 2000)
    assert drift(kernels, slow_walk(kernels, torques, 2000, name, 10)) < 1e-13  # 8e-14 with the payload
    # Explicit Runge-Kutta on the base's velocity is only accurate: this is no test of an arm at rest.
    by_rk4 = drift(kernels, slow_walk(kernels, torques, 2000, "rk4", 10))
    assert by_rk4 > 1e-10
    assert by_rk4 < 1e-5 or scene == "six-joint"  # its joints reach 20 rad/s


@pytest.mark.parametrize("steps", [100_000, pytest.param(10_000_000, marks=pytest.mark.endurance)])
@pytest.mark.parametrize("name", METHODS)
def test_momentum_over_many_steps(name, steps):
    kernels = compile_scene("paper")
    states = slow_walk(kernels, np.zeros(kernels.n_u), steps, name, steps // 1000)
    assert drift(kernels, states) < 2e-14
    assert np.ptp(states[:, kernels.layout.state.joint_angles], axis=0).min() > 1.0


@pytest.mark.endurance
@pytest.mark.parametrize("name", METHODS)
def test_a_million_steps_foretell_ten_million(name):
    """A bias of the steps moves the mean momentum from one half of them to the other, above all rounding.

    Ten times as many steps, and from end to end, it would move twenty times as far.
    """
    kernels = compile_scene("paper")
    states = slow_walk(kernels, np.zeros(kernels.n_u), 1_000_000, name, 1000)
    assert drift(kernels, states) < 2e-14
    first, second = (half.mean(axis=0) for half in np.split(kernels.momentum(states[1:]), 2))
    assert 20.0 * np.abs(second - first).max() < 2e-14


def test_single_steps_let_the_momentum_wander_by_rounding_only():
    """Without the momentum handed on, rounding errors add up like a random walk: no bias, whatever the step.

    1e5 roundings of a momentum of 5 make 5e-16 sqrt(1e5) = 2e-13; several are made in each step.
    """
    kernels = compile_scene("paper")
    steps = 100_000
    still = np.zeros((steps, kernels.n_u))
    states = rollout(kernels, moving_start(kernels, **SLOW), still, 0.015, "momentum_rk4")
    assert drift(kernels, states) < 3e-12


@pytest.mark.parametrize("name", METHODS)
def test_the_center_of_mass_moves_on_a_straight_line(name):
    kernels = compile_scene("free-floating")
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.2)
    steps, dt = 400, 0.1
    states = kernels.simulate(x, np.zeros(kernels.n_u), steps, dt=dt, integrator=name, every=20)
    tree = KinematicTree.from_scene(kernels.scene)
    mass = tree.base.mass + sum(link.body.mass for link in tree.links)
    times = np.arange(len(states)) * 20 * dt
    path = center_of_mass(kernels, states)
    expected = path[0] + times[:, None] * kernels.momentum(x)[:3] / mass
    np.testing.assert_allclose(path, expected, rtol=0, atol=5e-14)


@pytest.mark.parametrize("name", METHODS)
def test_external_wrench_changes_the_momentum_by_its_impulse(name):
    """Force and torque along the axis of a spinning body keep their inertial direction."""
    kernels = free_body("base_force", "base_torque")
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.base_velocity] = [0.0, 0.0, 0.7, 0.1, -0.2, 0.3]
    u = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.2])
    end = kernels.simulate(x, u, 1000, dt=0.01, integrator=name, every=1000)[-1]
    gained = kernels.momentum(end) - kernels.momentum(x)
    np.testing.assert_allclose(gained, [0.0, 0.0, 5.0, 0.0, 0.0, 2.0], rtol=0, atol=1e-11)


def test_momentum_far_from_the_origin_is_as_good():
    """Momentum is kept about the center of mass: 7000 km of distance to the origin cost nothing."""
    kernels = compile_scene("free-floating")
    x = moving_start(kernels, **SLOW)
    far = (1.0, 0.0, 0.0, 0.0, 0.0, 3.5e6, -1e6, 2e6)
    x[kernels.layout.state.pose] = dq.multiply(far, tuple(x[kernels.layout.state.pose]))
    states = kernels.simulate(x, np.zeros(kernels.n_u), 10_000, integrator="momentum_rk4", every=100)
    assert drift(kernels, states) < 2e-14


def test_energy_drifts_no_more_than_with_velocities_as_states():
    kernels = compile_scene("paper")
    for seed in range(3):
        x, still = moving_start(kernels, seed, **SLOW), np.zeros(kernels.n_u)
        changes = {}
        for name in ("rk4", "momentum_rk4"):
            energy = kernels.energy(kernels.simulate(x, still, 50_000, integrator=name, every=50))
            changes[name] = np.abs(energy / energy[0] - 1.0).max()
        assert changes["momentum_rk4"] < 2.0 * changes["rk4"] < 1e-8


@pytest.mark.parametrize("name", METHODS)
def test_single_precision_follows_double_precision(name):
    single, double = compile_scene(simulated("paper", precision="float32")), compile_scene("paper")
    x, u = moving_start(double, **SLOW), np.full(double.n_u, 0.1)
    states = single.simulate(x, u, 1000, integrator=name, every=100)
    assert states.dtype == np.float32
    np.testing.assert_allclose(
        states, double.simulate(x, u, 1000, integrator=name, every=100), rtol=0, atol=1e-4
    )
    states = single.simulate(x, np.zeros(double.n_u), 10_000, integrator=name, every=100)
    assert drift(single, states) < 1e-5


@pytest.mark.sampled
@pytest.mark.parametrize("name", METHODS)
def test_masses_drawn_for_each_episode_reach_the_method(name):
    """With masses as parameters of the machine code, the method agrees with RK4 up to their errors."""
    scene, states = load_scene("random-masses"), {}
    for method in ("rk4", name):
        env = DQSpaceArmEnv(scene.replace(simulation={"dt": 0.015, "steps": 50, "integrator": method}))
        env.reset(seed=3)
        rng = np.random.default_rng(0)
        for _ in range(50):
            env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        states[method] = env.state.copy()
    np.testing.assert_allclose(states[name], states["rk4"], rtol=0, atol=1e-10)
    assert np.abs(states[name] - states["rk4"]).max() > 0.0


def test_power_series_of_rotations_agree_with_closed_forms():
    rng = np.random.default_rng(0)
    for length, tolerance in ((0.2, 1e-15), (1.0, 3e-8)):
        for _ in range(20):
            vector, omega = rng.normal(size=3), rng.normal(size=3)
            vector *= length / np.linalg.norm(vector)
            exact = np.array(rotations.to_matrix(rotations.exponential(tuple(vector))))
            computed = np.array(rotation_matrix(tuple(vector)), dtype=float)
            np.testing.assert_allclose(computed, exact, rtol=0, atol=2.0 * tolerance)
            rate = np.array(rotation_rate(tuple(vector), tuple(omega)), dtype=float)
            h = 1e-6  # the rotation exp(vector + h rate) is exp(vector) exp(h omega)
            ahead = np.array(rotations.to_matrix(rotations.exponential(tuple(vector + h * rate))))
            behind = np.array(rotations.to_matrix(rotations.exponential(tuple(vector - h * rate))))
            turned = exact.T @ (ahead - behind) / (2.0 * h)
            np.testing.assert_allclose([turned[2, 1], turned[0, 2], turned[1, 0]], omega, rtol=0, atol=1e-7)


# Walks of many steps.


def test_a_walk_gives_what_single_steps_give():
    kernels = compile_scene("paper")
    x, u = moving_start(kernels, **SLOW), np.random.default_rng(0).normal(size=(600, kernels.n_u))
    for name in ("rk4", *METHODS):
        states = kernels.simulate(x, u, 600, integrator=name)
        kept = kernels.simulate(x, u, 600, integrator=name, every=7)
        np.testing.assert_array_equal(kept, states[::7])
        expected = x
        for state, control in zip(states[1:], u, strict=True):
            expected = kernels.step(expected, control, integrator=name)
            np.testing.assert_allclose(state, expected, rtol=1e-13, atol=1e-14)
    constant = kernels.simulate(x, u[0], 300)
    np.testing.assert_array_equal(constant, kernels.simulate(x, np.tile(u[0], (300, 1)), 300))


def test_a_walk_names_what_does_not_fit():
    kernels = compile_scene("paper")
    x, u = kernels.layout.initial_state, np.zeros(kernels.n_u)
    with pytest.raises(ValueError, match="steps: 0"):
        kernels.simulate(x, u, 0)
    with pytest.raises(ValueError, match="should be"):
        kernels.simulate(x[None], u, 10)
    with pytest.raises(ValueError, match="u: shape"):
        kernels.simulate(x, np.zeros((9, kernels.n_u)), 10)
