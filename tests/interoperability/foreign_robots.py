"""Robots that others wrote, from packages on PyPI, and what the tests ask of any scene's robot."""

import warnings
from importlib.metadata import PackageNotFoundError, distribution
from xml.etree import ElementTree

import numpy as np
import pytest

from dq_space_arm_env import scene_from_urdf
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.task.equations import SceneEquations

AIRO, RTB, EXAMPLES = "airo-models", "rtb-data", "example-robot-data"
FOLDERS = {
    AIRO: "airo_models/arms",
    RTB: "rtbdata/xacro/kuka_description",
    EXAMPLES: "cmeel.prefix/share/example-robot-data/robots",
}
KINOVA_TIP = "j2s6s200_end_effector"
LOCKED = {"lock_branches": True}

BAXTER_LOCKED = [f"{side}_gripper_{finger}_finger_joint" for side in "lr" for finger in "lr"]
WITHOUT_EFFORT = {"joint_torque": 5.0}

# Name: package, path of the URDF in its folder, tip link, and arguments besides.
ROBOTS = {
    "ur3e": (AIRO, "ur3e/ur3e.urdf", "tool0", {}),
    "ur5e": (AIRO, "ur5e/ur5e.urdf", "tool0", {}),
    "kuka-kr16": (RTB, "kuka_kr16/urdf/kr16_2.urdf", "tool0", {"joint_torque": 500.0}),
    "panda": (EXAMPLES, "panda_description/urdf/panda.urdf", "panda_hand_tcp", LOCKED),
    "kinova": (EXAMPLES, "kinova_description/robots/kinova.urdf", KINOVA_TIP, {}),
    "ur5": (EXAMPLES, "ur_description/urdf/ur5_robot.urdf", "ee_link", {}),
    "xarm7": (EXAMPLES, "xarm_description/urdf/xarm7.urdf", "link_eef", {}),
    "talos-left-arm": (EXAMPLES, "talos_data/robots/talos_left_arm.urdf", "gripper_left_base_link", LOCKED),
    "anymal-kinova": (EXAMPLES, "anymal_b_simple_description/robots/anymal-kinova.urdf", KINOVA_TIP, LOCKED),
    # Arms that branch: two arms, a head, four legs, sliding torsos and fingers.
    "baxter": (
        EXAMPLES,
        "baxter_description/urdf/baxter.urdf",
        "left_gripper",
        {"lock_branches": BAXTER_LOCKED, **WITHOUT_EFFORT},
    ),
    "anymal-on-legs": (
        EXAMPLES,
        "anymal_b_simple_description/robots/anymal-kinova.urdf",
        KINOVA_TIP,
        WITHOUT_EFFORT,
    ),
    "centauro": (EXAMPLES, "centauro_description/urdf/centauro.urdf", "arm1_8", WITHOUT_EFFORT),
    "g1": (EXAMPLES, "g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_wrist_yaw_link", WITHOUT_EFFORT),
    "tiago-dual": (
        EXAMPLES,
        "tiago_description/robots/tiago_dual.urdf",
        "hand_left_grasping_frame",
        WITHOUT_EFFORT,
    ),
    "borinot": (EXAMPLES, "borinot_description/urdf/borinot_flying_arm_2.urdf", "flying_arm_2__ee", {}),
}


def robot_file(name):
    """Path, tip and arguments of a robot; skips the test where its package is not installed."""
    package, path, tip, arguments = ROBOTS[name]
    try:
        file = distribution(package).locate_file(f"{FOLDERS[package]}/{path}")
    except PackageNotFoundError:
        pytest.skip(f"needs {package}")
    return str(file), tip, arguments


def held_scene(name, moving):
    """The scene of a robot of which, beside the way from base to tip, only these joints move."""
    file, tip, _ = robot_file(name)
    joints = ElementTree.parse(file).getroot().findall("joint")
    before = {joint.find("child").get("link"): joint for joint in joints}
    link, free = tip, [*moving]
    while link in before:
        free.append(before[link].get("name"))
        link = before[link].find("parent").get("link")
    movable = [each.get("name") for each in joints if each.get("type") not in ("fixed", "floating")]
    return foreign_scene(name, lock_branches=[each for each in movable if each not in free])


def foreign_scene(name, **others):
    """The scene of a robot; friction that is left out and inertias of no body come with a warning."""
    file, tip, arguments = robot_file(name)
    arguments = {**arguments, **others}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(Coulomb friction|used as it is)")
        return scene_from_urdf(file, tip, **arguments)


def drawn(scene, rng):
    """A random state (any attitude, meters, radians, about 1 rad/s) and random inputs."""
    layout = StateLayout.of(scene)
    x = rng.normal(size=layout.n_x)
    rotation, position = rng.normal(size=4), rng.normal(size=3)
    rotation[0] = abs(rotation[0])
    if layout.planar:
        rotation[1:3], position[2] = 0.0, 0.0
    rotation /= np.linalg.norm(rotation)
    pose = np.array(poses.from_rotation_and_position(tuple(rotation), tuple(position)))
    x[layout.state.pose] = pose[[0, 3, 5, 6]] if layout.planar else pose
    return x, rng.normal(size=layout.n_u)


def accelerations(scene, x, u):
    """Accelerations of base and joints by the scene's own equations."""
    equations = SceneEquations.of(scene, StateLayout.of(scene).parameters.nominal.tolist())
    return np.array(equations.field.accelerations(equations.y(x.tolist()), u.tolist()), dtype=float)


def tip_pose(scene, x):
    """Rotation matrix and position of the tip, by the scene's own equations."""
    rotation, position = poses.to_matrix(
        SceneEquations.of(scene, StateLayout.of(scene).parameters.nominal.tolist()).tip(x.tolist())
    )
    return np.array(rotation), np.array(position)


def relative_error(found, expected):
    return np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected)
