"""Plastic impact of tip and payload: the jump in velocities when a body is caught.

At the capture the payload and the tip, meeting at different velocities, move on as one body. The impulse
between them is internal, so linear and angular momentum are conserved; with open brakes it also does no work
at any joint: the new velocities v+ of base and joints obey M+ v+ = M v + J' p, where p is the momentum of the
payload and J the Jacobian of the tip (Featherstone, Rigid Body Dynamics Algorithms, section 11.7).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.algebra.vectors import add, cross, matrix_vector, scale
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import (
    ZERO,
    Accelerations,
    inverse_dynamics,
    link_frames,
    tip_wrench_forces,
)

Scalar = Any
Vector3 = Sequence[Scalar]


class Velocities(NamedTuple):
    """Velocities of base and joints."""

    angular: Vector3  # of the base, base axes, rad/s
    linear: Vector3  # of the base's center of mass, base axes, m/s
    joint_rates: Sequence[Scalar]  # n, rad/s


def capture(
    free: KinematicTree,
    loaded: KinematicTree,
    payload: RigidBody,
    joint_angles: Sequence[Scalar],
    velocities: Velocities,
    payload_twist: Sequence[Scalar],
) -> Velocities:
    """Velocities right after a capture, from the tree without and with the payload.

    The payload's mass properties are in tip axes, its twist (angular [rad/s], linear [m/s]) at the tip's
    origin in tip axes; the robot has no wrist.
    """
    frames = link_frames(free, joint_angles)
    still = [0.0] * len(free.links)
    # Without velocities, what accelerations need is M a: here the momentum M v.
    own = inverse_dynamics(
        free,
        frames,
        ZERO,
        still,
        Accelerations(velocities.angular, velocities.linear, velocities.joint_rates),
    )
    linear, angular = momentum_at_tip(payload, payload_twist)
    brought = tip_wrench_forces(free, frames, free.tip.rotation, free.tip.position, (*linear, *angular))
    joints = [a + b for a, b in zip(own.joints, brought.joints, strict=True)]
    after = MassMatrix(loaded, frames).solve(
        add(own.force, brought.force), add(own.torque, brought.torque), joints
    )
    return Velocities(after.angular, after.linear, after.joints)


def momentum_at_tip(body: RigidBody, twist: Sequence[Scalar]) -> tuple[Vector3, Vector3]:
    """Linear momentum, and angular momentum about the tip, of a body with a twist, all in tip axes."""
    omega, center = twist[:3], body.center_of_mass
    linear = scale(body.mass, add(twist[3:], cross(omega, center)))
    return linear, add(matrix_vector(body.inertia, omega), cross(center, linear))
