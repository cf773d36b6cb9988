"""Methods that keep the momentum: exactness over many steps, impulses, stiff joints, long walks."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.algebra.poses import to_rotation_and_position
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.integrators import INTEGRATORS, rosenbrock_w
from dq_space_arm_env.integrators.momentum_coordinates import rotation_matrix, rotation_rate
from dq_space_arm_env.kernels.paper_programs import PaperPrograms

METHODS = ("momentum_rk4", "momentum_rosenbrock")


def moving_start(kernels, seed=0, joint_rate=0.2, base_rate=0.05):
    rng = np.random.default_rng(seed)
    layout, x = kernels.layout.state, kernels.layout.initial_state.copy()
    for part, rate in ((layout.joint_rates, joint_rate), (layout.base_velocity, base_rate)):
        x[part] = rng.uniform(-rate, rate, part.stop - part.start)
    return x


def drift(kernels, states):
    momentum = kernels.momentum(states)
    return np.abs(momentum - momentum[0]).max()


def internal_torques(kernels, count, seed=4):
    """Random torques of the joints; base actuators are off."""
    u = np.zeros((count, kernels.n_u))
    where = kernels.layout.control.joint_torque
    u[:, where] = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, where.stop - where.start))
    return u


def with_springs(stiffness, damping=0.0, joints=(0, 1, 2)):
    """Scene `paper` with springs at rest at the start."""
    scene = load_scene("paper")
    angles = scene.initial_state.joint_angles
    links = [
        link.model_copy(update={"stiffness": stiffness, "damping": damping, "rest_angle": float(angle)})
        if index in joints
        else link
        for index, (link, angle) in enumerate(zip(scene.links, angles, strict=True))
    ]
    return compile_scene(scene.replace(links=links))


def center_of_mass(kernels, states):
    """Center of mass of base and links in inertial axes, from the poses of their frames."""
    chain = Chain.from_scene(kernels.scene)
    bodies = [chain.base, *(link.body for link in chain.links)]
    poses = kernels.frame_poses(states)
    total = np.zeros((len(states), 3))
    for k, row in enumerate(poses):
        for body, pose in zip(bodies, row, strict=False):
            attitude, position = to_rotation_and_position(tuple(pose))
            offset = rotations.rotate(attitude, tuple(body.center_of_mass))
            total[k] += body.mass * (np.array(position) + np.array(offset))
    return total / sum(body.mass for body in bodies)


@pytest.mark.parametrize("scene", ["paper", "free-floating", "planar", "six-joint", "payload"])
@pytest.mark.parametrize("name", METHODS)
def test_internal_torques_keep_the_momentum_to_rounding(name, scene):
    kernels = compile_scene(scene)
    states = kernels.simulate(
        moving_start(kernels), internal_torques(kernels, 2000), 2000, integrator=name, every=10
    )
    assert drift(kernels, states) < 1e-13
    # Explicit Runge-Kutta on the base's velocity is not exact: this is no test of an arm at rest.
    states = kernels.simulate(
        moving_start(kernels), internal_torques(kernels, 2000), 2000, integrator="rk4", every=10
    )
    assert drift(kernels, states) > 1e-10


@pytest.mark.parametrize("name", METHODS)
def test_momentum_over_1e5_steps(name):
    kernels = compile_scene("paper")
    states = kernels.simulate(
        moving_start(kernels), np.zeros(kernels.n_u), 100_000, integrator=name, every=100
    )
    assert drift(kernels, states) < 2e-14
    assert np.ptp(states[:, kernels.layout.state.joint_angles], axis=0).min() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_momentum_over_1e7_steps(name):
    kernels = compile_scene("paper")
    states = kernels.simulate(
        moving_start(kernels), np.zeros(kernels.n_u), 10_000_000, integrator=name, every=10_000
    )
    assert drift(kernels, states) < 2e-14


def test_single_steps_let_the_momentum_wander_by_rounding_only():
    """Without the momentum handed on, rounding errors add up like a random walk: no bias, whatever the step.

    1e5 roundings of a momentum of 5 make 5e-16 sqrt(1e5) = 2e-13; several are made in each step.
    """
    kernels = compile_scene("paper")
    steps = 100_000
    states = np.empty((steps + 1, kernels.n_x))
    states[0] = moving_start(kernels)
    arrays = (states, np.zeros((steps, kernels.n_u)), np.array([0.015]), states[1:])
    buffers = np.array([array.ctypes.data for array in arrays], dtype=np.int64)
    kernels.kernel("step", integrator="momentum_rk4", lanes=1).native.function(0, steps, buffers.ctypes.data)
    assert drift(kernels, states) < 3e-12


@pytest.mark.parametrize("name", METHODS)
def test_the_center_of_mass_moves_on_a_straight_line(name):
    kernels = compile_scene("free-floating")
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.2)
    steps, dt = 400, 0.1
    states = kernels.simulate(x, np.zeros(kernels.n_u), steps, dt=dt, integrator=name, every=20)
    chain = Chain.from_scene(kernels.scene)
    mass = chain.base.mass + sum(link.body.mass for link in chain.links)
    times = np.arange(len(states)) * 20 * dt
    path = center_of_mass(kernels, states)
    expected = path[0] + times[:, None] * kernels.momentum(x)[:3] / mass
    np.testing.assert_allclose(path, expected, atol=2e-13)


@pytest.mark.parametrize("name", METHODS)
def test_external_wrench_changes_the_momentum_by_its_impulse(name):
    """Force and torque along the axis of a spinning body keep their inertial direction."""
    limits = {"base_force": {"limit": 1.0}, "base_torque": {"limit": 1.0}}
    scene = load_scene("paper").replace(links=[], wrist=None, actuators=limits, initial_state={}, spread={})
    kernels = compile_scene(scene)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.base_velocity] = [0.0, 0.0, 0.7, 0.1, -0.2, 0.3]
    u = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.2])
    end = kernels.simulate(x, u, 1000, dt=0.01, integrator=name, every=1000)[-1]
    gained = kernels.momentum(end) - kernels.momentum(x)
    np.testing.assert_allclose(gained, [0.0, 0.0, 5.0, 0.0, 0.0, 2.0], atol=2e-13)


def test_momentum_far_from_the_origin_is_as_good():
    """Momentum is kept about the center of mass: 7000 km of distance to the origin cost nothing."""
    kernels = compile_scene("free-floating")
    x = moving_start(kernels)
    far = (1.0, 0.0, 0.0, 0.0, 0.0, 3.5e6, -1e6, 2e6)
    x[kernels.layout.state.pose] = dq.multiply(far, tuple(x[kernels.layout.state.pose]))
    states = kernels.simulate(x, np.zeros(kernels.n_u), 10_000, integrator="momentum_rk4", every=100)
    assert drift(kernels, states) < 2e-14


def test_energy_drifts_no_more_than_with_velocities_as_states():
    kernels = compile_scene("paper")
    for seed in range(3):
        x, still = moving_start(kernels, seed), np.zeros(kernels.n_u)
        changes = {}
        for name in ("rk4", "momentum_rk4"):
            energy = kernels.energy(kernels.simulate(x, still, 50_000, integrator=name, every=50))
            changes[name] = np.abs(energy / energy[0] - 1.0).max()
        assert changes["momentum_rk4"] < 2.0 * changes["rk4"] < 1e-8


def test_agrees_with_dop853_on_the_vector_field_of_8_and_22():
    kernels = compile_scene("paper")
    layout, x = kernels.layout.state, moving_start(kernels, 3, joint_rate=0.4, base_rate=0.15)
    u = np.random.default_rng(2).uniform(-0.4, 0.4, kernels.n_u)

    def field(_, state):
        pose_rate = dq.derivative(tuple(state[layout.pose]), tuple(state[layout.base_velocity]))
        accelerations = kernels.forward_dynamics(state, u)
        return np.concatenate([pose_rate, state[layout.joint_rates], u[-3:], accelerations])

    exact = solve_ivp(field, (0.0, 3.0), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    for refinement, tolerance in ((1, 2e-8), (16, 2e-12)):
        final = kernels.simulate(x, u, 200 * refinement, dt=0.015 / refinement, integrator="momentum_rk4")[-1]
        np.testing.assert_allclose(final, exact, atol=tolerance)
    final = kernels.simulate(x, u, 3200, dt=0.015 / 16, integrator="momentum_rosenbrock")[-1]
    np.testing.assert_allclose(final, exact, atol=1e-9)


@pytest.mark.parametrize("scene", ["paper", "planar", "tip-load", "six-joint", "reaction-wheels"])
@pytest.mark.parametrize("name", METHODS)
def test_errors_fall_with_the_order_of_the_method(name, scene):
    kernels = compile_scene(scene)
    x = moving_start(kernels, joint_rate=0.8, base_rate=0.4)
    u = np.random.default_rng(1).uniform(-0.3, 0.3, kernels.n_u)
    end, steps = 1.2, (96, 192, 384)
    reference = kernels.simulate(x, u, 8192, dt=end / 8192, integrator="rk4")[-1]
    errors = []
    for count in steps:
        final = kernels.simulate(x, u, count, dt=end / count, integrator=name)[-1]
        errors.append(np.linalg.norm(kernels.difference(reference, final)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(INTEGRATORS[name].order, abs=0.15)


@pytest.mark.parametrize("scene", ["paper", "six-joint", "planar"])
def test_time_reversal_returns_to_the_start(scene):
    kernels = compile_scene(scene)
    x = moving_start(kernels, joint_rate=0.4, base_rate=0.15)
    still = np.zeros(kernels.n_u)
    end = kernels.simulate(x, still, 400, integrator="momentum_rk4")[-1]
    back = kernels.simulate(end, still, 400, dt=-kernels.scene.simulation.dt, integrator="momentum_rk4")[-1]
    assert np.linalg.norm(kernels.difference(x, back)) < 1e-8


@pytest.mark.parametrize("name", METHODS)
def test_single_precision_follows_double_precision(name):
    scene = load_scene("paper")
    single = compile_scene(scene.replace(simulation={**dict(scene.simulation), "precision": "float32"}))
    double = compile_scene(scene)
    x, u = moving_start(double), np.full(double.n_u, 0.1)
    states = single.simulate(x, u, 1000, integrator=name, every=100)
    assert states.dtype == np.float32
    np.testing.assert_allclose(states, double.simulate(x, u, 1000, integrator=name, every=100), atol=5e-4)
    states = single.simulate(x, np.zeros(double.n_u), 10_000, integrator=name, every=100)
    assert drift(single, states) < 1e-5


@pytest.mark.parametrize("name", METHODS)
def test_an_environment_takes_the_method_by_the_name_in_its_scene(name):
    scene = load_scene("paper")
    scene = scene.replace(simulation={"dt": 0.015, "steps": 20, "integrator": name})
    kernels = compile_scene(scene)
    env = DQSpaceArmEnv(scene)
    env.reset(seed=0)
    x, rng = env.state.copy(), np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1.0, 1.0, kernels.n_u)
        _, _, terminated, _, _ = env.step(action)
        x = kernels.step(x, action * kernels.layout.control_limit)
        np.testing.assert_allclose(env.state, x, rtol=1e-13, atol=1e-14)
    assert terminated


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
    np.testing.assert_allclose(states[name], states["rk4"], atol=1e-6)
    assert np.abs(states[name] - states["rk4"]).max() > 0.0


# Stiff joints.


def test_order_conditions_of_the_w_method():
    """Order 3 with any matrix: Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7."""
    alpha, gamma = np.zeros((4, 4)), rosenbrock_w.GAMMA * np.eye(4)
    for i, (a, g) in enumerate(zip(rosenbrock_w.ALPHA, rosenbrock_w.GAMMAS, strict=True)):
        alpha[i, : len(a)], gamma[i, : len(g)] = a, g
    b, ones = np.array(rosenbrock_w.WEIGHTS), np.ones(4)
    sums, offsets = alpha @ ones, gamma @ ones
    conditions = [
        (b.sum(), 1.0),
        (b @ sums, 1 / 2),
        (b @ offsets, 0.0),
        (b @ sums**2, 1 / 3),
        (b @ alpha @ sums, 1 / 6),
        (b @ alpha @ offsets, 0.0),
        (b @ gamma @ sums, 0.0),
        (b @ gamma @ offsets, 0.0),
    ]
    np.testing.assert_allclose(*np.array(conditions).T, atol=1e-14)
    # Stiffly accurate, hence L-stable where it is A-stable: the last stage is the step.
    np.testing.assert_allclose(b, alpha[3] + gamma[3], atol=1e-15)
    beta = alpha + gamma
    for frequency in np.logspace(-3, 8, 500):
        z = 1j * frequency
        growth = 1.0 + z * (b @ np.linalg.solve(np.eye(4) - z * beta, ones))
        assert abs(growth) < 1.0 + 1e-12
    assert abs(growth) < 1e-6


@pytest.mark.parametrize("stiffness", [1e4, 1e6, 1e8])
def test_stiff_joints_are_stable_at_15_ms(stiffness):
    """Up to dt times frequency = 150: momentum exact, energy bounded, the joints stay where they are."""
    kernels = with_springs(stiffness)
    x, still = moving_start(kernels, joint_rate=0.8, base_rate=0.2), np.zeros(kernels.n_u)
    states = kernels.simulate(x, still, 20_000, integrator="momentum_rosenbrock", every=10)
    energy = kernels.energy(states)
    assert drift(kernels, states) < 1e-13
    assert energy.max() <= energy[0] * (1.0 + 1e-12)
    assert np.diff(energy[1000:]).max() < 1e-6 * energy[0]
    angles = kernels.layout.state.joint_angles
    assert np.abs(states[1000:, angles] - x[angles]).max() < 60.0 / stiffness
    explicit = kernels.simulate(x, still, 1000, integrator="momentum_rk4", every=10)
    assert np.isfinite(explicit).all() == (stiffness < 1e5)


def test_a_stiff_joint_that_does_not_vibrate_costs_no_accuracy():
    """One joint of 1e6 N m/rad, at rest at the start, between others that move."""
    kernels = with_springs(1e6, joints=(1,))
    x, still = moving_start(kernels, joint_rate=0.4, base_rate=0.1), np.zeros(kernels.n_u)
    x[kernels.layout.state.joint_rates][1] = 0.0
    reference = kernels.simulate(x, still, 200 * 200, dt=0.015 / 200, integrator="momentum_rk4")[-1]
    end = kernels.simulate(x, still, 200, dt=0.015, integrator="momentum_rosenbrock")[-1]
    tip, exact = kernels.tip_pose(end), kernels.tip_pose(reference)
    assert np.abs(tip - exact).max() < 1e-5


def test_overdamped_joints_are_stable():
    kernels = with_springs(0.0, damping=1e6)
    x, still = moving_start(kernels, joint_rate=0.8, base_rate=0.2), np.zeros(kernels.n_u)
    states = kernels.simulate(x, still, 2000, integrator="momentum_rosenbrock")
    assert np.abs(states[10:, kernels.layout.state.joint_rates]).max() < 1e-4
    assert drift(kernels, states) < 1e-13
    assert np.isnan(kernels.simulate(x, still, 2000, integrator="momentum_rk4")[-1]).any()


# What the methods are made of, and what they refuse.


def test_power_series_of_rotations_agree_with_closed_forms():
    rng = np.random.default_rng(0)
    for length, tolerance in ((0.2, 1e-15), (1.0, 3e-8)):
        for _ in range(20):
            vector, omega = rng.normal(size=3), rng.normal(size=3)
            vector *= length / np.linalg.norm(vector)
            exact = np.array(rotations.to_matrix(rotations.exponential(tuple(vector))))
            computed = np.array(rotation_matrix(tuple(vector)), dtype=float)
            np.testing.assert_allclose(computed, exact, atol=2.0 * tolerance)
            rate = np.array(rotation_rate(tuple(vector), tuple(omega)), dtype=float)
            h = 1e-6  # the rotation exp(vector + h rate) is exp(vector) exp(h omega)
            ahead = np.array(rotations.to_matrix(rotations.exponential(tuple(vector + h * rate))))
            behind = np.array(rotations.to_matrix(rotations.exponential(tuple(vector - h * rate))))
            turned = exact.T @ (ahead - behind) / (2.0 * h)
            np.testing.assert_allclose([turned[2, 1], turned[0, 2], turned[1, 0]], omega, atol=1e-7)


def test_equations_without_a_free_base_are_refused():
    field = PaperPrograms(load_scene("paper")).field
    for name in METHODS:
        with pytest.raises(TypeError, match="do not tell the momentum"):
            INTEGRATORS[name].append_step(Program("step", [], []), field)
    with pytest.raises(TypeError, match="which part of them is stiff"):
        rosenbrock_w.RosenbrockW().append_step(Program("step", [], []), field)


@pytest.mark.parametrize("name", METHODS)
def test_second_derivatives_are_refused(name):
    assert not INTEGRATORS[name].has_curvature
    with pytest.raises(ValueError, match=f"'{name}' has no second derivatives"):
        compile_scene("paper").kernel("lagrangian_hessian", integrator=name)


# Walks of many steps.


def test_a_walk_gives_what_single_steps_give():
    kernels = compile_scene("paper")
    x, u = moving_start(kernels), np.random.default_rng(0).normal(size=(600, kernels.n_u))
    for name in ("rk4", *METHODS):
        states = kernels.simulate(x, u, 600, integrator=name)
        kept = kernels.simulate(x, u, 600, integrator=name, every=7)
        np.testing.assert_array_equal(kept, states[::7])
        expected = x
        for state, control in zip(states[1:], u, strict=True):
            expected = kernels.step(expected, control, integrator=name)
            np.testing.assert_allclose(state, expected, rtol=1e-11, atol=1e-12)
    constant = kernels.simulate(x, u[0], 300)
    np.testing.assert_array_equal(constant, kernels.simulate(x, np.tile(u[0], (300, 1)), 300))


def test_a_walk_names_what_does_not_fit():
    kernels = compile_scene("paper")
    x, u = kernels.layout.initial_state, np.zeros(kernels.n_u)
    with pytest.raises(ValueError, match="steps: 0"):
        kernels.simulate(x, u, 0)
    with pytest.raises(ValueError, match="every: 0"):
        kernels.simulate(x, u, 10, every=0)
    with pytest.raises(ValueError, match="should be"):
        kernels.simulate(x[None], u, 10)
    with pytest.raises(ValueError, match="u: shape"):
        kernels.simulate(x, np.zeros((9, kernels.n_u)), 10)
    with pytest.raises(ValueError, match="is unknown"):
        kernels.simulate(x, u, 10, integrator="momentum")
