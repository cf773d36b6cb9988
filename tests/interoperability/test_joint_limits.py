"""Joint limits from URDF, to URDF and to MJCF, against Pinocchio's and MuJoCo's own reading."""

import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import SceneError, load_scene, scene_from_urdf, scene_to_mjcf, scene_to_urdf
from dq_space_arm_env.interoperability.exporting import joint_limits

ARMS = {
    "borinot-arm": "flying_arm_2__ee",
    "bravo7": "contact_point",
    "kinova-j2s6s200": "j2s6s200_end_effector",
    "panda": "panda_hand_tcp",
    "so100": "gripper",
    "ur10": "tool0",
    "widowx": "gripper_rail_link",
    "z1": "link06",
}
"""Files in `arms`, and their tips."""
SPACECRAFT = {"mass": 80, "inertia": [8, 8, 6]}
BODY = (
    '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
)
INF = math.inf
# One-sided limits, none, rates of some; two constraints, of which the tighter counts.
CONSTRAINTS = [
    {"kind": "joint_limits", "name": "a", "lower": [-1.1, -INF, -INF], "upper": [2.2, 0.7, INF], "rate": 0.9},
    {
        "kind": "joint_limits",
        "name": "b",
        "lower": [-INF, -0.1, -INF],
        "rate": [0.4, INF, INF],
        "margin": 0.1,
    },
]
TIGHTEST = [(-1.1, 2.2, 0.4), (-0.1, 0.7, 0.9), (-INF, INF, 0.9)]


def arm(*limits, kind="revolute"):
    """A chain with a joint for each <limit>."""
    text = f'<link name="link 0">{BODY}'
    for i, limit in enumerate(limits, 1):
        ends = f'<parent link="link {i - 1}"/><child link="link {i}"/><origin xyz="1 0 0"/>'
        text += f'<joint name="j{i}" type="{kind}">{ends}{limit}</joint><link name="link {i}">{BODY}'
    return f'<robot name="r">{text}</robot>'


def limit(lower=None, upper=None, velocity=None):
    given = {"lower": lower, "upper": upper, "velocity": velocity}
    words = [f'{name}="{value}"' for name, value in given.items() if value is not None]
    return f'<limit effort="1" {" ".join(words)}/>'


def imported(name):
    """Text and scene of an arm of others."""
    text = (Path(__file__).parent / "arms" / f"{name}.urdf").read_text(encoding="utf-8")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(Coulomb friction|used as it is)")
        return text, scene_from_urdf(text, ARMS[name], spacecraft=SPACECRAFT, joint_torque=5.0)


def test_limits_become_a_constraint():
    scene = scene_from_urdf(arm(limit(-1, 2, 3), limit(0.5, 0.7), limit(-5, 1, 0)), "link 3")
    (found,) = scene.constraints
    assert (found.kind, found.name) == ("joint_limits", "joint limits")
    assert (found.lower, found.upper) == ((-1.0, 0.5, -5.0), (2.0, 0.7, 1.0))
    assert found.rate == (3.0, INF, INF)
    assert (found.margin, found.terminates, found.observed) == (0.0, False, None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (arm(limit(0, 0, 0)), None),  # placeholders
        (arm(limit()), None),
        (arm(limit(-1e9, 2e4, 10000)), None),
        (arm(limit(-1e16, "1.79769e+308", "1.79769e+308")), None),
        (arm(limit(-1, 2, 0), kind="continuous"), None),  # a continuous joint has no range
        (arm(limit(0, 0, 2)), (-INF, INF, 2.0)),
        (arm(limit(-1, 2, 1.5), kind="continuous"), (-INF, INF, 1.5)),
        (arm(limit(-3, 1e5)), (-3.0, INF, INF)),
    ],
)
def test_placeholders_limit_nothing(text, expected):
    scene = scene_from_urdf(text, "link 1")
    assert bool(scene.constraints) == (expected is not None)
    assert joint_limits(scene) == [expected or (-INF, INF, INF)]


@pytest.mark.parametrize(
    ("limit", "sentence"),
    [
        (limit(1, -1), "joint 'j1': lower = 1 rad is greater than upper = -1 rad"),
        (
            limit(0.3, 0.3),
            r"joint 'j1': lower = upper = 0.3 rad, it cannot move: make it fixed, or give it a",
        ),
        (limit(0, 1, -2), "joint 'j1': velocity = -2 rad/s, it must be 0 or greater"),
        (limit(0, "inf"), "joint 'j1', <limit>: upper = 'inf', it must be a finite number"),
        (limit(0, 1, "nan"), "joint 'j1', <limit>: velocity = 'nan', it must be a finite number"),
    ],
)
def test_impossible_limits_are_refused(limit, sentence):
    with pytest.raises(SceneError, match=sentence):
        scene_from_urdf(arm(limit), "link 1")


@pytest.mark.parametrize(
    ("given", "start", "target"),
    [
        (limit(-3, 3), 0.0, 0.3),
        (limit(0, 3), 0.2, 0.5),  # off the stop
        (limit(-3, 0), -0.2, -0.5),
        (limit(-0.1, 3), 0.1, 0.4),
        (limit(1, 2), 1.5, 1.8),
        (limit(-0.1, 0.2), 0.05, 0.125),  # midway; from there halfway to a limit
        (limit(0.5, 1e6), 0.7, 1.0),
        (limit(-1e6, -0.5), -0.7, -1.0),
    ],
)
def test_start_and_target_lie_within_the_limits(given, start, target):
    """The chain's axis is x, along which its links follow each other: the target's turn is the joint's."""
    scene = scene_from_urdf(arm(given), "link 1")
    assert scene.initial_state.joint_angles == (pytest.approx(start, abs=1e-15),)
    turn = scene.target.pose.rotation_matrix
    assert math.atan2(turn[2][1], turn[1][1]) == pytest.approx(target, abs=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_arms_of_others_have_the_limits_that_pinocchio_reads(name):
    pin = pytest.importorskip("pinocchio")
    text, scene = imported(name)
    model = pin.buildModelFromXML(text)
    children = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    for link, found in zip(scene.links, joint_limits(scene), strict=True):
        joint = model.joints[children[link.name]]
        rate = model.velocityLimit[joint.idx_v]
        expected = (-INF, INF)
        if joint.nq == 1:
            expected = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        np.testing.assert_allclose(found, [*expected, rate if rate < 1e4 else INF], rtol=1e-12)
    for limits, angle in zip(joint_limits(scene), scene.initial_state.joint_angles, strict=True):
        assert limits[0] <= angle <= limits[1]


@pytest.mark.parametrize("name", ARMS)
def test_limits_survive_the_way_out_and_in_again(name):
    _, scene = imported(name)
    again = scene_from_urdf(scene_to_urdf(scene), "tip")
    assert joint_limits(again) == joint_limits(scene)
    np.testing.assert_allclose(again.initial_state.joint_angles, scene.initial_state.joint_angles)


@pytest.fixture(scope="module")
def limited():
    """A scene with limits of every sort, and a motor of any torque."""
    links = [{**link.model_dump(), "torque_limit": None} for link in load_scene("no-wrist").links]
    return load_scene("no-wrist").replace(constraints=CONSTRAINTS, links=links)


def test_the_tightest_limits_are_written(limited):
    assert joint_limits(limited) == TIGHTEST
    unlimited = limited.replace(actuators={"joint_torque": {"limit": INF}})
    for scene, more in ((limited, {}), (unlimited, {"joint_torque": 1.0})):
        assert joint_limits(scene_from_urdf(scene_to_urdf(scene), "tip", **more)) == TIGHTEST


@pytest.mark.parametrize("write", [scene_to_urdf, scene_to_mjcf])
def test_constraints_that_leave_no_range_are_refused(write, limited):
    """MuJoCo would ignore the range, and our own reader refuse it."""
    constraints = [*CONSTRAINTS, {"kind": "joint_limits", "name": "c", "lower": [2.5, -INF, -INF]}]
    sentence = "limit joint 'link 1' to 2.5 rad or more and to 2.2 rad or less, which leaves it no range"
    with pytest.raises(SceneError, match=sentence):
        write(limited.replace(constraints=constraints))


def test_large_limits_are_written_as_they_are(limited):
    """Also those that an import takes for placeholders; 1e4 stands for none."""
    limits = {"kind": "joint_limits", "name": "a", "lower": [-INF, -2e4, -1], "rate": [3e4, 1, INF]}
    efforts = {"links.0.torque_limit": 5e4, "links.1.torque_limit": INF}
    text = scene_to_urdf(limited.replace({"constraints": [limits], **efforts}))
    assert re.findall("<limit .*>", text) == [
        '<limit effort="50000" velocity="30000" />',
        '<limit effort="10000" velocity="1" lower="-20000" upper="10000" />',
        '<limit effort="2" velocity="10000" lower="-1" upper="10000" />',
    ]


def test_pinocchio_reads_the_limits(limited):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(scene_to_urdf(limited))
    assert [joint.nq for joint in model.joints][1:] == [1, 1, 2]  # the last one is continuous
    np.testing.assert_array_equal(model.lowerPositionLimit[:2], [-1.1, -0.1])
    np.testing.assert_array_equal(model.upperPositionLimit[:2], [2.2, 0.7])
    np.testing.assert_array_equal(model.velocityLimit, [0.4, 0.9, 0.9])


def test_mujoco_reads_the_limits(limited):
    mujoco = pytest.importorskip("mujoco")
    constraints = [*CONSTRAINTS, {"kind": "joint_limits", "name": "c", "lower": [-INF, -INF, -3]}]
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(limited.replace(constraints=constraints)))
    assert model.jnt_limited.tolist() == [0, 1, 1, 1]
    np.testing.assert_array_equal(model.jnt_range[1:], [[-1.1, 2.2], [-0.1, 0.7], [-3.0, INF]])
    data = mujoco.MjData(model)
    for angle, pushed in ((0.2, False), (2.5, True)):
        data.qpos[7] = angle
        mujoco.mj_forward(model, data)
        assert (data.qfrc_constraint[6] < 0.0) == pushed
        assert np.isfinite(data.qacc).all()


def test_mujoco_too_ignores_equal_limits(tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)  # where it logs its warning
    model = mujoco.MjModel.from_xml_string(arm(limit(0, 0, 1), limit(-1, 1, 1)))
    assert model.jnt_limited.tolist() == [0, 1]


def test_limits_name_no_frames():
    """A link of an imported arm may be called as one of the frames that other constraints name."""
    text = arm(limit(-1, 1)).replace('"link 1"', '"tip"')
    assert joint_limits(scene_from_urdf(text, "tip")) == [(-1.0, 1.0, INF)]
