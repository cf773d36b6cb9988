"""MJCF of scenes in MuJoCo: accelerations, inverse dynamics, tip, start, limits."""

import math
import os
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from foreign_robots import ROBOTS, accelerations, drawn, foreign_scene, relative_error, tip_pose

from dq_space_arm_env import SceneError, load_scene, scene_to_mjcf, scene_to_urdf
from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.path import shown_target

mujoco = pytest.importorskip("mujoco")

SCENES = ("paper", "no-wrist", "planar", "payload", "six-joint", "free-floating", "reaction-wheels")


def mujoco_state(scene, x):
    """MuJoCo's qpos and qvel, and the rotation matrix from base to inertial axes."""
    entries = StateLayout.of(scene).state
    angles, rates = x[entries.joint_angles], x[entries.joint_rates]
    if StateLayout.of(scene).planar:
        pose = np.zeros(8)
        pose[[0, 3, 5, 6]] = x[entries.pose]
        omega, velocity = x[entries.base_velocity][:1], np.array([*x[entries.base_velocity][1:], 0.0])
    else:
        pose = x[entries.pose]
        omega, velocity = x[entries.angular_velocity], x[entries.linear_velocity]
    matrix, position = (np.array(part) for part in poses.to_matrix(tuple(pose)))
    velocity = matrix @ velocity
    if StateLayout.of(scene).planar:
        yaw = 2.0 * np.arctan2(pose[3], pose[0])
        return [*position[:2], yaw, *angles], [*velocity[:2], *omega, *rates], matrix
    return [*position, *pose[:4], *angles], [*velocity, *omega, *rates], matrix


def scene_accelerations(scene, x, qacc, matrix):
    """The scene's accelerations from MuJoCo's: the components of the velocity turn with the base."""
    entries = StateLayout.of(scene).state
    if StateLayout.of(scene).planar:
        omega, (v_x, v_y) = x[entries.base_velocity][0], x[entries.base_velocity][1:]
        linear = matrix.T @ [*qacc[:2], 0.0] - omega * np.array([-v_y, v_x, 0.0])
        return np.array([qacc[2], *linear[:2], *qacc[3:]])
    turning = np.cross(x[entries.angular_velocity], x[entries.linear_velocity])
    return np.array([*qacc[3:6], *(matrix.T @ qacc[:3] - turning), *qacc[6:]])


def limited(scene, u):
    """The part of the inputs that MuJoCo has motors for, within their limits."""
    count = StateLayout.of(scene).control.joint_torque.stop
    u = np.clip(u, -0.9 * (limit := StateLayout.of(scene).control_limit), 0.9 * limit)
    u[count:] = 0.0
    return u, u[:count]


def check_accelerations(scene, samples=5):
    """MuJoCo's accelerations, inverse dynamics and tip at random states, also beyond joint limits."""
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene, wrist="fixed"))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(samples):
        x, u = drawn(scene, rng)
        x[StateLayout.of(scene).state.wrist_angles] = scene.initial_state.wrist_angles
        u, motors = limited(scene, u)
        data.qpos, data.qvel, matrix = mujoco_state(scene, x)
        data.ctrl = motors
        mujoco.mj_forward(model, data)
        found = scene_accelerations(scene, x, data.qacc, matrix)
        assert relative_error(found, accelerations(scene, x, u)) < 1e-12
        rotation, position = tip_pose(scene, x)
        np.testing.assert_allclose(data.site("tip").xmat.reshape(3, 3), rotation, rtol=0, atol=1e-13)
        np.testing.assert_allclose(data.site("tip").xpos, position, rtol=0, atol=1e-13)
        applied = data.qfrc_actuator.copy()
        mujoco.mj_inverse(model, data)
        assert relative_error(data.qfrc_inverse, applied) < 1e-12


@pytest.mark.parametrize("name", SCENES)
def test_accelerations_forces_and_tip_are_the_same(name):
    check_accelerations(load_scene(name))


@pytest.mark.parametrize("name", ["paper", "six-joint"])
def test_springs_dampers_and_passive_joints_are_the_same(name):
    scene = load_scene(name)
    parts = {"stiffness": 3.0, "rest_angle": 0.4, "damping": 0.7, "torque_limit": None}
    links = [{**link.model_dump(), **parts, "actuated": i != 1} for i, link in enumerate(scene.links)]
    check_accelerations(scene.replace(links=links))


def test_slides_are_the_same_and_screws_are_refused():
    scene = load_scene("sliding")
    with pytest.raises(SceneError, match="it has no screw joints, and link 'drive' has one"):
        scene_to_mjcf(scene)
    parts = {"joint_type": "prismatic", "pitch": 0.0, "stiffness": 20.0, "rest_angle": 0.1, "damping": 0.7}
    check_accelerations(scene.replace({f"links.3.{name}": part for name, part in parts.items()}))


def test_rotors_are_armatures_and_what_mujoco_lacks_is_refused():
    scene = load_scene("six-joint")
    motor = {"inertia": 2e-5, "gear": -80.0, "coupling": "armature"}
    geared = scene.replace({f"links.{i}.motor": motor for i in range(0, 6, 2)})
    check_accelerations(geared)
    with pytest.raises(SceneError, match="set its motor's coupling to armature"):
        scene_to_mjcf(geared.replace({"links.2.motor.coupling": "exact"}))
    with pytest.raises(SceneError, match="it has no elastic gears, and link 'elbow' has one"):
        scene_to_mjcf(geared.replace({"links.2.motor.stiffness": 100.0}))
    with pytest.raises(SceneError, match="act at once, and base torque x lags or delays"):
        scene_to_mjcf(geared.replace({"actuators.base_torque.delay": 1}))
    with pytest.raises(SceneError, match="it has no rotors, and link 'shoulder' has one"):
        scene_to_urdf(geared)
    rubbing = scene.replace({"links.1.motor": {"friction": 0.3}, "links.1.damping": 0.2})
    assert '<dynamics damping="0.2" friction="0.3" />' in scene_to_urdf(rubbing)
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(rubbing))
    assert model.dof_frictionloss.tolist() == [0.0] * 7 + [0.3] + [0.0] * 4


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_others_accelerate_the_same(name):
    check_accelerations(foreign_scene(name))


@pytest.mark.parametrize("name", ["planar", "tumbling", "no-wrist"])
def test_the_start_is_a_key_frame(name):
    scene = load_scene(name)
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene, wrist="fixed"))
    qpos, qvel, _ = mujoco_state(scene, StateLayout.of(scene).initial_state)
    key = model.key("start")
    sign = np.ones(model.nq)
    if not StateLayout.of(scene).planar and key.qpos[3] * qpos[3] < 0:
        sign[3:7] = -1.0
    np.testing.assert_allclose(key.qpos * sign, qpos, rtol=0, atol=1e-14)
    np.testing.assert_allclose(key.qvel, qvel, rtol=0, atol=1e-14)


def test_thrusters_without_a_limit_push_alone():
    scene = load_scene("thrusters")
    thrusters = [each.model_copy(update={"force": math.inf}) for each in scene.actuators.thrusters]
    scene = scene.replace({"actuators.thrusters": [each.model_dump() for each in thrusters]})
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene, wrist="fixed"))
    control = StateLayout.of(scene).control
    for name in control.names[control.thruster_force]:
        assert model.actuator(name).ctrllimited.all()
        assert model.actuator(name).ctrlrange.tolist() == [0.0, math.inf]


def test_motors_have_the_names_and_limits_of_the_inputs():
    scene = load_scene("six-joint")
    scene = scene.replace(actuators={"base_force": {"limit": float("inf")}})
    layout = StateLayout.of(scene)
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    assert [model.actuator(i).name for i in range(model.nu)] == list(layout.control.names)
    assert model.actuator_ctrllimited.astype(bool).tolist() == [False] * 3 + [True] * 9
    np.testing.assert_array_equal(model.actuator_ctrlrange[3:, 1], layout.control_limit[3:])
    assert model.opt.timestep == scene.simulation.dt
    assert not model.opt.gravity.any()


def test_shapes_are_seen_and_weigh_nothing():
    shapes = [
        {"box": [1, 2, 3], "pose": {"position": [0.1, 0.2, 0.3]}, "color": "#336699"},
        {"cylinder": {"radius": 0.2, "length": 3}, "pose": {"rotation": {"axis": [1, 0, 0], "angle": 30}}},
    ]
    scene = load_scene("payload")
    bodies = ("base", "links.0", "links.1", "links.2", "payload", "target")
    scene = scene.replace({f"{body}.geometry": shapes for body in bodies})
    check_accelerations(scene, samples=1)
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    named = [model.body(number).name for number in model.geom_bodyid[::2]]
    assert named == ["base", "link 1", "link 2", "link 3", "payload", "target"]
    np.testing.assert_allclose(model.geom_size[0], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(model.geom_size[3, :2], [0.2, 1.5])
    np.testing.assert_allclose(model.geom_pos[2], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.abs(model.geom_quat[5]), [np.cos(np.pi / 12), np.sin(np.pi / 12), 0, 0])
    np.testing.assert_allclose(model.geom_rgba[4], [0.2, 0.4, 0.6, 1.0], rtol=1e-6)
    assert not model.geom_contype.any()


DRAWN = ("paper", "planar", "payload", "six-joint", "dual-arm", "solar-panels", "heavy-wrist", "servicing")


@pytest.mark.parametrize("name", DRAWN)
def test_geoms_neither_weigh_nor_push(name):
    """Masses are the scene's to the bit, and without geoms nothing moves otherwise."""
    scene = load_scene(name)
    text = scene_to_mjcf(scene, wrist="fixed")
    model = mujoco.MjModel.from_xml_string(text)
    root = ElementTree.fromstring(text)
    for body in root.iter("body"):
        for geom in body.findall("geom"):
            body.remove(geom)
    bare = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    assert (model.ngeom > 0, bare.ngeom) == (True, 0)
    masses = {link.name: link.mass for link in scene.links} | {"base": scene.base.mass}
    assert {each: model.body(each).mass[0] for each in masses} == masses
    for each in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_array_equal(getattr(model, each), getattr(bare, each))
    rng = np.random.default_rng(1)
    rates, torques = rng.normal(size=model.nv), rng.normal(size=model.nu)
    found = []
    for each in (model, bare):
        data = mujoco.MjData(each)
        mujoco.mj_resetDataKeyframe(each, data, 0)
        data.qvel, data.ctrl = rates, torques
        for _ in range(20):
            mujoco.mj_step(each, data)
        found.append((data.qpos.copy(), data.ncon))
    assert found[0][1] == 0
    np.testing.assert_array_equal(found[0][0], found[1][0])


@pytest.mark.parametrize("name", DRAWN)
def test_rods_join_the_joints_and_the_camera_sees_arm_and_target(name):
    scene = load_scene(name)
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene, wrist="fixed"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    target = np.atleast_2d(shown_target(scene)[0])[0]
    rotation, position = poses.to_matrix(tuple(target))
    np.testing.assert_allclose(data.site("target").xpos, position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(data.site("target").xmat.reshape(3, 3), rotation, rtol=0, atol=1e-14)
    camera = data.camera("overview")
    joints = [data.body(link.name).xpos for link in scene.links]
    seen = np.array([data.site("tip").xpos, data.site("target").xpos, *joints]) - camera.xpos
    right, up, backward = (seen @ camera.xmat.reshape(3, 3)).T
    reach = np.tan(0.5 * np.radians(model.camera("overview").fovy[0]))
    assert (backward < 0.0).all()
    assert (np.abs(up / backward) < reach).all()
    assert (np.abs(right / backward) < 4.0 / 3.0 * reach).all()
    # Of a link without shapes some rod begins at its joint and ends at the joint of a link that it carries.
    for number, parent in enumerate(scene.parent_bodies):
        if parent == 0 or scene.links[parent - 1].geometry:
            continue
        name, start, end = scene.links[parent - 1].name, joints[parent - 1], joints[number]
        if np.linalg.norm(end - start) < 0.05:
            continue
        geoms = np.flatnonzero(model.geom_bodyid == model.body(name).id)
        ends = [
            data.geom_xpos[geom] + sign * model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2]
            for geom in geoms
            for sign in (-1.0, 1.0)
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER
        ]
        for place in (start, end):
            assert np.linalg.norm(np.array(ends) - place, axis=1).min() < 1e-12


PICTURE = """
import sys, mujoco
model = mujoco.MjModel.from_xml_string(sys.stdin.read())
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
mujoco.mj_forward(model, data)
try:
    renderer = mujoco.Renderer(model, 120, 160)
except Exception:
    sys.exit(3)
renderer.update_scene(data, camera="overview")
sys.stdout.buffer.write(renderer.render().tobytes())
"""


@pytest.mark.slow
def test_mujoco_draws_the_spacecraft_in_the_light():
    """The golden base and the white arm before a dark sky."""
    text = scene_to_mjcf(load_scene("no-wrist"))
    command = [sys.executable, "-c", PICTURE]
    surroundings = os.environ | {"MUJOCO_GL": "egl"}
    done = subprocess.run(command, input=text.encode(), capture_output=True, env=surroundings, check=False)
    if done.returncode:
        pytest.skip("no graphics for MuJoCo")
    red, green, blue = np.frombuffer(done.stdout, np.uint8).astype(int).reshape(-1, 3).T
    golden = (red > 120) & (red > blue + 60)
    white = (np.minimum(np.minimum(red, green), blue) > 110) & (red < blue + 25)
    dark = np.maximum(np.maximum(red, green), blue) < 60
    assert 0.03 < golden.mean() < 0.3
    assert white.mean() > 0.005
    assert dark.mean() > 0.5


def test_a_lamina_is_a_body_to_mujoco_too():
    """Its largest moment of inertia is the sum of the others, to the last digit; its axes lie askew."""
    scene = load_scene("no-wrist")
    turn = np.array(rotations.to_matrix(rotations.from_euler_321(0.3, -0.8, 1.1)))
    for a, b in ((0.3, 0.7), (0.1, 0.2), (1.3, 1e-3)):
        inertia = turn @ np.diag([a, b, a + b]) @ turn.T
        base = {"mass": 10.0, "inertia": inertia.tolist()}
        check_accelerations(scene.replace(base=base), samples=1)


def test_every_tip_holds_its_payload():
    scene = load_scene("dual-arm")
    held = {"mass": 30.0, "inertia": [1.0, 2.0, 2.5], "center_of_mass": [0.1, 0.0, 0.2]}
    scene = scene.replace({"other_tips.0.payload": held})
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    bodies = [scene.base, *scene.links, scene.other_tips[0].payload]
    total = math.fsum(body.mass for body in [*bodies, *([scene.payload] if scene.payload else [])])
    assert model.body_mass.sum() == pytest.approx(total, rel=1e-14)
    check_accelerations(scene, samples=2)


def test_links_may_be_called_as_bodies_of_mujoco():
    scene = load_scene("no-wrist").replace({"links.0.name": "world", "links.1.name": "world_"})
    check_accelerations(scene, samples=1)


def test_names_of_tips_are_not_given_twice():
    """Nor is the target's, which makes way for a link of this name."""
    tip = {"name": "target_", "link": "target", "goal": {}}
    scene = load_scene("no-wrist").replace(
        {"links.1.name": "target"}, other_tips=[tip, {**tip, "name": "base_"}]
    )
    mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    root = ElementTree.fromstring(scene_to_urdf(scene))
    names = [link.get("name") for link in root.findall("link")]
    assert len({*names}) == len(names) == 7


@pytest.mark.parametrize(
    ("name", "wrist", "sentence"),
    [
        ("release", "fixed", r"its robot stays as it is, and phases change payload.mass: set phases to \[\]"),
        ("paper", "refuse", r"written as MJCF:\n  - the wrist has joints without mass.*wrist='fixed'"),
        ("tip-load", "fixed", r"no constant wrench at the tip: set tip_wrench to null"),
        ("paper", "free", "wrist: 'free', it must be 'refuse' or 'fixed'"),
    ],
)
def test_what_mjcf_cannot_hold_is_refused(name, wrist, sentence):
    with pytest.raises((SceneError, ValueError), match=sentence):
        scene_to_mjcf(load_scene(name), wrist=wrist)


def test_phases_may_change_the_task_but_not_the_joints():
    scene = load_scene("no-wrist").replace({"links.0.damping": 0.5})
    half = {"steps": scene.simulation.steps // 2}
    phases = [{"name": "a", **half}, {"name": "b", **half, "changes": {"cost.pose": 3.0}}]
    assert scene_to_mjcf(scene.replace(phases=phases)) == scene_to_mjcf(scene)
    phases = [{"name": "a", **half}, {"name": "b", **half, "changes": {"links.0.damping": 50.0}}]
    with pytest.raises(SceneError, match=r"its robot stays as it is, and phases change links\.0\.damping"):
        scene_to_mjcf(scene.replace(phases=phases))
