"""Scene from a URDF file: its arm on a free spacecraft, with default actuators and target."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from dq_space_arm_env.dynamics.step_stability import stable
from dq_space_arm_env.interoperability.first_maneuver import (
    ANY_ANGLE,
    default_target,
    start_angles,
    with_scaled_limits,
    with_torque_weights,
    written_pose,
)
from dq_space_arm_env.interoperability.rigid_body import Body, tidied
from dq_space_arm_env.interoperability.urdf_arm import HERE, Arm, ArmJoint, arm_of, missing_efforts
from dq_space_arm_env.interoperability.urdf_elements import UNLIMITED, read_robot, without_effort
from dq_space_arm_env.scene import Pose, Scene, SceneError
from dq_space_arm_env.scene.bodies import BASE, Inertia
from dq_space_arm_env.validation import Model, Positive, Vector3


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
    balance_inertias: bool = False,
    dampers: bool = True,
    scaled_efforts: bool = False,
) -> Scene:
    """Make a scene of a robot's URDF, free in space: the arm from base link to tip link, and its branches.

    Revolute, continuous, prismatic and fixed joints are supported. Fixed bodies are lumped into those that
    carry them; links without mass are mere frames. Each link of the scene is named after the link that its
    joint carries; the links from base to tip come first, then those of the other branches.

    Frames: the scene's base frame e0 has the axes of the spacecraft, by default those of the base link, and
    its origin at the center of mass of all that is fixed to it; the scene's description says where. The
    frame of a scene's joint has its z axis along the joint's axis; where the URDF has another axis, it is the
    child link's frame turned. The tip frame G is the tip link's. Joint angles are the URDF's.

    The efforts of the URDF limit the joint torques; its limits of angles and rates become the constraint
    `joint limits`, which the expert keeps to. Equal limits of 0 and rates of 0 are placeholders and limit
    nothing, as limits of 1e4 rad, rad/s or N m and more. Shapes and meshes, transmissions and simulator
    settings are left out, Coulomb friction with a warning. Start: at rest, the base link's axes along the
    inertial ones, joints at zero but off their stops, or midway between limits that exclude zero; an arm that
    is singular there, as a straight one, begins with every joint bent by 0.5 rad.
    Cost: the defaults, but each joint has a weight of its torque that lets an arm of any size move within
    seconds. Integrator: `rk4`, or `rodas4` for dampers too stiff for it. Change anything else with
    `scene.replace(...)`.

    Args:
        source: Path of a URDF file, or its text, which begins with "<"; xacro has to be expanded before.
        tip: Name of the link whose frame is to reach the target.
        base: Name of the link that is the spacecraft; the root of the URDF by default.
        name: Name of the scene; the robot's by default.
        spacecraft: A body that is fixed to the base link, besides the link's own mass: `mass` in kg,
            `inertia` about its center of mass in kg m^2, 3 numbers (diagonal) or 3x3, `center_of_mass` in m,
            by default (0, 0, 0), and `mount`, the pose of the base link in the spacecraft's frame, as in a
            scene, by default the identity. None for no such body.
        base_force: Limit of the thrusters' force on the base, N, for each axis or one for all; None for no
            thrusters.
        base_torque: Limit of the wheels' torque on the base, N m, for each axis or one for all; None for no
            wheels.
        joint_torque: Limit of the joints for which the URDF gives no effort, or zero, N m (N of slides). None
            refuses such joints, unless `scaled_efforts` finds limits for them.
        passive: Names of the joints that have no motor.
        lock_branches: Names of movable joints beside the way from base to tip, as those of a gripper or of
            another arm, that are held at zero, or the limit nearest to it; what mimics another follows it.
            True for all of them. Others that move a mass are joints of the scene.
        target: Pose of the target as in a scene, {"position": ..., "rotation": ...} in m; by default the pose
            of the tip at the start but with every joint 0.3 rad further, or back where its limits ask for it.
        balance_inertias: Whether to mend inertias that violate the triangle inequality, with a warning, by
            raising the smallest principal moment; otherwise they are refused.
        dampers: Whether to keep the viscous damping of the joints.
        scaled_efforts: Whether to lower the URDF's limits of the torques to three times what a swing of all
            joints by 1 rad in seconds takes, and to give these to joints without; `joint_torque` stays.
            Efforts for work against gravity are hundreds of times that.

    Returns:
        The scene.

    Raises:
        SceneError: If the file cannot be read, a scene cannot represent the robot, or an argument is wrong;
            the message names the link or joint and the remedy.
    """
    robot = read_robot(source)
    extra, mount = (None, HERE) if spacecraft is None else _spacecraft(spacecraft)
    if isinstance(lock_branches, str) or not isinstance(lock_branches, bool | Collection):
        raise SceneError(f"lock_branches = {lock_branches!r}: must be a list of names of joints, or True")
    is_number = isinstance(joint_torque, int | float | np.number) and joint_torque is not True
    if joint_torque is not None and not (is_number and joint_torque > 0):
        raise SceneError(f"joint_torque = {joint_torque!r}: must be a number greater than 0, N m")
    kept = without_effort(robot) if joint_torque is not None else []
    if joint_torque is None and scaled_efforts:
        joint_torque = UNLIMITED  # which is lowered
    motorless = passive if joint_torque is None else robot.joints
    arm = arm_of(robot, tip, base, lock_branches, extra, mount, balance_inertias, motorless)
    _check_passive(arm, passive)
    _warn(arm)
    tip_link = None if arm.way == len(arm.joints) else arm.joints[arm.way - 1].joint.child
    if BASE in (part.joint.child for part in arm.joints):
        raise SceneError(
            f"URDF: link {BASE!r}, which a joint moves, has the name of a scene's spacecraft: rename it"
        )
    center = ", ".join(f"{round(float(number), 6) + 0.0:.6g}" for number in arm.base_center)
    frame = f"link {arm.base_link}" if mount == HERE else "the spacecraft"
    fixed = f"link {arm.base_link}" if extra is None else f"spacecraft and link {arm.base_link}"
    data: dict[str, Any] = {
        "name": robot.name if name is None else name,
        "description": f"From the URDF of {robot.name}: the base frame, at the center of mass of {fixed}, is "
        f"at ({center}) m in {frame}.",
        "base": {"mass": _rounded(arm.base.mass), "inertia": tidied(arm.base.inertia).tolist()},
        "links": _links(arm, joint_torque, passive, dampers),
        "tip_link": tip_link,
        "tip": written_pose(arm.tip),
        "actuators": {
            "base_force": None if base_force is None else {"limit": base_force},
            "base_torque": None if base_torque is None else {"limit": base_torque},
            "joint_torque": _motors(arm, joint_torque, passive),
        },
        "initial_state": {"joint_angles": start_angles(arm)},
        "target": {"pose": {} if target is None else target},
        "constraints": _joint_limits(arm),
    }
    scene = with_torque_weights(stable(_validated(data, robot.name)), arm)
    if scaled_efforts:
        scene = with_scaled_limits(scene, kept)
    return scene if target is not None else scene.replace(target={"pose": default_target(scene, arm)})


class _Spacecraft(Model):
    """The spacecraft that carries the arm, and is not in the robot's file."""

    mass: Positive = Field(description="mass of the spacecraft, kg")
    inertia: Inertia = Field(
        description="inertia of the spacecraft about its center of mass, its own axes, kg m^2: 3 numbers "
        "(diagonal) or 3x3"
    )
    center_of_mass: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="center of mass of the spacecraft in its own frame, m"
    )
    mount: Pose = Field(
        default_factory=Pose, description="pose of the base link in the spacecraft's frame, m"
    )


def _spacecraft(fields: Mapping[str, Any]) -> tuple[Body, tuple[float, ...]]:
    """The spacecraft in its own frame, and the pose of the base link there."""
    if not isinstance(fields, Mapping):
        raise SceneError(f"spacecraft = {fields!r}: must be a mapping, {{'mass': ..., 'inertia': ...}}")
    try:
        body = _Spacecraft.model_validate(dict(fields))
    except ValidationError as error:
        raise SceneError("\n  - ".join(["spacecraft:", *_messages(error)])) from error
    at_center = Body(body.mass, np.array(body.center_of_mass), np.array(body.inertia))
    return at_center, tuple(body.mount.dual_quaternion)


def _check_passive(arm: Arm, passive: Collection[str]) -> None:
    if isinstance(passive, str) or not isinstance(passive, Collection):
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
    """Warn of Coulomb friction that is left out, and of flaws of the inertias."""
    rubbing = [part.joint.name for part in arm.joints if part.joint.friction]
    if rubbing:
        warnings.warn(
            f"URDF: Coulomb friction of {', '.join(rubbing)} is left out: `motor.friction` of a link adds it",
            stacklevel=3,
        )
    for flaw in arm.flaws:
        warnings.warn(
            f"URDF: {flaw}",
            stacklevel=3,
        )


def _motors(arm: Arm, joint_torque: float | None, passive: Collection[str]) -> dict[str, Any] | None:
    """The scene's joint motors; each link also has its own limit."""
    driven = [part.joint for part in arm.joints if part.joint.name not in passive]
    if joint_torque is None and (missing := missing_efforts(driven)):
        raise SceneError(f"URDF: {missing}")
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
    lower, upper = zip(*(joint.limits or ANY_ANGLE for joint in joints), strict=True)
    bounds = {"lower": lower, "upper": upper, "rate": tuple(joint.rate for joint in joints)}
    finite = {name: limits for name, limits in bounds.items() if any(map(math.isfinite, limits))}
    return [{"name": "joint limits", "kind": "joint_limits", **finite}] if finite else []


def _links(
    arm: Arm, joint_torque: float | None, passive: Collection[str], dampers: bool
) -> list[dict[str, Any]]:
    """The scene's links; of those right after their parents nothing is said."""
    names = [BASE, *(part.joint.child for part in arm.joints)]
    return [
        _link(part, joint_torque, passive, dampers)
        | ({} if part.parent == index else {"parent": names[part.parent]})
        for index, part in enumerate(arm.joints)
    ]


def _link(
    part: ArmJoint, joint_torque: float | None, passive: Collection[str], dampers: bool
) -> dict[str, Any]:
    joint = part.joint
    driven = joint.name not in passive
    return {
        "name": joint.child,
        "mass": _rounded(part.body.mass),
        "inertia": tidied(part.body.inertia).tolist(),
        "center_of_mass": tidied(part.body.center_of_mass).tolist(),
        "joint": written_pose(part.pose),
        "joint_type": joint.joint_type,
        "actuated": driven,
        "torque_limit": (joint.effort or joint_torque) if driven else None,
        "damping": joint.damping if dampers else 0.0,
    }


def _rounded(mass: float) -> float:
    """15 digits of a mass, without the residue of a sum, as `tidied` numbers have them."""
    return float(f"{mass:.15g}")
