"""Targets that move: their paths against closed forms, and the environment that follows them."""

import copy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dq_space_arm_env import (
    DQSpaceArmEnv,
    DQSpaceArmVectorEnv,
    Scene,
    SceneError,
    compile_scene,
    load_scene,
)
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, rotations, screw
from dq_space_arm_env.algebra.dual_vectors import inverse_transform
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene.path import shown_target

Array = NDArray[np.float64]

POSE = {"position": [1.0, -3.5, 4.6], "rotation": {"axis": [0.85, -0.2, -0.5], "angle": 95}}
GRASP = {"position": [-0.4, 0.1, 0.2], "rotation": {"axis": [0.2, 0.1, 1.0], "angle": 40}}
INERTIA = [[4.9, 0.3, -0.2], [0.3, 7.1, 0.4], [-0.2, 0.4, 8.7]]
POINTS = [
    {"time": 0.02, "pose": {"position": [0.5, 0.2, 1.0], "rotation": {"axis": [0, 0, 1], "angle": 10}}},
    {"time": 0.08, "pose": {"position": [0.6, 0.2, 1.1], "rotation": {"axis": [0, 1, 1], "angle": 200}}},
    {"time": 0.15, "pose": {"position": [0.6, 0.3, 1.1], "rotation": {"axis": [1, 1, 1], "angle": 215}}},
]
MOTIONS: dict[str, dict[str, Any]] = {
    "screw": {"kind": "screw", "angular_velocity": [0.2, -0.1, 0.3], "linear_velocity": [0.1, 0.05, -0.2]},
    "tumbling": {
        "kind": "tumbling",
        "inertia": INERTIA,
        "angular_velocity": [0.3, -0.4, 0.5],
        "linear_velocity": [0.1, 0.05, -0.2],
    },
    "waypoints": {"kind": "waypoints", "points": POINTS},
}
STEPS = 12


def scene_of(kind: str, steps: int = STEPS, **changes: Any) -> Scene:
    """The paper's robot with all that a target may do."""
    cost = {
        "tip_twist": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "terminal_tip_twist": [60.0, 50.0, 40.0, 30.0, 20.0, 10.0],
    }
    spread: dict[str, float] = {"target_position": 0.2, "target_rotation": 0.3, "joint_angles": 0.2}
    spread |= {"grasp_rotation": 0.2, "grasp_position": 0.05, "base_position": 0.1}
    if kind != "waypoints":
        spread |= {"target_angular_velocity": 0.1, "target_linear_velocity": 0.05}
    scene = load_scene("paper").replace(
        {
            "target": {"pose": POSE, "grasp": GRASP, "motion": MOTIONS[kind]},
            "cost": cost,
            "spread": spread,
            "success": {"angular_velocity_error_deg": 5.0, "velocity_error": 0.5},
            "simulation.steps": steps,
        }
    )
    return scene.replace(changes) if changes else scene


def homogeneous(pose: Any) -> Array:
    matrix = np.eye(4)
    rotation, position = poses.to_matrix(tuple(np.asarray(pose).tolist()))
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def twist_matrix(angular: Any, linear: Any) -> Array:
    (x, y, z), matrix = angular, np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = linear
    return matrix


def body_path(scene: Scene) -> tuple[Array, Array]:
    """Poses and velocities of the body at the stages, from the machine code."""
    kernels = compile_scene(scene)
    rows = kernels.stage_parameters()
    velocities = rows[:, kernels.parameters.indices("target.velocity")]
    return kernels.layout.target_body_with(rows), velocities


class TestPaths:
    def test_a_screw_is_the_exponential_of_its_twist(self) -> None:
        scene = scene_of("screw", 400)
        path, velocities = body_path(scene)
        motion, start = MOTIONS["screw"], homogeneous(scene.target.pose.dual_quaternion)
        twist = twist_matrix(motion["angular_velocity"], motion["linear_velocity"])
        for k in (1, 57, 400):
            np.testing.assert_allclose(
                homogeneous(path[k]), start @ expm(0.015 * k * twist), rtol=0, atol=1e-13
            )
        assert (velocities == [*motion["angular_velocity"], *motion["linear_velocity"]]).all()

    def test_an_axisymmetric_body_turns_as_the_closed_form(self) -> None:
        """q(t) = q0 exp(H t / 2 A) exp(-lam t e_z / 2), lam = (C - A) w_z / A, H = J w0."""
        a, c, w0 = 4.0, 7.0, np.array([0.3, -0.4, 0.5])
        motion = {"kind": "tumbling", "inertia": [a, a, c], "angular_velocity": w0.tolist()}
        scene = scene_of("tumbling", 400, **{"target.motion": motion})
        path, velocities = body_path(scene)
        lam, momentum = (c - a) / a * w0[2], np.array([a, a, c]) * w0
        t = 0.015 * np.arange(401)
        cos, sin = np.cos(lam * t), np.sin(lam * t)
        expected = [cos * w0[0] - sin * w0[1], sin * w0[0] + cos * w0[1], np.full(401, w0[2])]
        np.testing.assert_allclose(velocities[:, :3].T, expected, rtol=0, atol=5e-11)
        first = Rotation.from_quat(scene.target.pose.rotation, scalar_first=True)
        turned = first * Rotation.from_rotvec(np.outer(t / a, momentum))
        turned = turned * Rotation.from_rotvec(np.outer(-lam * t, [0, 0, 1]))
        found = Rotation.from_quat(path[:, :4], scalar_first=True)
        assert (found.inv() * turned).magnitude().max() < 3e-11

    def test_a_body_without_symmetry_keeps_momentum_and_energy_and_goes_where_integration_goes(self) -> None:
        scene = scene_of("tumbling", 1000)
        path, velocities = body_path(scene)
        inertia, w0 = np.array(INERTIA), np.array(MOTIONS["tumbling"]["angular_velocity"])
        attitudes = Rotation.from_quat(path[:, :4], scalar_first=True)
        momentum = attitudes.apply(velocities[:, :3] @ inertia)
        np.testing.assert_allclose(momentum, np.tile(momentum[0], (1001, 1)), rtol=0, atol=1e-9)
        energy = np.einsum("ki,ij,kj->k", velocities[:, :3], inertia, velocities[:, :3])
        np.testing.assert_allclose(energy, energy[0], rtol=1e-10)

        def rates(_: float, y: Array) -> Array:
            w, q = y[:3], y[3:]
            turning = 0.5 * np.array(dq.multiply((*q, 0, 0, 0, 0), (0, *w, 0, 0, 0, 0))[:4])
            return np.concatenate([np.linalg.solve(inertia, np.cross(inertia @ w, w)), turning])

        begin = np.concatenate([w0, scene.target.pose.rotation])
        solved = solve_ivp(rates, (0.0, 15.0), begin, method="DOP853", rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(velocities[-1, :3], solved.y[:3, -1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(path[-1, :4], solved.y[3:, -1], rtol=0, atol=1e-9)

    def test_the_center_of_mass_of_a_tumbling_body_moves_straight_on(self) -> None:
        scene = scene_of("tumbling", 400)
        path, velocities = body_path(scene)
        linear = MOTIONS["tumbling"]["linear_velocity"]
        places = np.array([homogeneous(pose)[:3, 3] for pose in path])
        np.testing.assert_allclose(
            places, np.add(POSE["position"], np.outer(0.015 * np.arange(401), linear)), rtol=0, atol=1e-13
        )
        attitudes = Rotation.from_quat(path[:, :4], scalar_first=True)
        np.testing.assert_allclose(
            attitudes.apply(velocities[:, 3:]), np.tile(linear, (401, 1)), rtol=0, atol=1e-13
        )

    def test_waypoints_are_passed_with_a_constant_twist_between_them(self) -> None:
        """From the pose at the start the body moves as the points do from the first."""
        scene = scene_of("waypoints", 300, **{"simulation.dt": 0.001})
        path, velocities = body_path(scene)
        given = [homogeneous(point.pose.dual_quaternion) for point in scene.target.motion.points]
        start = homogeneous(scene.target.pose.dual_quaternion) @ np.linalg.inv(given[0])
        for k, pose in zip((20, 80, 150), given, strict=True):
            np.testing.assert_allclose(homogeneous(path[k]), start @ pose, rtol=0, atol=1e-13)
        for still in (slice(0, 20), slice(151, None)):
            assert not velocities[still].any()
            assert np.ptp(path[still], axis=0).max() < 1e-15
        for between, seconds, (first, second) in (
            (slice(20, 80), 0.06, given[:2]),
            (slice(80, 151), 0.07, given[1:]),  # the last pose is passed
        ):
            assert np.ptp(velocities[between], axis=0).max() < 1e-13
            twist = seconds * twist_matrix(velocities[between][0, :3], velocities[between][0, 3:])
            np.testing.assert_allclose(first @ expm(twist), second, rtol=0, atol=1e-13)
            assert np.linalg.norm(velocities[between][0, :3]) * seconds < np.pi  # the shorter way
        assert (np.sum(path[1:, :4] * path[:-1, :4], axis=1) > 0.9).all()

    def test_waypoints_pass_through_their_poses_from_the_pose_of_the_first(self) -> None:
        first = POINTS[0]["pose"]
        path, _ = body_path(scene_of("waypoints", 300, **{"simulation.dt": 0.001, "target.pose": first}))
        last = scene_of("waypoints").target.motion.points[-1].pose.dual_quaternion
        np.testing.assert_allclose(homogeneous(path[-1]), homogeneous(last), rtol=0, atol=1e-13)

    @pytest.mark.parametrize("kind", MOTIONS)
    def test_pictures_show_the_path_of_the_machine_code(self, kind: str) -> None:
        scene = scene_of(kind)
        kernels = compile_scene(scene)
        rows = kernels.stage_parameters()
        target, body = shown_target(scene)
        np.testing.assert_allclose(target, kernels.layout.target_with(rows), rtol=0, atol=1e-14)
        np.testing.assert_allclose(body, kernels.layout.target_body_with(rows), rtol=0, atol=1e-14)

    @pytest.mark.parametrize("kind", MOTIONS)
    def test_the_velocity_is_that_of_the_path(self, kind: str) -> None:
        """Central differences of the pose of the grasp frame, in its axes."""
        kernels = compile_scene(scene_of(kind))
        rows, h = kernels.stage_parameters(), 0.015
        targets = kernels.layout.target_with(rows)
        velocities = kernels.layout.target_velocity_with(rows)
        for k in range(3, 5) if kind == "waypoints" else range(1, STEPS):  # within a piece
            steps = [
                screw.logarithm(dq.multiply(dq.conjugate(tuple(targets[k])), tuple(targets[k + sign])))
                for sign in (1, -1)
            ]
            slope = np.subtract(*steps) / (2 * h)
            np.testing.assert_allclose(
                velocities[k], slope, rtol=0, atol=1e-4 if kind == "tumbling" else 1e-12
            )


def fly(env: DQSpaceArmEnv, actions: Array) -> tuple[Array, float, dict[str, Any]]:
    total = 0.0
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        total += reward
    return observation, total, info


def drawn_actions(steps: int = STEPS, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 12))


@pytest.mark.parametrize("kind", MOTIONS)
class TestEpisodes:
    def test_the_environment_follows_the_path(self, kind: str) -> None:
        env = DQSpaceArmEnv(scene_of(kind))
        env.reset(seed=3)
        rows = env.kernels.stage_parameters(env.parameters)
        np.testing.assert_array_equal(env.stage_parameters, rows[0])
        assert np.abs(rows[-1] - rows[0]).max() > 0.01
        for action, row in zip(drawn_actions(), rows[1:], strict=True):
            env.step(action)
            np.testing.assert_allclose(env.stage_parameters, row, rtol=0, atol=1e-14)
            np.testing.assert_allclose(env.target, env.kernels.layout.target_with(row), rtol=0, atol=1e-14)

    def test_the_return_is_minus_the_cost_along_the_stages(self, kind: str) -> None:
        env = DQSpaceArmEnv(scene_of(kind))
        env.reset(seed=3)
        kernels, rows, cost = env.kernels, env.kernels.stage_parameters(env.parameters), 0.0
        total = 0.0
        for action, row in zip(drawn_actions(), rows, strict=False):
            u, x = kernels.layout.to_control(action), env.state
            stage = float(kernels.cost(x, u, p=row))
            _, reward, _, _, info = env.step(action)
            twist = kernels.relative_twist(x, u, row)
            weighed = float(np.array([1, 2, 3, 4, 5, 6]) @ twist**2)
            assert info["cost_tip_twist"] == pytest.approx(weighed, rel=1e-12)
            cost, total = cost + stage, total + reward
        cost += float(kernels.terminal_cost(env.state, p=rows[-1]))
        assert total == pytest.approx(-cost, rel=1e-12)
        held = kernels.relative_twist(env.state, p=rows[-1])
        expected = float(np.array([60, 50, 40, 30, 20, 10]) @ held**2)
        assert info["terminal_cost_tip_twist"] == pytest.approx(expected, rel=1e-12)
        assert info["angular_velocity_error"] == pytest.approx(np.degrees(np.linalg.norm(held[:3])))
        assert info["velocity_error"] == pytest.approx(np.linalg.norm(held[3:]))

    @pytest.mark.sampled
    @pytest.mark.parametrize("options", ["parameters", "target"])
    def test_a_given_target_moves_from_where_it_is_given(self, kind: str, options: str) -> None:
        """Not from where one was drawn."""
        one, other = DQSpaceArmEnv(scene_of(kind)), DQSpaceArmEnv(scene_of(kind))
        one.reset(seed=3)
        given: dict[str, Any] = {"parameters": one.parameters}
        if options == "target":
            other.reset(seed=5)
            target, velocity = one.target, other.kernels.layout.target_velocity_with(other.parameters)
            given = {"target": target}
        other.reset(seed=5, options=given)
        np.testing.assert_allclose(other.target, one.target, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(other.stage_parameters, other.parameters)
        if options == "target":
            kept = other.kernels.layout.target_velocity_with(other.stage_parameters)
            np.testing.assert_array_equal(kept, velocity)
        rows = other.kernels.stage_parameters(other.parameters)
        fly(other, drawn_actions(4))
        np.testing.assert_allclose(other.stage_parameters, rows[4], rtol=0, atol=1e-14)
        copies = DQSpaceArmVectorEnv(2, scene_of(kind))
        copies.reset(seed=[5, 6], options=given)
        np.testing.assert_array_equal(copies.stage_parameters[0], rows[0])

    @pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
    def test_copies_have_the_bits_of_single_environments(self, kind: str, mode: str) -> None:
        """Over the end of an episode too."""
        scene = scene_of(kind)
        copies, singles = DQSpaceArmVectorEnv(5, scene, mode), [DQSpaceArmEnv(scene) for _ in range(5)]
        seen, _ = copies.reset(seed=[1, 2, 3, 4, 5])
        expected = [env.reset(seed=i + 1)[0] for i, env in enumerate(singles)]
        np.testing.assert_array_equal(seen, expected)
        rng, over = np.random.default_rng(0), False
        for _ in range(2 * STEPS + 3):
            actions = rng.uniform(-1.0, 1.0, (5, 12))
            seen, rewards, ends, _, info = copies.step(actions)
            for i, env in enumerate(singles):
                if over and mode == "NextStep":
                    np.testing.assert_array_equal(seen[i], env.reset()[0])
                    continue
                observation, reward, end, _, single = env.step(actions[i])
                assert rewards[i] == reward
                assert ends[i] == end
                if end and mode == "SameStep":
                    assert info["final_info"]["velocity_error"][i] == single["velocity_error"]
                    np.testing.assert_array_equal(info["final_obs"][i], observation)
                    observation, _ = env.reset()
                else:
                    assert info["velocity_error"][i] == single["velocity_error"]
                    assert info["cost_tip_twist"][i] == single["cost_tip_twist"]
                np.testing.assert_array_equal(seen[i], observation)
            over = bool(ends.all())
            rows = [env.stage_parameters for env in singles]
            np.testing.assert_array_equal(copies.stage_parameters, rows)

    def test_a_saved_episode_goes_on_with_its_target(self, kind: str) -> None:
        env, other = (DQSpaceArmEnv(scene_of(kind)) for _ in range(2))
        env.reset(seed=3)
        fly(env, drawn_actions(5))
        state, where = env.get_state(), env.stage_parameters
        expected = fly(env, drawn_actions(STEPS - 5, seed=1))
        other.set_state(state)
        np.testing.assert_array_equal(other.stage_parameters, where)
        for again in (other, copy.deepcopy(other)):
            found = fly(again, drawn_actions(STEPS - 5, seed=1))
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[1:] == expected[1:]
        other.reset(options={"state": state})
        assert fly(other, drawn_actions(STEPS - 5, seed=1))[1] == expected[1]

    def test_the_scene_of_an_episode_has_its_motion(self, kind: str) -> None:
        env = DQSpaceArmEnv(scene_of(kind))
        env.reset(seed=3)
        twin = DQSpaceArmEnv(env.episode_scene)
        twin.reset(options={"initial_state": env.state})
        found, expected = fly(twin, drawn_actions()), fly(env, drawn_actions())
        np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=1e-12)
        assert found[1] == pytest.approx(expected[1], rel=1e-12)

    def test_rollouts_record_the_path(self, kind: str) -> None:
        scene = scene_of(kind)
        flown = rollout(lambda seen: 0.1 * np.tanh(seen[:, :12]), scene, [3, 4], record=True)
        np.testing.assert_allclose(sum(flown.cost_terms.values()), -flown.rewards.sum(axis=1), rtol=1e-12)
        trajectory = flown.trajectory(1, "second", "drawn")
        rows = compile_scene(scene).stage_parameters(flown.parameters[1])
        layout = compile_scene(scene).layout
        np.testing.assert_array_equal(trajectory.target, layout.target_with(rows))
        np.testing.assert_array_equal(trajectory.target_body, layout.target_body_with(rows))

    def test_single_precision_follows_double(self, kind: str) -> None:
        exact = DQSpaceArmEnv(scene_of(kind))
        coarse = DQSpaceArmEnv(scene_of(kind, **{"simulation.precision": "float32"}))
        for env in (exact, coarse):
            env.reset(seed=3)
        (seen, total, _), (found, sum_, _) = fly(exact, drawn_actions()), fly(coarse, drawn_actions())
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, seen, rtol=0, atol=1e-5)
        assert sum_ == pytest.approx(total, rel=1e-5)
        assert coarse.observation_space.contains(found)

    def test_a_common_rigid_motion_of_base_and_target_is_not_seen(self, kind: str) -> None:
        env, other = DQSpaceArmEnv(scene_of(kind)), DQSpaceArmEnv(scene_of(kind))
        observation, _ = env.reset(seed=3)
        moved = poses.from_rotation_and_position(rotations.exponential((0.5, -1.0, 0.7)), (3.0, -2.0, 1.0))
        x, parameters = env.state, env.parameters
        x[:8] = dq.multiply(moved, tuple(x[:8].tolist()))
        where = env.kernels.parameters.indices("target.pose")
        parameters[where] = dq.multiply(moved, tuple(parameters[where].tolist()))
        again, _ = other.reset(options={"initial_state": x, "parameters": parameters})
        np.testing.assert_allclose(again, observation, rtol=0, atol=1e-13)
        if kind == "tumbling":
            assert np.abs(other.stage_parameters - env.stage_parameters).max() > 0.1
        end, seen = fly(other, drawn_actions())[0], fly(env, drawn_actions())[0]
        np.testing.assert_allclose(end, seen, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", MOTIONS)
def test_the_observation_ends_with_relative_twist_target_twist_and_time(kind: str) -> None:
    env = DQSpaceArmEnv(scene_of(kind))
    env.reset(seed=3)
    observation, _, _ = fly(env, drawn_actions(4))
    kernels, x, row = env.kernels, env.state, env.stage_parameters
    assert observation.shape == env.observation_space.shape == (23 + 12 + 1,)
    relative = kernels.relative_twist(x, p=row)
    np.testing.assert_allclose(observation[23:29], relative, rtol=0, atol=1e-14)
    target, tip = env.target, kernels.tip_pose(x)
    pose = poses.to_matrix(dq.multiply(dq.conjugate(tuple(target)), tuple(tip)))
    carried = inverse_transform(*pose, tuple(kernels.layout.target_velocity_with(row).tolist()))
    np.testing.assert_allclose(observation[29:35], carried, rtol=0, atol=1e-13)
    np.testing.assert_allclose(relative, kernels.tip_twist(x, np.zeros(12)) - carried, rtol=0, atol=1e-13)
    np.testing.assert_allclose(kernels.state_from_observation(observation, p=row), x, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", ["screw", "tumbling"])
def test_the_relative_twist_is_the_rate_of_the_relative_pose(kind: str) -> None:
    """Central differences over steps of 1 ms along a motion with constant inputs."""
    scene = scene_of(kind, 200, **{"simulation.dt": 0.001})
    kernels = compile_scene(scene)
    u = 0.3 * kernels.layout.control_limit * drawn_actions(1)[0]
    x = kernels.simulate(kernels.layout.initial_state, u, 200)
    rows = kernels.stage_parameters()
    tips, targets = kernels.tip_pose(x), kernels.layout.target_with(rows)
    relative = np.stack(dq.multiply(dq.conjugate(tuple(targets.T)), tuple(tips.T)), axis=1)
    for k in (50, 120):

        def way(other: int, here: int = k) -> Array:
            between = dq.multiply(dq.conjugate(tuple(relative[here])), tuple(relative[other]))
            return np.array(screw.logarithm(between))

        near, far = ((way(k + n) - way(k - n)) / (2e-3 * n) for n in (1, 2))
        np.testing.assert_allclose(
            kernels.relative_twist(x[k], u, rows[k]), (4 * near - far) / 3, rtol=0, atol=1e-9
        )


def test_a_planar_target_moves_in_its_plane() -> None:
    motion = {"kind": "screw", "angular_velocity": [0, 0, 0.2], "linear_velocity": [0.1, -0.05, 0]}
    scene = load_scene("planar").replace(
        {
            "target.motion": motion,
            "target.grasp": {"position": [0.1, 0.2, 0.0], "rotation": {"axis": [0, 0, 1], "angle": 20}},
            "cost.tip_twist": 2.0,
            "spread.target_angular_velocity": 0.1,
            "spread.target_linear_velocity": 0.1,
            "simulation.steps": STEPS,
        }
    )
    env = DQSpaceArmEnv(scene)
    start, _ = env.reset(seed=1)
    assert start.shape == (13 + 6 + 1,)
    kernels, rows, cost, total = env.kernels, env.kernels.stage_parameters(env.parameters), 0.0, 0.0
    assert np.abs(env.parameters - kernels.parameters.nominal).max() > 0.01
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, kernels.n_u))
    for k, action in enumerate(actions):
        cost += float(kernels.cost(env.state, kernels.layout.to_control(action), p=rows[k]))
        observation, reward, *_ = env.step(action)
        total += reward
    cost += float(kernels.terminal_cost(env.state, p=rows[-1]))
    assert total == pytest.approx(-cost, rel=1e-12)
    body = kernels.layout.target_body_with(rows)
    velocity = rows[0, kernels.parameters.indices("target.velocity")]
    turn = expm(0.015 * STEPS * twist_matrix((0, 0, velocity[0]), (*velocity[1:], 0)))
    np.testing.assert_allclose(homogeneous(body[-1]), homogeneous(body[0]) @ turn, rtol=0, atol=1e-14)
    twist = kernels.relative_twist(env.state, p=rows[-1])
    np.testing.assert_allclose(observation[13:16], twist[2:5], rtol=0, atol=1e-14)
    np.testing.assert_allclose(twist[[0, 1, 5]], 0.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        kernels.state_from_observation(observation, p=rows[-1]), env.state, rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("kind", MOTIONS)
def test_the_velocity_of_the_base_may_be_relative_to_the_target(kind: str) -> None:
    """The reference is the twist that a base fixed to the target would have, plus the scene's own."""
    weights, own = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.1, 0.2, -0.1, 0.3, 0.1, -0.2]
    target = {"target.base_velocity_relative": True, "target.base_velocity": own}
    cost = {"cost.base_velocity": weights, "cost.terminal_base_velocity": 2.0}
    env = DQSpaceArmEnv(scene_of(kind, **target, **cost))
    env.reset(seed=3)
    layout, deviation = env.kernels.layout, np.zeros(6)
    for _ in range(STEPS):
        info = env.step(np.full(12, 0.3))[4]
        if deviation.any():
            assert info["cost_base_velocity"] == pytest.approx(weights @ deviation**2, rel=1e-11)
        x, row = env.state, env.stage_parameters
        relative = np.linalg.inv(homogeneous(x[:8])) @ homogeneous(layout.target_with(row))
        rotation, position = relative[:3, :3], relative[:3, 3]
        angular, linear = layout.target_velocity_with(row).reshape(2, 3) @ rotation.T
        carried = np.concatenate([angular, linear + np.cross(position, angular)])
        deviation = x[layout.state.base_velocity] - own - carried
    assert info["terminal_cost_base_velocity"] == pytest.approx(2.0 * deviation @ deviation, rel=1e-11)


@pytest.mark.slow
def test_a_relative_velocity_without_weights_is_not_computed() -> None:
    free = scene_of("screw", **{"cost.base_velocity": 0.0, "cost.terminal_base_velocity": 0.0})
    follows = free.replace({"target.base_velocity_relative": True})
    for program in (
        "environment_step",
        "cost_derivatives",
        "terminal_cost_derivatives",
        "lagrangian_hessian",
    ):
        assert compile_scene(follows).operation_count(program) == compile_scene(free).operation_count(program)
    assert "base_velocity_relative" not in free.to_yaml()
    with pytest.raises(SceneError, match="base_velocity_relative = true: must be false: the target has no"):
        load_scene("paper").replace({"target.base_velocity_relative": True})


def test_a_target_too_fast_for_observations_is_refused() -> None:
    scene = scene_of("screw", **{"target.motion.linear_velocity": [1e8, 0, 0]})
    with pytest.raises(ValueError, match=r"target\.motion: 1e\+08 m"):
        DQSpaceArmEnv(scene)


@pytest.mark.parametrize(("name", "most"), [("tracking", 1.06), ("tumbling-target", 1.12)])
def test_a_target_that_moves_adds_few_operations(name: str, most: float) -> None:
    scene = load_scene(name)
    rest = {
        "target.motion": None,
        "target.base_velocity_relative": False,
        "spread.target_angular_velocity": 0.0,
        "spread.target_linear_velocity": 0.0,
    }
    moving, fixed = (
        compile_scene(each).operation_count("environment_step") for each in (scene, scene.replace(rest))
    )
    assert moving < most * fixed
