"""Dynamics in minimal coordinates: joint angles, base twist and joint rates, and nothing redundant.

The recursive Newton-Euler algorithm gives the wrenches that a motion needs, which is inverse dynamics
(Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 5); `forward` has its inverse. Everything is
written over plain scalars: numbers, arrays, or symbols.

Two facts keep it small. The base pose never enters, because space has no preferred place or direction; and
neither does the base's linear velocity, because it has no preferred velocity: the acceleration of the base is
computed as seen by an inertial observer moving along with it, and the dual acceleration of the paper follows
as v' = a - omega x v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra.scalars import cos, sin
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    matrix_vector,
    scale,
    transposed_matrix_vector,
)
from dq_space_arm_env.dynamics.chain import Chain, RigidBody

Scalar = Any
Vector3 = Sequence[Scalar]
ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Accelerations:
    """Accelerations of the generalized velocities.

    Attributes:
        angular: Angular acceleration of the base, base axes, 3, rad/s^2.
        linear: Inertial acceleration of the base's center of mass, base axes, 3, m/s^2.
        joints: Joint accelerations, n, rad/s^2.
    """

    angular: Vector3
    linear: Vector3
    joints: Sequence[Scalar]


@dataclass(frozen=True)
class Wrenches:
    """Generalized forces dual to `Accelerations`.

    Attributes:
        force: Force on the base at its center of mass, base axes, 3, N.
        torque: Torque on the base about its center of mass, base axes, 3, N m.
        joints: Joint torques, n, N m.
        reactions: Force and torque that each joint transmits to its link, about the joint origin, in joint
            axes, n pairs; the z torque is the motor's share, the other five are the paper's W~ (13)-(16).
    """

    force: Vector3
    torque: Vector3
    joints: Sequence[Scalar]
    reactions: Sequence[tuple[Vector3, Vector3]]


def joint_rotations(chain: Chain, joint_angles: Sequence[Scalar]) -> list[Sequence[Vector3]]:
    """Rotation matrix of each joint frame in its parent's frame, C_i Rz(theta_i).

    Args:
        chain: The robot.
        joint_angles: Joint angles, n, rad.

    Returns:
        n matrices 3x3, from joint axes to parent axes.
    """
    rotations: list[Sequence[Vector3]] = []
    for link, angle in zip(chain.links, joint_angles, strict=True):
        c, s = cos(angle), sin(angle)
        rotations.append(
            tuple((row[0] * c + row[1] * s, row[1] * c - row[0] * s, row[2]) for row in link.joint.rotation)
        )
    return rotations


def body_wrenches(
    chain: Chain,
    rotations: Sequence[Sequence[Vector3]],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acceleration: Accelerations,
) -> list[tuple[Vector3, Vector3]]:
    """Wrenches that each body needs for given accelerations, whatever brings them about.

    Args:
        chain: The robot.
        rotations: From `joint_rotations`.
        angular_velocity: Angular velocity of the base, base axes, 3, rad/s.
        joint_rates: Joint rates, n, rad/s.
        acceleration: The accelerations.

    Returns:
        Force [N] and torque [N m] on base and links about the origins of their frames, in their axes, n + 1
        pairs.
    """
    omega, alpha, a = angular_velocity, acceleration.angular, acceleration.linear
    wrenches = [_newton_euler(chain.base, omega, alpha, a)]
    for link, rotation, rate, rate_change in zip(
        chain.links, rotations, joint_rates, acceleration.joints, strict=True
    ):
        p = link.joint.position
        a = transposed_matrix_vector(rotation, add(a, add(cross(alpha, p), cross(omega, cross(omega, p)))))
        omega = transposed_matrix_vector(rotation, omega)
        # omega x (rate z), the part of the angular acceleration that the turning axes cause.
        turning = (omega[1] * rate, -omega[0] * rate, 0.0)
        alpha = add(transposed_matrix_vector(rotation, alpha), (turning[0], turning[1], rate_change))
        omega = (omega[0], omega[1], omega[2] + rate)
        wrenches.append(_newton_euler(link.body, omega, alpha, a))
    return wrenches


def inverse_dynamics(
    chain: Chain,
    rotations: Sequence[Sequence[Vector3]],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acceleration: Accelerations,
) -> Wrenches:
    """Wrenches that produce given accelerations (recursive Newton-Euler, Luh, Walker & Paul 1980).

    Args:
        chain: The robot.
        rotations: From `joint_rotations`.
        angular_velocity: Angular velocity of the base, base axes, 3, rad/s.
        joint_rates: Joint rates, n, rad/s.
        acceleration: The accelerations.

    Returns:
        The wrenches, without springs, dampers and tip wrench.
    """
    wrenches = body_wrenches(chain, rotations, angular_velocity, joint_rates, acceleration)
    return passed_to_base(chain, rotations, wrenches)


def passed_to_base(
    chain: Chain, rotations: Sequence[Sequence[Vector3]], wrenches: Sequence[tuple[Vector3, Vector3]]
) -> Wrenches:
    """Generalized forces of wrenches on the bodies, added up from the tip to the base.

    Args:
        chain: The robot.
        rotations: From `joint_rotations`.
        wrenches: Force [N] and torque [N m] on base and links, as `body_wrenches` gives them.

    Returns:
        The generalized forces.
    """
    acting = list(wrenches)
    reactions: list[tuple[Vector3, Vector3]] = []
    for i in reversed(range(len(chain.links))):
        force, torque = acting[i + 1]
        reactions.insert(0, (force, torque))
        force_at_parent, torque_at_parent = shift_wrench(
            rotations[i], chain.links[i].joint.position, force, torque
        )
        acting[i] = (add(acting[i][0], force_at_parent), add(acting[i][1], torque_at_parent))
    joints = [torque[2] for _, torque in reactions]
    return Wrenches(acting[0][0], acting[0][1], joints, reactions)


def _newton_euler(body: RigidBody, omega: Vector3, alpha: Vector3, a: Vector3) -> tuple[Vector3, Vector3]:
    """Force and torque about the frame's origin that a body needs: (9), with the center of mass at c."""
    c = body.center_of_mass
    force = scale(body.mass, add(a, add(cross(alpha, c), cross(omega, cross(omega, c)))))
    momentum = matrix_vector(body.inertia, omega)
    about_center = add(matrix_vector(body.inertia, alpha), cross(omega, momentum))
    return force, add(about_center, cross(c, force))


def shift_wrench(
    rotation: Sequence[Vector3], position: Vector3, force: Vector3, torque: Vector3
) -> tuple[Vector3, Vector3]:
    """Express a wrench in the parent's frame: Ad(q) (f + eps tau), eq. (7).

    Args:
        rotation: From the child's to the parent's axes, 3x3.
        position: Child's origin in the parent's frame, 3, m.
        force: Force, 3, N.
        torque: Torque about the child's origin, 3, N m.

    Returns:
        Force, and torque about the parent's origin.
    """
    rotated = matrix_vector(rotation, force)
    return rotated, add(matrix_vector(rotation, torque), cross(position, rotated))


def passive_torques(
    chain: Chain, joint_angles: Sequence[Scalar], joint_rates: Sequence[Scalar]
) -> list[Scalar]:
    """Torques of the joints' springs and dampers.

    Args:
        chain: The robot.
        joint_angles: Joint angles, n, rad.
        joint_rates: Joint rates, n, rad/s.

    Returns:
        Torques on the links, n, N m.
    """
    return [
        -link.stiffness * (angle - link.rest_angle) - link.damping * rate
        for link, angle, rate in zip(chain.links, joint_angles, joint_rates, strict=True)
    ]


def tip_wrench_forces(
    chain: Chain,
    rotations: Sequence[Sequence[Vector3]],
    tip_rotation: Sequence[Vector3],
    tip_position: Vector3,
    wrench: Sequence[Scalar],
) -> Wrenches:
    """Generalized forces of a wrench at the tip, passed down the chain: the last term of (16).

    Args:
        chain: The robot.
        rotations: From `joint_rotations`.
        tip_rotation: From tip axes to the last link's axes, 3x3.
        tip_position: Tip in the last link's frame, 3, m.
        wrench: Force [N], then torque [N m] at G in G axes, 6.

    Returns:
        Force and torque on the base, joint torques, and what each joint passes on to the body before it.
    """
    force, torque = shift_wrench(tip_rotation, tip_position, wrench[:3], wrench[3:])
    return passed_to_base(chain, rotations, [*[(ZERO, ZERO)] * len(chain.links), (force, torque)])
