"""Scene from a URDF file: its arm on a free spacecraft, with default actuators and target."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import SCREWS, KinematicTree
from dq_space_arm_env.dynamics.step_stability import stable
from dq_space_arm_env.interoperability.rigid_body import Body, lumped, tidied
from dq_space_arm_env.interoperability.urdf_arm import Arm, ArmJoint, arm_of
from dq_space_arm_env.interoperability.urdf_elements import Pose, UrdfJoint, read_robot
from dq_space_arm_env.scene import Cost, Scene, SceneError
from dq_space_arm_env.scene.bodies import BASE, Inertia
from dq_space_arm_env.validation import Model, Positive, Vector3

# Angle from the start of every joint at the default target, rad.
_TARGET_OFFSET = 0.3
# Angle by which every joint of an arm that would begin in a singular pose is bent, rad.
_BEND = 0.5
# Smallest singular value of the tip's Jacobian, relative to the largest, below which a pose is singular.
_SINGULAR = 0.01
# Natural frequency of the joint that is the hardest to move under the default cost, rad/s.
_FREQUENCY = 0.7
_ANY_ANGLE = (-math.inf, math.inf)


def scene_from_urdf(
    source: str | Path,
    tip: str,
    base: str | None = None,
    *,
    name: str | None = None,
    spacecraft: Mapping[str, Any] | None = None,
    base_force: float | Sequence[float] | None = 10.0,
    base_torque: float | Sequence[float] | None = 5.0,
    joint_torque: float | None = None,
    passive: Collection[str] = (),
    lock_branches: bool | Collection[str] = False,
    target: Mapping[str, Any] | None = None,
) -> Scene:
    """Make a scene of a robot's URDF, free in space: the arm from base link to tip link, and its branches.

    Revolute, continuous, prismatic and fixed joints are supported. Fixed bodies are lumped into those that
    carry them; links without mass are mere frames. Each link of the scene is named after the link that its
    joint carries; the links from base to tip come first, then those of the other branches.

    Frames: the scene's base frame e0 has the axes of the base link and its origin at the center of mass of
    the base and of all that is fixed to it; the scene's description says where that is in the base link. The
    frame of a scene's joint has its z axis along the joint's axis; where the URDF has another axis, it is the
    child link's frame turned. The tip frame G is the tip link's. Joint angles are the URDF's.

    The efforts of the URDF limit the joint torques; its limits of angles and rates become the constraint
    `joint limits`, which the expert keeps to. Equal limits of 0 and rates of 0 are placeholders and limit
    nothing, as limits of 1e4 rad, rad/s or N m and more. Shapes and meshes, transmissions and simulator
    settings are left out, Coulomb friction with a warning. Start: at rest, the base link's axes along the
    inertial ones, joints at zero, or midway between limits that exclude zero; an arm that is singular there,
    as a straight one, begins with every joint bent by 0.5 rad.
    Cost: the defaults, but with a weight of the joint torques that lets an arm of any size move within
    seconds. Integrator: `rk4`, or `rodas4` for dampers too stiff for it. Change anything else with
    `scene.replace(...)`.

    Args:
        source: Path of a URDF file, or its text, which begins with "<"; xacro has to be expanded before.
        tip: Name of the link whose frame is to reach the target.
        base: Name of the link that is the spacecraft; the root of the URDF by default.
        name: Name of the scene; the robot's by default.
        spacecraft: A body that is fixed to the base link, besides the link's own mass: `mass` in kg,
            `inertia` about its center of mass in kg m^2, 3 numbers (diagonal) or 3x3, and `center_of_mass` in
            m, by default (0, 0, 0); axes and origin are the base link's. None for no such body.
        base_force: Limit of the thrusters' force on the base, N, for each axis or one for all; None for no
            thrusters.
        base_torque: Limit of the wheels' torque on the base, N m, for each axis or one for all; None for no
            wheels.
        joint_torque: Limit of the joints for which the URDF gives no effort, or zero, N m (N of slides).
        passive: Names of the joints that have no motor.
        lock_branches: Names of movable joints beside the way from base to tip, as those of a gripper or of
            another arm, that are held at zero; True for all of them. Others that move a mass are joints of
            the scene.
        target: Pose of the target as in a scene, {"position": ..., "rotation": ...} in m; by default the pose
            of the tip at the start but with every joint 0.3 rad further, or back where its limits ask for it.

    Returns:
        The scene.

    Raises:
        SceneError: If the file cannot be read, a scene cannot represent the robot, or an argument is wrong;
            the message names the link or joint and the remedy.
    """
    robot = read_robot(source)
    extra = None if spacecraft is None else _spacecraft(spacecraft)
    if isinstance(lock_branches, str):
        raise SceneError(f"lock_branches = {lock_branches!r}: must be a list of names of joints, or True")
    if joint_torque is not None and not (isinstance(joint_torque, int | float) and joint_torque > 0):
        raise SceneError(f"joint_torque = {joint_torque!r}: must be a number greater than 0, N m")
    arm = arm_of(robot, tip, base, lock_branches, extra)
    _check_passive(arm, passive)
    _warn(arm)
    angles = _start(arm)
    center = ", ".join(f"{number:.9g}" for number in arm.base_center)
    data: dict[str, Any] = {
        "name": robot.name if name is None else name,
        "description": f"From the URDF of {robot.name}: base frame at ({center}) m in link {arm.base_link}.",
        "base": {"mass": arm.base.mass, "inertia": tidied(arm.base.inertia).tolist()},
        "links": _links(arm, joint_torque, passive),
        "tip_link": None if arm.way == len(arm.joints) else arm.joints[arm.way - 1].joint.child,
        "tip": _pose(arm.tip),
        "actuators": {
            "base_force": None if base_force is None else {"limit": base_force},
            "base_torque": None if base_torque is None else {"limit": base_torque},
            "joint_torque": _motors(arm, joint_torque, passive),
        },
        "cost": {"joint_torque": _torque_weight(arm, angles)},
        "initial_state": {"joint_angles": angles},
        "target": {"pose": {} if target is None else target},
        "constraints": _joint_limits(arm),
    }
    scene = stable(_validated(data, robot.name))
    return scene if target is not None else scene.replace(target={"pose": _default_target(scene, arm)})


class _Spacecraft(Model):
    """The spacecraft that carries the arm, and is not in the robot's file."""

    mass: Positive = Field(description="mass of the spacecraft, kg")
    inertia: Inertia = Field(
        description="inertia of the spacecraft about its center of mass, axes of the base link, kg m^2: 3 "
        "numbers (diagonal) or 3x3"
    )
    center_of_mass: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="center of mass of the spacecraft in the base link's frame, m"
    )


def _spacecraft(fields: Mapping[str, Any]) -> Body:
    if not isinstance(fields, Mapping):
        raise SceneError(f"spacecraft = {fields!r}: must be a mapping, {{'mass': ..., 'inertia': ...}}")
    try:
        body = _Spacecraft.model_validate(dict(fields))
    except ValidationError as error:
        raise SceneError("\n  - ".join(["spacecraft:", *_messages(error)])) from error
    return Body(body.mass, np.array(body.center_of_mass), np.array(body.inertia))


def _check_passive(arm: Arm, passive: Collection[str]) -> None:
    if isinstance(passive, str):
        raise SceneError(f"passive = {passive!r}: must be a list of names of joints")
    joints = [part.joint.name for part in arm.joints]
    unknown = [name for name in passive if name not in joints]
    if unknown:
        raise SceneError(
            f"passive: {unknown[0]!r} is not a joint that moves a mass; these are {', '.join(joints)}"
        )


def _validated(data: dict[str, Any], robot: str) -> Scene:
    try:
        return Scene.model_validate(data)
    except ValidationError as error:
        names = [f"links[{index}] is {link['name']!r}" for index, link in enumerate(data["links"])]
        problems = [*_messages(error), *(text for text in names if text.split()[0] in str(error))]
        raise SceneError("\n  - ".join([f"URDF of {robot!r}:", *problems])) from error


def _messages(error: ValidationError) -> list[str]:
    return [detail["msg"] for detail in error.errors(include_url=False)]


def _warn(arm: Arm) -> None:
    """Warn of Coulomb friction, and of impossible inertias that fixed neighbors make up for."""
    rubbing = [part.joint.name for part in arm.joints if part.joint.friction]
    if rubbing:
        warnings.warn(
            f"URDF: Coulomb friction of {', '.join(rubbing)} is left out: `motor.friction` of a link adds it",
            stacklevel=3,
        )
    for flaw in arm.flaws:
        warnings.warn(
            f"URDF: {flaw}; it is used as it is: the bodies that the link is fixed to make up for it",
            stacklevel=3,
        )


def _torque_weight(arm: Arm, angles: Sequence[float]) -> float:
    """Weight of the joint torques with which the arm takes seconds.

    The optimal regulator of an inertia I with the damping c and the cost a theta^2 + b tau^2 moves within
    1 / omega where a / b = omega^2 (I^2 omega^2 + c^2): without damper omega is its natural frequency,
    without inertia its decay. Turned by theta, a tip at distance d costs a = w (1 + d^2) / 4, w the pose's
    weight; moved along a slide, a = w / 4.
    """
    tip, largest = arm.tip, (0.0, 0.0)
    carried: list[list[Body]] = [[] for _ in range(len(arm.joints) + 1)]
    for index, (part, angle) in reversed([*enumerate(zip(arm.joints, angles, strict=True))]):
        moved = lumped([*carried[index + 1], part.body])
        assert moved is not None
        carried[part.parent].append(moved.seen_from(_displaced(part, angle)))
        if index >= arm.way:
            continue
        x, y, _ = moved.center_of_mass
        distance = math.dist(poses.to_rotation_and_position(tip)[1], (0.0, 0.0, 0.0))
        inertia, lever = float(moved.inertia[2, 2] + moved.mass * (x * x + y * y)), 1.0 + distance**2
        if part.joint.slides:
            inertia, lever = moved.mass, 1.0
        largest = max(largest, (math.hypot(inertia * _FREQUENCY, part.joint.damping), lever))
        tip = tuple(dual_quaternion.multiply(_displaced(part, angle), tip))
    impedance, lever = largest  # N m s/rad or N s/m; 1 + d^2
    return float(f"{0.25 * Cost().pose[0] * lever / (impedance * _FREQUENCY) ** 2:.2g}")


def _displaced(part: ArmJoint, coordinate: float) -> Pose:
    """Pose of a joint's frame, turned or slid by its coordinate, in the frame before."""
    motion = kinematics.joint_motion(SCREWS[_joint_type(part.joint)], coordinate)
    return tuple(dual_quaternion.multiply(part.pose, motion))


def _joint_type(joint: UrdfJoint) -> str:
    return "prismatic" if joint.slides else "revolute"


def _motors(arm: Arm, joint_torque: float | None, passive: Collection[str]) -> dict[str, Any] | None:
    """The scene's joint motors; each link also has its own limit."""
    driven = [part.joint for part in arm.joints if part.joint.name not in passive]
    unlimited = [joint.name for joint in driven if joint.effort is None]
    if unlimited and joint_torque is None:
        raise SceneError(
            f"URDF: no effort limit for joint {', '.join(unlimited)}: give joint_torque, N m, for all joints "
            "without one, or name those without a motor in passive"
        )
    if not driven:
        return None
    limits = [limit for joint in driven if (limit := joint.effort or joint_torque) is not None]
    return {"limit": max(limits)}


def _joint_limits(arm: Arm) -> list[dict[str, Any]]:
    """The scene's constraint of joint angles and rates, if there are limits."""
    joints = [part.joint for part in arm.joints]
    for joint in joints:
        if joint.limits is not None and joint.limits[0] == joint.limits[1]:
            raise SceneError(
                f"URDF: joint {joint.name!r}: lower = upper = {joint.limits[0]:g} {joint.unit}, it cannot "
                "move: make it fixed, or give it a range"
            )
    lower, upper = zip(*(joint.limits or _ANY_ANGLE for joint in joints), strict=True)
    bounds = {"lower": lower, "upper": upper, "rate": tuple(joint.rate for joint in joints)}
    finite = {name: limits for name, limits in bounds.items() if any(map(math.isfinite, limits))}
    return [{"name": "joint limits", "kind": "joint_limits", **finite}] if finite else []


def _links(arm: Arm, joint_torque: float | None, passive: Collection[str]) -> list[dict[str, Any]]:
    """The scene's links; of those right after their parents nothing is said."""
    names = [BASE, *(part.joint.child for part in arm.joints)]
    return [
        _link(part, joint_torque, passive) | ({} if part.parent == index else {"parent": names[part.parent]})
        for index, part in enumerate(arm.joints)
    ]


def _link(part: ArmJoint, joint_torque: float | None, passive: Collection[str]) -> dict[str, Any]:
    joint = part.joint
    driven = joint.name not in passive
    return {
        "name": joint.child,
        "mass": part.body.mass,
        "inertia": tidied(part.body.inertia).tolist(),
        "center_of_mass": tidied(part.body.center_of_mass).tolist(),
        "joint": _pose(part.pose),
        "joint_type": _joint_type(joint),
        "actuated": driven,
        "torque_limit": (joint.effort or joint_torque) if driven else None,
        "damping": joint.damping,
    }


def _pose(pose: Pose) -> dict[str, Any]:
    rotation, position = poses.to_rotation_and_position(pose)
    return {"position": tidied(np.array(position)).tolist(), "rotation": tidied(np.array(rotation)).tolist()}


def _start(arm: Arm) -> list[float]:
    """Angles at the start, rad: at rest, or bent where that is singular and helps.

    In a straight arm several joints do the same and none moves the tip along it: to first order the cost does
    not tell which way to bend, and the solver creeps.
    """
    at_rest = [_at_rest(part.joint) for part in arm.joints]
    bent = [*(_bent(part.joint) for part in arm.joints[: arm.way]), *at_rest[arm.way :]]
    return bent if _dexterity(arm, at_rest) < _SINGULAR < _dexterity(arm, bent) else at_rest


def _at_rest(joint: UrdfJoint) -> float:
    """Zero where the limits allow it, or midway between them; at the one that there is."""
    lower, upper = joint.limits or _ANY_ANGLE
    middle = 0.5 * (lower + upper)
    return min(max(0.0, lower), upper) if lower <= 0.0 <= upper or math.isinf(middle) else middle


def _moved(joint: UrdfJoint, angle: float, step: float) -> float | None:
    """An angle and a step, upward where the limits allow it; None if they allow neither."""
    lower, upper = joint.limits or _ANY_ANGLE
    return next((turned for turned in (angle + step, angle - step) if lower <= turned <= upper), None)


def _bent(joint: UrdfJoint) -> float:
    """Angle at rest and the bend, where the limits allow it; a slide does not bend."""
    angle = _at_rest(joint)
    if joint.slides:
        return angle
    bent = _moved(joint, angle, _BEND)
    return angle if bent is None else bent


def _dexterity(arm: Arm, angles: Sequence[float]) -> float:
    """Smallest singular value of the tip's Jacobian on a fixed base, relative to the largest.

    Lengths are in units of the largest distance from a joint to the tip.
    """
    frame: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    axes, origins = [], []
    way = arm.joints[: arm.way]
    slides = np.array([part.joint.slides for part in way])
    for part, angle in zip(way, angles, strict=False):
        frame = tuple(dual_quaternion.multiply(frame, _displaced(part, angle)))
        rotation, position = poses.to_matrix(frame)
        axes.append([row[2] for row in rotation])
        origins.append(position)
    tip = poses.to_matrix(tuple(dual_quaternion.multiply(frame, arm.tip)))[1]
    levers = np.array(tip) - np.array(origins)
    reach = float(np.linalg.norm(levers, axis=1).max()) or 1.0
    turning = np.where(slides[:, None], 0.0, axes)
    moving = np.where(slides[:, None], axes, np.cross(axes, levers)) / reach
    values = np.linalg.svd(np.hstack([turning, moving]), compute_uv=False)
    return float(values[-1] / values[0])


def _default_target(scene: Scene, arm: Arm) -> dict[str, Any]:
    """Pose of the tip with every joint moved by the offset, or halfway to the farther limit."""
    start, angles = scene.initial_state, []
    for part, angle in zip(arm.joints, start.joint_angles, strict=True):
        moved = _moved(part.joint, angle, _TARGET_OFFSET)
        if moved is None:
            farther = max(part.joint.limits or _ANY_ANGLE, key=lambda limit: abs(limit - angle))
            moved = 0.5 * (angle + farther)
        angles.append(moved)
    pose = kinematics.tip_pose(KinematicTree.from_scene(scene), start.base_pose.dual_quaternion, angles, ())
    return _pose(tuple(pose))
