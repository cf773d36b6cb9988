"""Inverse dynamics in minimal coordinates: joint angles, base twist and joint rates.

The recursive Newton-Euler algorithm (RNEA; Luh, Walker & Paul 1980; Featherstone, Rigid Body Dynamics
Algorithms, 2008, chapter 5) gives the wrenches that a motion needs; `forward` inverts it.

Neither the base pose nor the base's linear velocity enters: space has no preferred place, direction or
velocity. The base acceleration a is the one seen by an inertial observer moving along with it; the paper's
dual acceleration follows as v' = a - omega x v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from dq_space_arm_env.algebra import quaternion, rotations
from dq_space_arm_env.algebra.scalars import cos, sin, tanh
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    matrix_product,
    matrix_vector,
    scale,
    transposed_matrix_vector,
)
from dq_space_arm_env.dynamics.kinematic_tree import (
    TURNED_AXES,
    Friction,
    KinematicTree,
    RigidBody,
    Rotor,
    Screw,
)

Scalar = Any
Vector3 = Sequence[Scalar]
ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Accelerations:
    """Accelerations of the generalized velocities."""

    angular: Vector3  # of the base, base axes, rad/s^2
    linear: Vector3  # inertial, of the base's center of mass, base axes, m/s^2
    joints: Sequence[Scalar]  # n, rad/s^2 or m/s^2


@dataclass(frozen=True)
class Wrenches:
    """Generalized forces dual to `Accelerations`."""

    force: Vector3  # on the base at its center of mass, base axes, N
    torque: Vector3  # on the base about its center of mass, base axes, N m
    joints: Sequence[Scalar]  # n, N m or N
    # Force and torque that each joint transmits to its link, about the joint origin, joint axes; a revolute
    # joint's z torque is the motor's share, the other five are the paper's W~ (13)-(16).
    reactions: Sequence[tuple[Vector3, Vector3]]


class LinkFrame(NamedTuple):
    """Pose of a link's frame in its parent's."""

    rotation: Sequence[Vector3]  # from the link's axes to its parent's, C_i Rz(theta_i)
    position: Vector3  # of the origin, m


def link_frames(tree: KinematicTree, joint_angles: Sequence[Any]) -> list[LinkFrame]:
    """Frames of the links, n, from their joints' coordinates: screws about their z axes, or quaternions."""
    frames: list[LinkFrame] = []
    for link, angle in zip(tree.links, joint_angles, strict=True):
        rotation: Sequence[Vector3] = link.joint.rotation
        position: Vector3 = link.joint.position
        axis = [row[2] for row in rotation]  # z, which a turn leaves where it is
        if link.spherical is not None:
            if link.spherical == 0:
                turned = matrix_product(rotation, quaternion_rotation(angle))
                rotation = matrix_product(turned, TURNED_AXES.rotation)
        elif link.screw.turn:
            c, s = cos(angle), sin(angle)
            rotation = tuple((row[0] * c + row[1] * s, row[1] * c - row[0] * s, row[2]) for row in rotation)
        if link.screw.slide:
            position = add(position, scale(link.screw.slide * angle, axis))
        frames.append(LinkFrame(rotation, position))
    return frames


def quaternion_rotation(q: Sequence[Scalar]) -> Sequence[Vector3]:
    """Rotation matrix of a quaternion that need not have unit length, as within the stages of a step."""
    w, x, y, z = q
    twice = 2.0 / (w * w + x * x + y * y + z * z)
    xx, yy, zz = twice * x * x, twice * y * y, twice * z * z
    xy, yz, zx = twice * x * y, twice * y * z, twice * z * x
    wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
    return (
        (1.0 - (yy + zz), xy - wz, zx + wy),
        (xy + wz, 1.0 - (zz + xx), yz - wx),
        (zx - wy, yz + wx, 1.0 - (xx + yy)),
    )


def turn_by_quaternion(q: Sequence[Scalar]) -> list[list[Scalar]]:
    """Rotation in a link's axes, rad, per change of its quaternion of any length, 3x4: 2 q* dq / |q|^2."""
    w, x, y, z = quaternion.scale(2.0 / quaternion.dot(q, q)[0], q)
    return [[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]


def angle_rates(
    tree: KinematicTree, joint_angles: Sequence[Any], joint_rates: Sequence[Scalar]
) -> list[Scalar]:
    """Time derivative of the joints' coordinates as a state has them: the rates, or q' = q omega / 2 (2)."""
    rates: list[Scalar] = []
    for index, link in enumerate(tree.links):
        if link.spherical is None:
            rates.append(joint_rates[index])
        elif link.spherical == 0:
            omega = (0.0, *joint_rates[index : index + 3])
            rates += quaternion.scale(0.5, quaternion.multiply(joint_angles[index], omega))
    return rates


def deflections(tree: KinematicTree, joint_angles: Sequence[Any]) -> list[Scalar]:
    """Joints' coordinates less those at which springs rest, rad (m): of spherical ones rotation vectors."""
    found: list[Scalar] = []
    for index, link in enumerate(tree.links):
        if link.spherical is None:
            found.append(joint_angles[index] - link.rest_angle)
        elif link.spherical == 0:
            found += rotations.logarithm(quaternion.normalize(joint_angles[index]))
    return found


def along(screw: Screw, force: Vector3, torque: Vector3) -> Scalar:
    """Share of a wrench that works along a screw, N m or N."""
    if not screw.slide:
        return torque[2]
    return screw.slide * force[2] + torque[2] if screw.turn else force[2]


def body_wrenches(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acceleration: Accelerations,
) -> tuple[list[tuple[Vector3, Vector3]], list[Scalar]]:
    """Force [N] and torque [N m] that each body needs for given accelerations, of base and links.

    They act about the origin of each body's frame, in its axes, n + 1 pairs: the outward pass of the RNEA.
    Besides, the torques [N m] that the rotors of the joints need, n.
    """
    rotors: list[Scalar] = []
    carried: Vector3 = ZERO  # angular velocity of what carries a spherical joint
    motions = [(angular_velocity, acceleration.angular, acceleration.linear)]
    wrenches = [_newton_euler(tree.base, *motions[0])]
    for link, (rotation, p), rate, rate_change in zip(
        tree.links, frames, joint_rates, acceleration.joints, strict=True
    ):
        omega, alpha, a = motions[link.parent]
        # a_O' = R' (a + alpha x p + omega x (omega x p)), all components now in the link's axes.
        a = transposed_matrix_vector(rotation, add(a, add(cross(alpha, p), cross(omega, cross(omega, p)))))
        omega = transposed_matrix_vector(rotation, omega)
        alpha = transposed_matrix_vector(rotation, alpha)
        about_rotor, about_joint = rotor_torques(link.rotor, omega, alpha, rate, rate_change)
        rotors.append(about_joint)
        if about_rotor is not None:  # its bearings are on the body before the joint
            force, torque = wrenches[link.parent]
            wrenches[link.parent] = force, add(torque, matrix_vector(rotation, about_rotor))
        across = (omega[1] * rate, -omega[0] * rate)  # omega x (rate z)
        if link.spherical is not None:  # rates about axes of one body: no rate turns another's axis
            carried = transposed_matrix_vector(rotation, carried) if link.spherical else omega
            across = (carried[1] * rate, -carried[0] * rate)
        turn, slide = link.screw
        if slide:  # the origin moves along z: 2 omega x (rate z) and (rate change) z more
            a = add(a, scale(slide, (2.0 * across[0], 2.0 * across[1], rate_change)))
        if turn:
            # alpha' = R' alpha + omega x (rate z) + (rate change) z.
            alpha = add(alpha, (*across, rate_change))
            omega = (omega[0], omega[1], omega[2] + rate)
        motions.append((omega, alpha, a))
        wrenches.append(_newton_euler(link.body, omega, alpha, a))
    return wrenches, rotors


def rotor_torques(
    rotor: Rotor | None, omega: Vector3, alpha: Vector3, rate: Scalar, rate_change: Scalar
) -> tuple[Vector3 | None, Scalar]:
    """Torque that a rotor needs from the body before its joint, joint axes, and from the joint's motor, N m.

    `omega` and `alpha` are that body's. Lagrange's equations of J_r (omega_z + N rate)^2 / 2, the rotor's
    energy; without its coupling the body does not enter, and needs no torque.
    """
    if rotor is None:
        return None, 0.0
    if not rotor.exact:
        return None, rotor.reflected * rate_change
    # The spin s = J_r (omega_z + N rate) about z: s' z + omega x s z.
    spin = rotor.inertia * (omega[2] + rotor.gear * rate)
    change = rotor.inertia * (alpha[2] + rotor.gear * rate_change)
    return (omega[1] * spin, -omega[0] * spin, change), rotor.gear * change


def inverse_dynamics(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acceleration: Accelerations,
) -> Wrenches:
    """Generalized forces for given accelerations (RNEA), without springs, dampers and tip wrench."""
    wrenches, rotors = body_wrenches(tree, frames, angular_velocity, joint_rates, acceleration)
    passed = passed_to_base(tree, frames, wrenches)
    return replace(passed, joints=[own + rotor for own, rotor in zip(passed.joints, rotors, strict=True)])


def passed_to_base(
    tree: KinematicTree, frames: Sequence[LinkFrame], wrenches: Sequence[tuple[Vector3, Vector3]]
) -> Wrenches:
    """Generalized forces of wrenches on the bodies, summed toward the base: the inward pass of the RNEA."""
    acting = list(wrenches)
    reactions: list[tuple[Vector3, Vector3]] = []
    for i, parent in reversed([*enumerate(tree.parents)]):
        force, torque = acting[i + 1]
        reactions.insert(0, (force, torque))
        force_at_parent, torque_at_parent = shift_wrench(*frames[i], force, torque)
        acting[parent] = (add(acting[parent][0], force_at_parent), add(acting[parent][1], torque_at_parent))
    joints = [along(link.screw, *wrench) for link, wrench in zip(tree.links, reactions, strict=True)]
    return Wrenches(acting[0][0], acting[0][1], joints, reactions)


def _newton_euler(body: RigidBody, omega: Vector3, alpha: Vector3, a: Vector3) -> tuple[Vector3, Vector3]:
    """Force and torque about the frame's origin that a body needs: (9), with the center of mass at c."""
    c = body.center_of_mass
    # f = m a_c, with a_c = a + alpha x c + omega x (omega x c).
    force = scale(body.mass, add(a, add(cross(alpha, c), cross(omega, cross(omega, c)))))
    # tau = J alpha + omega x J omega + c x f.
    momentum = matrix_vector(body.inertia, omega)
    about_center = add(matrix_vector(body.inertia, alpha), cross(omega, momentum))
    return force, add(about_center, cross(c, force))


def shift_wrench(
    rotation: Sequence[Vector3], position: Vector3, force: Vector3, torque: Vector3
) -> tuple[Vector3, Vector3]:
    """Express a wrench in the parent's frame: Ad(q) (f + eps tau), eq. (7)."""
    rotated = matrix_vector(rotation, force)
    return rotated, add(matrix_vector(rotation, torque), cross(position, rotated))


def passive_torques(
    tree: KinematicTree, joint_angles: Sequence[Scalar], joint_rates: Sequence[Scalar]
) -> list[Scalar]:
    """Torques (or forces) of the joints' springs, dampers and friction on the links, n, N m (N)."""
    return [
        -link.stiffness * away - link.damping * rate - rubbing(link.friction, rate)
        for link, away, rate in zip(tree.links, deflections(tree, joint_angles), joint_rates, strict=True)
    ]


def rubbing(friction: Friction | None, rate: Scalar) -> Scalar:
    """Torque of Coulomb friction against a rate, N m."""
    return 0.0 if friction is None else friction.torque * tanh(rate * (1.0 / friction.speed))


def tip_wrench_forces(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    tip_rotation: Sequence[Vector3],
    tip_position: Vector3,
    wrench: Sequence[Scalar],
) -> Wrenches:
    """Generalized forces of a wrench at G (force, then torque, in G axes): the last term of (16)."""
    acting: list[tuple[Vector3, Vector3]] = [(ZERO, ZERO)] * len(tree.bodies)
    acting[tree.tip_body] = shift_wrench(tip_rotation, tip_position, wrench[:3], wrench[3:])
    return passed_to_base(tree, frames, acting)
