"""Kinematics of the tree: poses (27) and their rates (30), body velocities, momentum, energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.dual_vectors import inverse_transform
from dq_space_arm_env.algebra.poses import to_matrix
from dq_space_arm_env.algebra.scalars import cos, sin
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    dot,
    matrix_product,
    matrix_vector,
    scale,
    subtract,
    transposed_matrix_vector,
)
from dq_space_arm_env.dynamics import reaction_wheels
from dq_space_arm_env.dynamics.kinematic_tree import JointedLink, KinematicTree, Screw
from dq_space_arm_env.dynamics.minimal import ZERO, LinkFrame, deflections, link_frames, shift_wrench

Scalar = Any
DualQuaternion = Sequence[Scalar]
Vector3 = Sequence[Scalar]


def axis_rotation(axis: int, angle: Scalar) -> DualQuaternion:
    """Unit dual quaternion of a rotation about coordinate axis 0, 1 or 2."""
    result: list[Scalar] = [cos(0.5 * angle), *[0.0] * 7]
    result[1 + axis] = sin(0.5 * angle)
    return result


def joint_motion(screw: Screw, coordinate: Any) -> DualQuaternion:
    """Unit dual quaternion of a screw about and along z, exp(1/2 coordinate s), or of a quaternion."""
    turn, slide = screw
    if isinstance(coordinate, tuple):
        return (*coordinate, 0.0, 0.0, 0.0, 0.0)
    if not slide:
        return axis_rotation(2, coordinate)
    half = 0.5 * slide * coordinate
    if not turn:
        return (1.0, *[0.0] * 6, half)
    c, s = cos(0.5 * coordinate), sin(0.5 * coordinate)
    return (c, 0.0, 0.0, s, -half * s, 0.0, 0.0, half * c)


def wrist_rotation(wrist_angles: Sequence[Scalar]) -> DualQuaternion:
    """Rz(psi) Ry(theta) Rx(phi), the 3-2-1 rotation of the spherical joint, as a unit dual quaternion."""
    psi, theta, phi = wrist_angles
    return dq.multiply(dq.multiply(axis_rotation(2, psi), axis_rotation(1, theta)), axis_rotation(0, phi))


def wrist_rate_matrix(wrist_angles: Sequence[Scalar]) -> Sequence[Vector3]:
    """Map from Euler rates (psi, theta, phi) to the wrist's angular velocity in end-effector axes, 3x3.

    It is singular at gimbal lock, theta = +-90 deg.
    """
    _, theta, phi = wrist_angles
    return (
        (-sin(theta), 0.0, 1.0),
        (cos(theta) * sin(phi), cos(phi), 0.0),
        (cos(theta) * cos(phi), -sin(phi), 0.0),
    )


def frame_poses(
    tree: KinematicTree,
    base_pose: DualQuaternion,
    joint_angles: Sequence[Scalar],
    wrist_angles: Sequence[Scalar],
) -> list[DualQuaternion]:
    """Poses of base, joint frames, other tips, end effector (if any) and tip in the inertial frame (27)."""
    bodies = _body_poses(tree, base_pose, joint_angles)
    poses = [
        bodies[body] if place is None else dq.multiply(bodies[body], place.dual_quaternion)
        for body, place in tree.places or [(body, None) for body in range(len(bodies))]
    ]
    last = bodies[tree.tip_body]
    poses += [dq.multiply(bodies[body], frame.dual_quaternion) for body, frame in tree.other_tips]
    if tree.wrist is not None:
        wrist = dq.multiply(tree.wrist.dual_quaternion, wrist_rotation(wrist_angles))
        last = dq.multiply(last, wrist)
        poses.append(last)
    poses.append(dq.multiply(last, tree.tip.dual_quaternion))
    return poses


def _body_poses(
    tree: KinematicTree, base_pose: DualQuaternion, joint_angles: Sequence[Any]
) -> list[DualQuaternion]:
    """Poses of base and links; the massless bodies of a spherical joint have that of its link here."""
    poses = [base_pose]
    for link, angle in zip(tree.links, joint_angles, strict=True):
        poses.append(
            poses[link.parent]
            if link.spherical
            else dq.multiply(poses[link.parent], _joint_pose(link, angle))
        )
    return poses


def _joint_pose(link: JointedLink, coordinate: Any) -> DualQuaternion:
    """Pose of a link's frame in its parent's, of the first body of a spherical joint that of its link."""
    return dq.multiply(link.joint.dual_quaternion, joint_motion(link.screw, coordinate))


def _axis(link: JointedLink) -> Vector3:
    """Axis of a joint in the frames of `_body_poses`."""
    axis = [0.0, 0.0, 0.0]
    axis[2 if link.spherical is None else link.spherical] = 1.0
    return axis


def tip_pose(
    tree: KinematicTree,
    base_pose: DualQuaternion,
    joint_angles: Sequence[Scalar],
    wrist_angles: Sequence[Scalar],
) -> DualQuaternion:
    """Pose of the tip q_{G/I}, eq. (27)."""
    return dq.multiply(base_pose, arm_pose(tree, joint_angles, wrist_angles))


def arm_pose(
    tree: KinematicTree, joint_angles: Sequence[Scalar], wrist_angles: Sequence[Scalar]
) -> DualQuaternion:
    """Pose of the tip in the base frame, q_{G/e0}: (27) without its first factor."""
    arm: DualQuaternion = tree.tip.dual_quaternion
    if tree.wrist is not None:
        arm = dq.multiply(wrist_rotation(wrist_angles), arm)
        arm = dq.multiply(tree.wrist.dual_quaternion, arm)
    return seen_from_base(tree, joint_angles, tree.tip_body, arm)


def seen_from_base(
    tree: KinematicTree, joint_angles: Sequence[Scalar], body: int, pose: DualQuaternion
) -> DualQuaternion:
    """Pose in the base frame of what has the given one in a body's frame."""
    for index in reversed(tree.path_to(body)):
        link = tree.links[index]
        if not link.spherical:
            moved = dq.multiply(joint_motion(link.screw, joint_angles[index]), pose)
            pose = dq.multiply(link.joint.dual_quaternion, moved)
    return pose


def tip_pose_rate(
    tree: KinematicTree,
    base_pose: DualQuaternion,
    joint_angles: Sequence[Scalar],
    wrist_angles: Sequence[Scalar],
    base_twist: Sequence[Scalar],
    joint_rates: Sequence[Scalar],
    wrist_rates: Sequence[Scalar],
) -> DualQuaternion:
    """Time derivative of q_{G/I}, eq. (30); its last factor is q_{G/e3}, where the paper prints q_{G/3}."""
    poses = _body_poses(tree, base_pose, joint_angles)
    *_, hand, tip = (base_pose, *frame_poses(tree, base_pose, joint_angles, wrist_angles))

    def contribution(frame: DualQuaternion, twist: Sequence[Scalar]) -> DualQuaternion:
        """1/2 q_{X/I} omega^X q_{G/X}."""
        relative = dq.multiply(dq.conjugate(frame), tip)
        return dq.scale(0.5, dq.multiply(dq.multiply(frame, (0.0, *twist[:3], 0.0, *twist[3:])), relative))

    # (30): 1/2 q_{e0/I} w_0 q_{G/e0} + 1/2 sum_i q_{e_i/I} w^{e_i}_{i/e_i} q_{G/e_i}, joint frames for the
    # e_i.
    rate = contribution(base_pose, base_twist)
    for index in tree.path_to(tree.tip_body):
        turn, slide = (part * joint_rates[index] for part in tree.links[index].screw)
        axis = _axis(tree.links[index])
        rate = dq.add(rate, contribution(poses[index + 1], (*scale(turn, axis), *scale(slide, axis))))
    if tree.wrist is not None:
        turning = matrix_vector(wrist_rate_matrix(wrist_angles), wrist_rates)
        rate = dq.add(rate, contribution(hand, (*turning, 0.0, 0.0, 0.0)))
    return rate


def tip_jacobian(
    tree: KinematicTree, joint_angles: Sequence[Scalar], wrist_angles: Sequence[Scalar]
) -> list[list[Scalar]]:
    """Columns of the tip's body Jacobian: base (angular, linear), joints, Euler rates of the wrist.

    Each is the tip's twist (angular, linear) in tip axes per unit velocity: Ad(q_{G/X}*) of an axis in its
    frame X. Joints off the way from base to tip have zeros.
    """
    columns: list[list[Scalar]] = [[0.0] * 6 for _ in tree.links]
    relative: DualQuaternion = tree.tip.dual_quaternion  # q_{G/X}, from the tip's side of X = e_n to e0
    if tree.wrist is not None:
        rates = wrist_rate_matrix(wrist_angles)
        columns += [_carried_to_tip(relative, axis, ZERO) for axis in zip(*rates, strict=True)]
        wrist = dq.multiply(tree.wrist.dual_quaternion, wrist_rotation(wrist_angles))
        relative = dq.multiply(wrist, relative)
    for index in reversed(tree.path_to(tree.tip_body)):
        link = tree.links[index]
        turn, slide = link.screw
        axis = _axis(link)
        columns[index] = _carried_to_tip(relative, scale(turn, axis), scale(slide, axis))
        if not link.spherical:
            relative = dq.multiply(_joint_pose(link, joint_angles[index]), relative)
    axes = [[1.0 if j == i else 0.0 for j in range(3)] for i in range(3)]
    turning = [_carried_to_tip(relative, axis, ZERO) for axis in axes]
    moving = [_carried_to_tip(relative, ZERO, axis) for axis in axes]
    return [*turning, *moving, *columns]


def tip_twist(
    tree: KinematicTree,
    joint_angles: Sequence[Scalar],
    wrist_angles: Sequence[Scalar],
    base_twist: Sequence[Scalar],
    joint_rates: Sequence[Scalar],
    wrist_rates: Sequence[Scalar] | None = None,
) -> Sequence[Scalar]:
    """Twist of the tip (angular, linear) in its axes by recursion; the wrist is held unless it has rates.

    A fraction of the operations of `tip_jacobian`, half angles shared with the tip's pose.
    """
    twist = _body_twists(tree, joint_angles, base_twist, joint_rates)[tree.tip_body]
    if tree.wrist is not None:
        twist = inverse_transform(tree.wrist.rotation, tree.wrist.position, twist)
        twist = inverse_transform(*to_matrix(wrist_rotation(wrist_angles)), twist)
        if wrist_rates:
            turning = matrix_vector(wrist_rate_matrix(wrist_angles), wrist_rates)
            twist = (*add(twist[:3], turning), *twist[3:])
    return inverse_transform(tree.tip.rotation, tree.tip.position, twist)


def other_tip_twists(
    tree: KinematicTree,
    joint_angles: Sequence[Scalar],
    base_twist: Sequence[Scalar],
    joint_rates: Sequence[Scalar],
) -> list[Sequence[Scalar]]:
    """Twists of the other tips (angular, linear) in their axes, likewise."""
    twists = _body_twists(tree, joint_angles, base_twist, joint_rates)
    return [inverse_transform(at.rotation, at.position, twists[body]) for body, at in tree.other_tips]


def _body_twists(
    tree: KinematicTree,
    joint_angles: Sequence[Scalar],
    base_twist: Sequence[Scalar],
    joint_rates: Sequence[Scalar],
) -> list[Sequence[Scalar]]:
    """Twists of base and links (angular, linear) in their frames, with half angles."""
    frames = link_frames(tree, joint_angles)
    for index, (link, angle) in enumerate(zip(tree.links, joint_angles, strict=True)):
        if link.screw.turn and link.spherical is None:
            turned = matrix_product(link.joint.rotation, to_matrix(axis_rotation(2, angle))[0])
            frames[index] = frames[index]._replace(rotation=turned)
    velocities = body_velocities(tree, frames, base_twist, joint_rates)
    return [(*velocity.angular, *velocity.linear) for velocity in velocities]


def _carried_to_tip(relative: DualQuaternion, angular: Vector3, linear: Vector3) -> list[Scalar]:
    """Twist of G, in its axes, fixed to a frame X with the given twist; `relative` is q_{G/X}."""
    rotation, position = to_matrix(relative)
    swept = add(linear, cross(angular, position))  # v + omega x p
    return [*transposed_matrix_vector(rotation, angular), *transposed_matrix_vector(rotation, swept)]


@dataclass(frozen=True)
class BodyVelocity:
    """Velocity of a body in its own frame."""

    angular: Vector3  # rad/s
    linear: Vector3  # of the frame's origin, m/s
    # Of the rotor that drives it, about the joint's axis: relative to inertial space, or without its coupling
    # to the body before the joint; rad/s.
    rotor: Scalar = 0.0


def body_velocities(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    base_twist: Sequence[Scalar],
    joint_rates: Sequence[Scalar],
) -> list[BodyVelocity]:
    """Velocities of base and links, n + 1, by the recursion behind (12); `base_twist` in base axes."""
    velocities = [BodyVelocity(tuple(base_twist[:3]), tuple(base_twist[3:]))]
    for link, (rotation, position), rate in zip(tree.links, frames, joint_rates, strict=True):
        parent, (turn, slide) = velocities[link.parent], link.screw
        linear = transposed_matrix_vector(rotation, add(parent.linear, cross(parent.angular, position)))
        angular = transposed_matrix_vector(rotation, parent.angular)
        rotor: Scalar = 0.0
        if link.rotor is not None:
            rotor = link.rotor.gear * rate + (angular[2] if link.rotor.exact else 0.0)
        if turn:
            angular = (angular[0], angular[1], angular[2] + rate)
        if slide:
            linear = (linear[0], linear[1], linear[2] + slide * rate)
        velocities.append(BodyVelocity(angular, linear, rotor))
    return velocities


def momentum(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    velocities: Sequence[BodyVelocity],
    wheel_momenta: Sequence[Scalar] = (),
) -> tuple[Vector3, Vector3, Vector3]:
    """Linear momentum, angular momentum about the center of mass, and center of mass, in the base frame."""
    linear: list[Vector3] = []
    angular: list[Vector3] = []
    moments: list[Vector3] = []
    for body, velocity in zip(tree.bodies, velocities, strict=True):
        c = body.center_of_mass
        p = scale(body.mass, add(velocity.linear, cross(velocity.angular, c)))  # m (v + omega x c)
        linear.append(p)
        angular.append(add(matrix_vector(body.inertia, velocity.angular), cross(c, p)))
        moments.append(scale(body.mass, c))
    masses = [body.mass for body in tree.bodies]
    for i, parent in reversed([*enumerate(tree.parents)]):
        rotation, position = frames[i]
        linear_at_parent, angular_at_parent = shift_wrench(rotation, position, linear[i + 1], angular[i + 1])
        linear[parent] = add(linear[parent], linear_at_parent)
        angular[parent] = add(angular[parent], angular_at_parent)
        rotor = tree.links[i].rotor
        if rotor is not None and rotor.exact:
            spin = rotor.inertia * velocities[i + 1].rotor
            angular[parent] = add(angular[parent], scale(spin, [row[2] for row in rotation]))
        rotated = matrix_vector(rotation, moments[i + 1])
        moments[parent] = add(moments[parent], add(rotated, scale(masses[i + 1], position)))
        masses[parent] = masses[i + 1] + masses[parent]
    center = scale(1.0 / masses[0], moments[0])
    total = subtract(angular[0], cross(center, linear[0]))  # L_c = L_O - c x p
    if tree.wheels:
        total = add(total, reaction_wheels.along_axes(tree.wheels, wheel_momenta))
    return linear[0], total, center


def energy(
    tree: KinematicTree,
    joint_angles: Sequence[Scalar],
    velocities: Sequence[BodyVelocity],
    wheel_momenta: Sequence[Scalar] = (),
) -> tuple[Scalar, Scalar]:
    """Kinetic energy and potential energy of the joint springs, J."""
    kinetic: Scalar = 0.0
    for body, velocity in zip(tree.bodies, velocities, strict=True):
        v = add(velocity.linear, cross(velocity.angular, body.center_of_mass))
        rotational = dot(velocity.angular, matrix_vector(body.inertia, velocity.angular))
        kinetic = kinetic + 0.5 * (body.mass * dot(v, v) + rotational)
    if tree.wheels:
        kinetic = kinetic + reaction_wheels.energy(tree.wheels, wheel_momenta)
    for link, velocity in zip(tree.links, velocities[1:], strict=True):
        if link.rotor is not None:
            kinetic = kinetic + 0.5 * (link.rotor.inertia * (velocity.rotor * velocity.rotor))
    potential: Scalar = 0.0
    for link, stretch in zip(tree.links, deflections(tree, joint_angles), strict=True):
        potential = potential + 0.5 * link.stiffness * (stretch * stretch)
    return kinetic, potential
