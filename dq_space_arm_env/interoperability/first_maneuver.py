"""The maneuver that a scene from a URDF begins with: start, target, limits and weights of the torques."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import SCREWS, KinematicTree
from dq_space_arm_env.interoperability.rigid_body import tidied
from dq_space_arm_env.interoperability.swing_efforts import swing_efforts
from dq_space_arm_env.interoperability.urdf_arm import Arm, ArmJoint
from dq_space_arm_env.interoperability.urdf_elements import Pose, UrdfJoint
from dq_space_arm_env.scene import Cost, Scene

# Angle from the start of every joint at the default target, rad.
_TARGET_OFFSET = 0.3
# Angle by which every joint of an arm that would begin in a singular pose is bent, rad.
_BEND = 0.5
# Distance of the start from the stops of a joint, rad (slides: m), so that it can be drawn.
_ROOM = 0.2
# Smallest singular value of the tip's Jacobian, relative to the largest, below which a pose is singular.
_SINGULAR = 0.01
# Limit of a torque that is scaled for free flight, relative to the effort of a swing by 1 rad.
_HEADROOM = 3.0
ANY_ANGLE = (-math.inf, math.inf)


def start_angles(arm: Arm) -> list[float]:
    """Angles at the start, rad: at rest, or bent where that is singular and helps.

    In a straight arm several joints do the same and none moves the tip along it: to first order the cost does
    not tell which way to bend, and the solver creeps.
    """
    at_rest = [_at_rest(part.joint) for part in arm.joints]
    bent = [*(_bent(part.joint) for part in arm.joints[: arm.way]), *at_rest[arm.way :]]
    return bent if _dexterity(arm, at_rest) < _SINGULAR < _dexterity(arm, bent) else at_rest


def _at_rest(joint: UrdfJoint) -> float:
    """Zero, at some distance from limits near it, or midway between them where they exclude it."""
    lower, upper = joint.limits or ANY_ANGLE
    middle = 0.5 * (lower + upper)
    if not lower <= 0.0 <= upper and math.isfinite(middle):
        return middle
    lowest, highest = _off_stops(joint)
    return min(max(0.0, lowest), highest)


def _off_stops(joint: UrdfJoint) -> tuple[float, float]:
    """Smallest and largest angle at some distance from the stops."""
    lower, upper = joint.limits or ANY_ANGLE
    room = min(_ROOM, 0.5 * (upper - lower))
    return lower + room, upper - room


def _moved(joint: UrdfJoint, angle: float, step: float) -> float | None:
    """An angle and a step, upward where the limits allow it; None if they allow neither."""
    lower, upper = joint.limits or ANY_ANGLE
    return next((turned for turned in (angle + step, angle - step) if lower <= turned <= upper), None)


def _bent(joint: UrdfJoint) -> float:
    """Angle at rest and the bend, or what the limits allow of it; a slide does not bend."""
    angle, (lowest, highest) = _at_rest(joint), _off_stops(joint)
    if joint.slides:
        return angle
    upward, downward = min(angle + _BEND, highest), max(angle - _BEND, lowest)
    return round(upward if upward - angle >= angle - downward else downward, 12)


def _dexterity(arm: Arm, angles: Sequence[float]) -> float:
    """Smallest singular value of the tip's Jacobian on a fixed base, relative to the largest.

    Lengths are in units of the largest distance from a joint to the tip.
    """
    frame: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    axes, origins = [], []
    way = arm.joints[: arm.way]
    slides = np.array([part.joint.slides for part in way])
    for part, angle in zip(way, angles, strict=False):
        frame = tuple(dual_quaternion.multiply(frame, displaced(part, angle)))
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


def default_target(scene: Scene, arm: Arm) -> dict[str, Any]:
    """Pose of the tip with every joint moved by the offset, or halfway to the farther limit."""
    start, angles = scene.initial_state, []
    for part, angle in zip(arm.joints, start.joint_angles, strict=True):
        moved = _moved(part.joint, angle, _TARGET_OFFSET)
        if moved is None:
            farther = max(part.joint.limits or ANY_ANGLE, key=lambda limit: abs(limit - angle))
            moved = 0.5 * (angle + farther)
        angles.append(moved)
    pose = kinematics.tip_pose(KinematicTree.from_scene(scene), start.base_pose.dual_quaternion, angles, ())
    return written_pose(tuple(pose))


def with_torque_weights(scene: Scene, arm: Arm) -> Scene:
    """The scene, with weights of the torques with which an arm of any size moves within seconds.

    The effort of a swing by 1 rad in seconds, see `swing_efforts`, costs as much as the error that it
    removes: turned by theta, a tip at distance d costs w (1 + d^2) theta^2 / 4, w the pose's weight; moved
    along a slide, w / 4. A joint's weight is per the square of its own unit.
    """
    levers, tip = [1.0] * len(arm.joints), arm.tip
    for index in reversed(range(arm.way)):
        part = arm.joints[index]
        if not part.joint.slides:
            levers[index] += math.dist(poses.to_rotation_and_position(tip)[1], (0.0, 0.0, 0.0)) ** 2
        tip = tuple(dual_quaternion.multiply(displaced(part, scene.initial_state.joint_angles[index]), tip))
    weights = {
        f"links.{index}.torque_weight": float(f"{0.25 * Cost().pose[0] * lever / effort**2:.2g}")
        for index, (lever, effort) in enumerate(zip(levers, swing_efforts(scene), strict=True))
        if scene.links[index].actuated
    }
    return scene.replace(weights)


def with_scaled_limits(scene: Scene, kept: Collection[str] = ()) -> Scene:
    """The scene, with torque limits that leave a swing by 1 rad in seconds a headroom of three, or less.

    Links named in `kept` keep theirs.
    """
    limits = {
        f"links.{index}.torque_limit": limit
        for index, (link, effort) in enumerate(zip(scene.links, swing_efforts(scene), strict=True))
        if link.torque_limit is not None
        and link.name not in kept
        and (limit := float(f"{_HEADROOM * effort:.2g}")) < link.torque_limit
    }
    scene = scene.replace(limits)
    largest = max((link.torque_limit for link in scene.links if link.torque_limit is not None), default=None)
    return scene if largest is None else scene.replace({"actuators.joint_torque.limit": largest})


def displaced(part: ArmJoint, coordinate: float) -> Pose:
    """Pose of a joint's frame, turned or slid by its coordinate, in the frame before."""
    motion = kinematics.joint_motion(SCREWS[part.joint.joint_type], coordinate)
    return tuple(dual_quaternion.multiply(part.pose, motion))


def written_pose(pose: Pose) -> dict[str, Any]:
    """A pose as a scene has it."""
    rotation, position = poses.to_rotation_and_position(pose)
    return {"position": tidied(np.array(position)).tolist(), "rotation": tidied(np.array(rotation)).tolist()}
