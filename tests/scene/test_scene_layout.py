"""Layout of state, tangent and controls; nominal and drawn starts with the sign rule of the pose cost."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dq_space_arm_env.scene import (
    Pose,
    Scene,
    Spread,
    StateLayout,
    draw_initial_state,
    initial_state,
    list_scenes,
    load_scene,
)

Change = Callable[..., dict[str, Any]]

SIZES = {  # n_x, n_t, n_u
    "approach-corridor": (23, 21, 12),
    "capture-and-detumble": (20, 18, 9),
    "elastic-joints": (26, 24, 9),
    "far": (23, 21, 12),
    "free-floating": (23, 21, 6),
    "joint-limits": (23, 21, 12),
    "keep-out": (23, 21, 12),
    "line-of-sight": (23, 21, 12),
    "motors": (29, 27, 12),
    "no-wrist": (20, 18, 9),
    "paper": (23, 21, 12),
    "payload": (20, 18, 9),
    "planar": (13, 12, 6),
    "plume": (23, 21, 12),
    "pointing": (23, 21, 12),
    "random-masses": (20, 18, 9),
    "random-target": (23, 21, 12),
    "reaction-wheels": (23, 21, 9),
    "refuelling": (23, 21, 12),
    "release": (20, 18, 9),
    "servicing": (23, 21, 12),
    "six-joint": (26, 24, 12),
    "tip-load": (23, 21, 12),
    "sliding": (22, 20, 10),
    "dual-arm": (30, 28, 14),
    "heavy-wrist": (27, 25, 12),
    "solar-panels": (31, 29, 12),
    "thrusters": (23, 21, 14),
    "tracking": (23, 21, 12),
    "tumbling": (23, 21, 12),
    "tumbling-target": (23, 21, 12),
    "wheel-saturation": (23, 21, 9),
    "wheels": (27, 25, 10),
}


def _matrix(position: Any, rotation: Rotation) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    return matrix


def _pose_matrix(pose: Pose) -> NDArray[np.float64]:
    return _matrix(pose.position, Rotation.from_quat(pose.rotation, scalar_first=True))


def tip_matrix(scene: Scene, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose of the tip as a homogeneous matrix, (27) with scipy's rotations: an independent reference."""
    state = StateLayout.of(scene).state
    pose = np.zeros(8)
    pose[[0, 3, 5, 6] if scene.base.motion == "planar" else slice(8)] = x[state.pose]
    w, vector = pose[0], pose[1:4]
    # r^Y = 2 q_d q_r*, vector part
    position = 2 * (w * pose[5:] - pose[4] * vector - np.cross(pose[5:], vector))
    matrix = _matrix(position, Rotation.from_quat(pose[:4], scalar_first=True))
    for link, angle in zip(scene.links, x[state.joint_angles], strict=True):
        matrix = matrix @ _pose_matrix(link.joint) @ _matrix((0, 0, 0), Rotation.from_euler("z", angle))
    if scene.wrist:
        wrist = _matrix((0, 0, 0), Rotation.from_euler("ZYX", x[state.wrist_angles]))
        matrix = matrix @ _pose_matrix(scene.wrist.frame) @ wrist
    return matrix @ _pose_matrix(scene.tip)


def tip_errors(scene: Scene, x: NDArray[np.float64]) -> tuple[float, float]:
    """Attitude error in degrees and position error in m of the tip."""
    tip, target = tip_matrix(scene, x), _pose_matrix(scene.target.pose)
    angle = Rotation.from_matrix(tip[:3, :3].T @ target[:3, :3]).magnitude()
    return float(np.degrees(angle)), float(np.linalg.norm(tip[:3, 3] - target[:3, 3]))


class TestSizes:
    def test_every_shipped_scene_is_listed(self) -> None:
        assert list_scenes() == sorted(SIZES)

    @pytest.mark.parametrize("name", SIZES)
    def test_sizes_and_slices_that_cover_everything_once(self, name: str) -> None:
        scene = load_scene(name)
        assert scene.name == name
        layout = StateLayout.of(scene)
        assert (layout.n_x, layout.n_t, layout.n_u) == SIZES[name]
        assert layout.initial_state.shape == (layout.n_x,)
        assert layout.control_limit.shape == layout.control_weight.shape == (layout.n_u,)
        for entries in (layout.state, layout.tangent, layout.control):
            besides = ("names", "units", "angular_velocity", "linear_velocity", "limits", "weights")
            parts = [getattr(entries, field.name) for field in fields(entries) if field.name not in besides]
            indices = [index for part in parts for index in range(part.start, part.stop)]
            assert sorted(indices) == list(range(len(entries.names)))
            assert len(entries.units) == len(set(entries.names)) == len(entries.names)


class TestPaper:
    layout = StateLayout.of(load_scene("paper"))

    def test_state(self) -> None:
        state, start = self.layout.state, self.layout.initial_state
        assert (state.pose, state.joint_angles) == (slice(0, 8), slice(8, 11))
        assert (state.wrist_angles, state.joint_rates) == (slice(11, 14), slice(20, 23))
        assert (state.angular_velocity, state.linear_velocity) == (slice(14, 17), slice(17, 20))
        assert state.names[0::11] == ("base pose q_r0", "wrist psi", "link 3 rate")
        pose_units = ("1",) * 4 + ("m",) * 4
        assert state.units == pose_units + ("rad",) * 6 + ("rad/s",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3
        # q_d = 1/2 r q_r with q_r = 1
        np.testing.assert_array_equal(start[:8], [1, 0, 0, 0, 0, 0.15, -1.45, 2.2])
        np.testing.assert_array_equal(start[8:14], [-0.6, 0.9, -1.6, 0.3, 0.2, -0.3])
        assert not start[14:].any()

    def test_tangent(self) -> None:
        tangent = self.layout.tangent
        assert (tangent.rotation, tangent.translation) == (slice(0, 3), slice(3, 6))
        assert (tangent.joint_angles, tangent.wrist_angles) == (slice(6, 9), slice(9, 12))
        assert (tangent.base_velocity, tangent.joint_rates) == (slice(12, 18), slice(18, 21))
        assert tangent.units[:6] == ("rad",) * 3 + ("m",) * 3

    def test_controls(self) -> None:
        control = self.layout.control
        assert (control.base_force, control.base_torque) == (slice(0, 3), slice(3, 6))
        assert (control.joint_torque, control.wrist_rate) == (slice(6, 9), slice(9, 12))
        assert control.names[0::3] == ("base force x", "base torque x", "link 1 torque", "wrist psi rate")
        assert control.units[0::3] == ("N", "N m", "N m", "rad/s")
        np.testing.assert_array_equal(self.layout.control_limit, np.repeat([10, 5, 2, 0.5], 3))
        np.testing.assert_array_equal(self.layout.control_weight, np.repeat([10, 1, 0.01, 0.1], 3))


class TestParts:
    def test_passive_joints_have_no_input(self, data: dict[str, Any], change: Change) -> None:
        layout = StateLayout.of(Scene.model_validate(change(data, "links.0.actuated", False)))
        assert (layout.n_joints, layout.actuated_joints) == (2, (1,))
        assert layout.control.names[layout.control.joint_torque] == ("lower torque",)
        assert layout.control.wrist_rate == slice(7, 10)
        layout = StateLayout.of(Scene.model_validate(change(data, "actuators.joint_torque")))
        assert layout.actuated_joints == ()
        assert layout.control.joint_torque == slice(6, 6)
        assert layout.n_x == 8 + 2 + 3 + 6 + 2

    def test_a_link_sets_its_own_limit(self, data: dict[str, Any], change: Change) -> None:
        change(data, "actuators.base_force.limit", float("inf"))
        layout = StateLayout.of(Scene.model_validate(change(data, "links.1.torque_limit", 0.25)))
        assert layout.control_limit.tolist() == [float("inf")] * 3 + [1, 2, 3, 2, 0.25, 0.5, 0.5, 0.5]

    def test_a_link_sets_its_own_weight(self, data: dict[str, Any], change: Change) -> None:
        change(data, "cost.joint_torque", 0.5)
        scene = Scene.model_validate(change(data, "links.1.torque_weight", 40.0))
        layout = StateLayout.of(scene)
        assert layout.control_weight[layout.control.joint_torque].tolist() == [0.5, 40.0]
        varying = StateLayout.of(scene.replace(parameters=["links.1.torque_weight"])).parameters
        assert (varying.names, varying.units) == (("links.1.torque_weight",), ("(N m)^-2",))

    def test_planar(self, planar_data: dict[str, Any], change: Change) -> None:
        turned = {"axis": [0, 0, 1], "angle": 60}
        change(planar_data, "initial_state.base_pose", {"position": [2, 4, 0], "rotation": turned})
        change(planar_data, "initial_state.base_velocity", [0, 0, 0.1, 0.2, 0.3, 0])
        change(planar_data, "cost.base_force", [7, 8, 9])
        change(planar_data, "cost.base_torque", [4, 5, 6])
        layout = StateLayout.of(Scene.model_validate(planar_data))
        assert layout.planar
        names = ("pose q_r0", "pose q_r3", "pose q_d1", "pose q_d2", "omega_z", "v_x", "v_y")
        assert tuple(name[5:] for name in layout.state.names if name.startswith("base ")) == names
        assert layout.tangent.names[:3] == ("base rotation z", "base translation x", "base translation y")
        assert layout.control.names == ("base force x", "base force y", "base torque z")
        assert layout.control_limit.tolist() == [1, 2, 6]
        assert layout.control_weight.tolist() == [7, 8, 6]
        # q_d = 1/2 (2 i + 4 j) (cos 30 deg + k sin 30 deg) = i (cos 30 + 2 sin 30) + j (2 cos 30 - sin 30)
        cosine, sine = np.sqrt(3) / 2, 0.5
        expected = [cosine, sine, cosine + 2 * sine, 2 * cosine - sine, 0, 0.1, 0.2, 0.3, 0]
        np.testing.assert_allclose(layout.initial_state, expected, rtol=0, atol=1e-15)


class TestSignRule:
    @pytest.mark.parametrize("sign", [1, -1])
    @pytest.mark.parametrize("name", ["paper", "six-joint", "planar", "payload"])
    def test_the_product_with_the_target_is_not_negative(self, name: str, sign: int) -> None:
        """The product of the quaternions along the arm, real parts of (27), written out once more."""
        scene, rng = load_scene(name), np.random.default_rng(3)
        wide = scene.spread.model_copy(update={"base_rotation": 3.0, "joint_angles": 3.0})
        target = scene.target.pose.model_dump()
        target["rotation"] = [sign * q for q in target["rotation"]]
        scene = scene.replace(spread=wide, target={"pose": target})
        state = StateLayout.of(scene).state
        products = []
        for x in (initial_state(scene), *(draw_initial_state(scene, rng) for _ in range(200))):
            base = np.zeros(4)
            planar = scene.base.motion == "planar"
            base[[0, 3] if planar else slice(4)] = x[state.pose][: 2 if planar else 4]
            q = base
            for link, angle in zip(scene.links, x[state.joint_angles], strict=True):
                q = _product(_product(q, link.joint.rotation), (np.cos(angle / 2), 0, 0, np.sin(angle / 2)))
            if scene.wrist:
                q = _product(q, scene.wrist.frame.rotation)
                for axis, angle in zip((3, 2, 1), x[state.wrist_angles], strict=True):
                    turn = np.zeros(4)
                    turn[0], turn[axis] = np.cos(angle / 2), np.sin(angle / 2)
                    q = _product(q, turn)
            q = _product(q, scene.tip.rotation)
            products.append(q @ np.array(scene.target.pose.rotation))
        assert min(products) >= 0
        assert max(products) > 0.5


def _product(a: Any, b: Any) -> NDArray[np.float64]:
    """Hamilton product from the scalar and vector parts."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], vector])


class TestDraw:
    @pytest.mark.parametrize("name", SIZES)
    def test_same_seed_same_start(self, name: str) -> None:
        scene = load_scene(name)
        first = draw_initial_state(scene, np.random.default_rng(7))
        np.testing.assert_array_equal(first, draw_initial_state(scene, np.random.default_rng(7)))
        assert (first != draw_initial_state(scene, np.random.default_rng(8))).any()
        still = scene.replace(spread=Spread())
        nominal = draw_initial_state(still, np.random.default_rng(7))
        np.testing.assert_array_equal(nominal, initial_state(scene))

    @pytest.mark.parametrize("name", ["paper", "planar", "tumbling"])
    def test_uniform_within_the_spread(self, name: str) -> None:
        scene, rng = load_scene(name), np.random.default_rng(1)
        layout, spread = StateLayout.of(scene), scene.spread
        states = np.array([draw_initial_state(scene, rng) for _ in range(2000)])
        nominal = layout.initial_state
        half_widths = {
            "joint_angles": spread.joint_angles,
            "wrist_angles": spread.wrist_angles,
            "angular_velocity": spread.base_angular_velocity,
            "linear_velocity": spread.base_linear_velocity,
            "joint_rates": spread.joint_rates,
        }
        for part, half_width in half_widths.items():
            where = getattr(layout.state, part)
            offsets = (states[:, where] - nominal[where]) / half_width
            assert (np.abs(offsets) <= 1 + 1e-12).all()
            # mean and variance of a uniform draw from [-1, 1], within 5 standard errors
            np.testing.assert_allclose(offsets.mean(axis=0), 0, rtol=0, atol=5 / np.sqrt(3 * 2000))
            np.testing.assert_allclose(offsets.var(axis=0), 1 / 3, rtol=0, atol=5 * np.sqrt(4 / 45 / 2000))

    def test_base_rotation_in_base_axes_and_position_in_inertial_axes(self) -> None:
        """The order of the draws is part of the meaning of a seed."""
        scene = load_scene("paper")
        turned = {"position": [1, 2, 3], "rotation": {"axis": [1, 2, 3], "angle": 50}}
        scene = scene.replace(initial_state={"base_pose": turned})
        x = draw_initial_state(scene, np.random.default_rng(5))
        uniform = np.random.default_rng(5).uniform(-1, 1, 21)
        nominal = Rotation.from_quat(scene.initial_state.base_pose.rotation, scalar_first=True)
        rotation = nominal * Rotation.from_rotvec(0.15 * uniform[:3])
        drawn = Rotation.from_quat(x[:4], scalar_first=True)
        np.testing.assert_allclose((rotation.inv() * drawn).magnitude(), 0, rtol=0, atol=1e-12)
        pose = Pose.model_validate({"dual_quaternion": x[:8]})
        np.testing.assert_allclose(
            pose.position, np.array([1, 2, 3]) + 0.15 * uniform[3:6], rtol=0, atol=1e-14
        )
        np.testing.assert_allclose(x[8:11], [-0.6, 0.9, -1.6] + 0.5 * uniform[6:9], rtol=0, atol=1e-15)
        np.testing.assert_allclose(x[11:14], [0.3, 0.2, -0.3] + 0.3 * uniform[9:12], rtol=0, atol=1e-15)
        np.testing.assert_allclose(x[14:20], 0.01 * uniform[12:18], rtol=0, atol=1e-17)
        np.testing.assert_allclose(x[20:23], 0.05 * uniform[18:21], rtol=0, atol=1e-17)

    def test_a_spread_of_zero_still_takes_its_draws(self) -> None:
        scene = load_scene("paper")
        still = scene.replace(spread={"base_rotation": 0.0})
        first, second = (draw_initial_state(each, np.random.default_rng(2)) for each in (scene, still))
        np.testing.assert_array_equal(first[8:], second[8:])


class TestTargets:
    def test_paper_starts_where_it_says(self) -> None:
        angle, distance = tip_errors(load_scene("paper"), initial_state(load_scene("paper")))
        assert angle == pytest.approx(74.4, abs=0.05)
        assert distance == pytest.approx(1.330, abs=0.0005)

    def test_nine_starts_of_paper_in_ten_are_within_the_stated_range(self) -> None:
        scene, rng = load_scene("paper"), np.random.default_rng(1)
        errors = np.array([tip_errors(scene, draw_initial_state(scene, rng)) for _ in range(1000)])
        angle, distance = np.percentile(errors, [5, 95], axis=0).T
        np.testing.assert_allclose(angle, [45, 111], rtol=0, atol=3)
        np.testing.assert_allclose(distance, [0.87, 1.84], rtol=0, atol=0.03)

    @pytest.mark.parametrize(
        ("name", "joint_angles", "wrist_angles"),
        [
            ("free-floating", (-0.2, 0.8, -1.7), (0, 0, 0)),
            ("no-wrist", (0.1, 0.5, -1.0), ()),
            ("payload", (-0.3, 0.7, -1.2), ()),
            ("planar", (-0.2, 0.9, 0.6), ()),
            ("reaction-wheels", (0.4, 0.6, -1.2), (0, 0.3, 0)),
            ("six-joint", (0.0, 0.5, -1.0, 0.3, -0.4, 0.2), ()),
            ("tip-load", (-0.2, 0.8, -1.7), (0, 0, 0)),
            ("tumbling", (0.0, 0.6, -1.2), (0, 0, 0)),
        ],
    )
    def test_targets_are_tip_poses_of_the_angles_in_the_comment(
        self, name: str, joint_angles: tuple[float, ...], wrist_angles: tuple[float, ...]
    ) -> None:
        scene = load_scene(name)
        state = StateLayout.of(scene).state
        x = initial_state(scene)
        x[state.joint_angles], x[state.wrist_angles] = joint_angles, wrist_angles
        angle, distance = tip_errors(scene, x)
        assert angle < 1e-4
        assert distance < 1e-4


def test_far_is_paper_with_a_wider_spread() -> None:
    paper, far = load_scene("paper"), load_scene("far")
    spread = paper.spread.model_copy(update={"base_position": 0.4, "base_rotation": 0.5})
    assert paper.replace(spread=spread).content_hash() == far.content_hash()
