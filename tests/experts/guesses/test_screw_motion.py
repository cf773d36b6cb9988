"""The guess by screw motion: maps of the free-floating arm, the tip's path, the arm that follows it."""

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.scene.start import draw_initial_state
from experts.guesses.free_floating import FreeFloatingArm
from experts.guesses.screw_motion import screw_motion, tip_path
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.robots import robots

TILTED = ["paper", "planar", "no-wrist", "six-joint", "tip-load"]  # one of each kind of robot


def random_start(problem, seed):
    return draw_initial_state(problem.scene, np.random.default_rng(seed))


def moving_states(problem, count, seed=0):
    """Random starts with velocities of order one."""
    rng = np.random.default_rng(seed)
    states = np.array([draw_initial_state(problem.scene, rng) for _ in range(count)])
    entries = problem.kernels.layout.state
    for part in (entries.base_velocity, entries.joint_rates):
        states[:, part] = rng.normal(size=states[:, part].shape)
    return states


def relative_twists(first, second):
    """Twists from poses (B, 8) to others, shape (B, 6)."""
    return np.stack(screw.logarithm(dq.multiply(dq.conjugate(first.T), second.T)), axis=-1)


def tip_path_of(problem, start, share):
    horizon = problem.horizon * problem.time_step
    times = np.linspace(0.0, horizon, problem.horizon + 1)
    return tip_path(problem, start, share * horizon, times)


# The maps of the free-floating arm -------------------------------------------------------------------------


@pytest.mark.parametrize("scene", TILTED)
def test_the_jacobian_is_the_derivative_of_the_tip_pose(scene):
    """Against a central difference of (27) along the motion of the configuration."""
    problem = ArmProblem(scene)
    kernels, layout = problem.kernels, problem.kernels.layout
    states = moving_states(problem, 4)
    wrist = np.random.default_rng(1).normal(size=(4, 3 if layout.has_wrist else 0))
    jacobian = FreeFloatingArm(kernels).tip_jacobian(states, kernels.frame_poses(states))
    parts = (states[:, layout.state.base_velocity], states[:, layout.state.joint_rates], wrist)
    found = sum((a @ b[:, :, None])[:, :, 0] for a, b in zip(jacobian, parts, strict=True))
    change = np.zeros((4, layout.n_t))
    change[:, : layout.tangent.base_velocity.start] = 1e-5 * np.concatenate(parts, axis=1)
    before, after = (kernels.tip_pose(kernels.retract(states, sign * change)) for sign in (-1.0, 1.0))
    np.testing.assert_allclose(found, relative_twists(before, after) / 2e-5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("scene", TILTED)
def test_the_momentum_map_gives_the_momentum(scene):
    problem = ArmProblem(scene)
    arm, entries = FreeFloatingArm(problem.kernels), problem.kernels.layout.state
    states = moving_states(problem, 4)
    system = arm.momentum_map(states)
    momentum = system.base @ states[:, entries.base_velocity, None]
    momentum += system.joints @ states[:, entries.joint_rates, None]
    expected = problem.kernels.momentum(states)
    np.testing.assert_allclose(momentum[:, :, 0], expected[:, arm.momentum_entries], rtol=1e-12, atol=1e-12)
    assert np.abs(expected).max() > 10.0


def test_the_load_is_the_wrench_about_the_center_of_mass():
    """The force in inertial axes, and the rate at which the momentum of the idle robot changes."""
    problem = ArmProblem("tip-load")
    kernels = problem.kernels
    arm, states = FreeFloatingArm(kernels), moving_states(problem, 4)
    load = arm.tip_load(states, arm.momentum_map(states))
    rotation = np.array(poses.to_matrix(kernels.tip_pose(states).T)[0])
    np.testing.assert_allclose(
        load[:, :3], np.einsum("ijb,j->bi", rotation, problem.scene.tip_wrench.force), rtol=0, atol=1e-12
    )
    still, dt = np.zeros((4, kernels.n_u)), 1e-4
    later, earlier = (kernels.step(states, still, dt=sign * dt) for sign in (1.0, -1.0))
    rate = (kernels.momentum(later) - kernels.momentum(earlier)) / (2.0 * dt)
    np.testing.assert_allclose(load, rate, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scene", TILTED)
def test_controls_give_the_accelerations_that_they_are_asked_for(scene):
    problem = ArmProblem(scene)
    kernels, wrist = problem.kernels, problem.kernels.layout.control.wrist_rate
    states = moving_states(problem, 4)
    controls = np.random.default_rng(1).normal(size=(4, kernels.n_u))
    controls[:, wrist] = 0.0
    found = FreeFloatingArm(kernels).controls(states, kernels.forward_dynamics(states, controls))
    np.testing.assert_allclose(found, controls, rtol=0, atol=1e-8)


def test_missing_actuators_leave_the_nearest_accelerations():
    """No force on the joints can lift the center of mass of a free-floating robot."""
    problem = ArmProblem("free-floating")
    kernels, states = problem.kernels, moving_states(ArmProblem("free-floating"), 4)
    wanted = np.random.default_rng(1).normal(size=(4, 9))
    arm = FreeFloatingArm(kernels)
    found = arm.controls(states, wanted)
    left = wanted - kernels.forward_dynamics(states, found)
    for i in range(problem.n_controls):
        other = found.copy()
        other[:, i] += 0.1
        worse = wanted - kernels.forward_dynamics(states, other)
        assert np.all(np.linalg.norm(worse, axis=1) >= np.linalg.norm(left, axis=1) - 1e-12)


# The path of the tip ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["paper", "planar"])
def test_from_rest_the_path_is_one_screw_motion(scene):
    """All of the path lies on the shortest screw motion to the target, and ends there."""
    problem = ArmProblem(scene)
    start = problem.initial_state
    path = tip_path_of(problem, start, 0.5)
    first, target = problem.kernels.tip_pose(start), problem.scene.target.pose.dual_quaternion
    way = relative_twists(first[None], np.array([target]))[0]
    gone = relative_twists(np.broadcast_to(first, path.poses.shape), path.poses)
    share = gone @ way / (way @ way)
    np.testing.assert_allclose(gone, share[:, None] * way, rtol=0, atol=1e-12)
    assert np.all(np.diff(share) >= -1e-12)
    halfway = problem.horizon // 2
    np.testing.assert_allclose(share[0], 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(share[halfway // 2], 0.5, rtol=0, atol=1e-12)
    np.testing.assert_allclose(share[halfway:], 1.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scene", ["paper", "tumbling", "planar"])
def test_the_velocities_of_the_path_are_its_derivative(scene):
    problem = ArmProblem(scene)
    path = tip_path_of(problem, random_start(problem, 3), 0.4)
    slopes = relative_twists(path.poses[:-2], path.poses[2:]) / (2.0 * problem.time_step)
    np.testing.assert_allclose(path.velocities[1:-1], slopes, rtol=0, atol=2e-3 * np.abs(slopes).max())


@pytest.mark.parametrize("scene", ["tumbling", "planar"])
def test_the_path_begins_with_the_velocity_of_the_tip(scene):
    problem = ArmProblem(scene)
    start = random_start(problem, 3)
    idle = np.zeros(problem.n_controls)
    later, earlier = (problem.kernels.step(start, idle, dt=dt) for dt in (1e-5, -1e-5))
    tips = problem.kernels.tip_pose(np.array([earlier, later]))
    expected = relative_twists(tips[:1], tips[1:])[0] / 2e-5
    path = tip_path_of(problem, start, 0.5)
    np.testing.assert_allclose(path.velocities[0], expected, rtol=0, atol=1e-7)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(path.velocities[-1], 0.0, rtol=0, atol=1e-12)
    error = poses.error_distance(path.poses[-1], problem.scene.target.pose.dual_quaternion)
    assert error < 1e-12


# The arm ---------------------------------------------------------------------------------------------------


@pytest.mark.sampled
@pytest.mark.parametrize("scene", robots())
@pytest.mark.parametrize("seed", [None, 0])
def test_every_robot_gets_a_finite_guess_within_its_limits(scene, seed):
    problem = ArmProblem(scene)
    start = problem.initial_state if seed is None else random_start(problem, seed)
    guess = screw_motion(problem, start)
    assert guess.states.shape == (problem.horizon + 1, problem.n_states)
    assert guess.controls.shape == (problem.horizon, problem.n_controls)
    assert np.all(np.isfinite(guess.states))
    assert np.all((guess.controls >= problem.control_lower) & (guess.controls <= problem.control_upper))
    np.testing.assert_array_equal(guess.states[0], start)


@pytest.mark.parametrize(
    ("scene", "seed"), [("paper", None), ("free-floating", 0), ("free-floating", 2), ("planar", 1)]
)
def test_the_tip_follows_its_path_where_the_arm_can(scene, seed):
    problem = ArmProblem(scene)
    start = problem.initial_state if seed is None else random_start(problem, seed)
    share = 0.5
    guess = screw_motion(problem, start, duration=share * problem.horizon * problem.time_step)
    path = tip_path_of(problem, start, share)
    tip = problem.kernels.tip_pose(guess.states)
    assert np.max(poses.error_distance(tip.T, path.poses.T)) < 0.02
    assert np.max(poses.error_angle(tip.T, path.poses.T)) < np.radians(2.0)
    assert problem.is_success(guess.states, guess.controls)
    assert problem.misses(start) > 1.0


@pytest.mark.parametrize("scene", ["paper", "far", "no-wrist", "payload"])
def test_the_tip_gets_nearer_even_if_the_target_is_out_of_reach(scene):
    problem = ArmProblem(scene)
    start = random_start(problem, 1)
    guess = screw_motion(problem, start)
    tip = problem.kernels.tip_pose(guess.states[[0, -1]])
    target = np.array([problem.scene.target.pose.dual_quaternion] * 2)
    first, last = np.linalg.norm(tip - target, axis=1)
    assert last < 0.8 * first


@pytest.mark.parametrize("scene", ["paper", "planar", "six-joint"])
def test_the_guess_is_a_motion_of_the_robot(scene):
    """Configurations move with the velocities, and between saturated stages the controls cause them."""
    problem = ArmProblem(scene)
    entries, tangent = problem.kernels.layout.state, problem.kernels.layout.tangent
    dt = problem.time_step
    guess = screw_motion(problem, random_start(problem, 0), duration=problem.horizon * problem.time_step)
    gap = problem.kernels.difference(
        guess.states[1:], problem.kernels.step(guess.states[:-1], guess.controls)
    )
    saturated = np.any(np.abs(guess.controls) >= problem.control_upper, axis=1)
    assert np.mean(saturated) < 0.1
    assert np.abs(gap[~saturated]).max() < 2e-3
    moved = problem.kernels.difference(guess.states[:-1], guess.states[1:])
    mean = 0.5 * (guess.states[1:] + guess.states[:-1])
    base = slice(tangent.rotation.start, tangent.translation.stop)
    np.testing.assert_allclose(moved[:, base], dt * mean[:, entries.base_velocity], rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        moved[:, tangent.joint_angles], dt * mean[:, entries.joint_rates], rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_without_actuators_on_the_base_the_momentum_is_kept(seed):
    problem = ArmProblem("free-floating")
    start = random_start(problem, seed)
    entries = problem.kernels.layout.state
    start[entries.base_velocity] = [0.02, -0.03, 0.01, 0.01, 0.02, -0.01]
    guess = screw_motion(problem, start, duration=problem.horizon * problem.time_step)
    momentum = problem.kernels.momentum(guess.states)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=1e-9)
    assert np.abs(guess.states[-1, entries.base_velocity]).max() > 1e-3


def test_thrusters_are_spared_and_wheels_take_the_angular_momentum_out():
    problem = ArmProblem("tumbling")
    guess = screw_motion(problem, duration=problem.horizon * problem.time_step)
    momentum = problem.kernels.momentum(guess.states)
    np.testing.assert_allclose(
        momentum[:, :3], np.broadcast_to(momentum[0, :3], (len(momentum), 3)), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(momentum[-1, 3:], 0.0, rtol=0, atol=1e-9)
    assert np.linalg.norm(momentum[0, 3:]) > 1.0
    force = guess.controls[:, problem.kernels.layout.control.base_force]
    assert np.quantile(np.abs(force), 0.95) < 0.5


def test_the_wrist_keeps_its_rate_limit_and_moves_as_commanded():
    problem = ArmProblem("paper")
    guess = screw_motion(problem, random_start(problem, 1), duration=1.0)
    layout = problem.kernels.layout
    rates = guess.controls[:, layout.control.wrist_rate]
    limits = problem.control_upper[layout.control.wrist_rate]
    assert np.mean(np.any(np.abs(rates) == limits, axis=1)) > 0.02
    moved = np.diff(guess.states[:, layout.state.wrist_angles], axis=0)
    np.testing.assert_allclose(moved, problem.time_step * rates, rtol=0, atol=1e-12)


def test_a_passive_joint_is_not_driven():
    scene = load_scene("paper")
    links = [link.model_dump() for link in scene.links]
    links[1]["actuated"] = False
    problem = ArmProblem(scene.replace(links=links))
    guess = screw_motion(problem, duration=problem.horizon * problem.time_step)
    angles = guess.states[:, problem.kernels.layout.state.joint_angles]
    np.testing.assert_array_equal(angles[:, 1], angles[0, 1])
    assert np.all(np.ptp(angles, axis=0)[[0, 2]] > 0.1)


# Bad input -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x0", "duration", "message"),
    [
        (np.zeros(3), None, r"x0 has shape \(3,\); expected \(23,\)"),
        (np.full(23, np.nan), None, r"x0\[0\] is nan"),
        (None, 0.0, r"duration is 0.0 s; it must be positive and at most the horizon, 15.0 s"),
        (None, 15.1, r"duration is 15.1 s; it must be positive"),
        (None, np.nan, r"duration is nan s; it must be positive"),
    ],
)
def test_bad_input_is_refused(x0, duration, message):
    with pytest.raises(ValueError, match=message):
        screw_motion(ArmProblem("paper"), x0, duration=duration)
