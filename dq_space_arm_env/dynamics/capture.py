"""A payload caught and released: how velocities change when the mass of the robot jumps.

At the capture the payload and the tip, which meet with different velocities, move on as one body. The impulse
that makes them do so is internal, so that linear and angular momentum are kept; with the brakes of the joints
open it is also free of work at each joint: the new velocities v+ of base and joints obey M+ v+ = M v + J' p,
where p is the momentum of the payload and J the Jacobian of the tip (a plastic impact; Featherstone, Rigid
Body Dynamics Algorithms, section 11.7). At the release nothing pushes anything: velocities stay, and the
payload leaves with that of the tip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.algebra.vectors import add, cross, matrix_vector, scale
from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import (
    ZERO,
    Accelerations,
    inverse_dynamics,
    joint_rotations,
    tip_wrench_forces,
)

Scalar = Any
Vector3 = Sequence[Scalar]


class Velocities(NamedTuple):
    """Velocities of a robot.

    Attributes:
        angular: Angular velocity of the base, base axes, 3, rad/s.
        linear: Velocity of the base's center of mass, base axes, 3, m/s.
        joint_rates: n, rad/s.
    """

    angular: Vector3
    linear: Vector3
    joint_rates: Sequence[Scalar]


def capture(
    free: Chain,
    loaded: Chain,
    payload: RigidBody,
    joint_angles: Sequence[Scalar],
    velocities: Velocities,
    payload_twist: Sequence[Scalar],
) -> Velocities:
    """Velocities right after a payload has been caught.

    Args:
        free: The robot before; without a wrist.
        loaded: The robot with the payload at its tip.
        payload: Mass, center of mass and inertia of the payload in tip axes, kg, m, kg m^2.
        joint_angles: n, rad.
        velocities: Of base and joints before.
        payload_twist: Of the payload before, angular [rad/s] then linear [m/s] at the tip's origin, tip axes,
            6.

    Returns:
        Velocities of base and joints after.
    """
    rotations = joint_rotations(free, joint_angles)
    still = [0.0] * len(free.links)
    # Without velocities, what accelerations need is M a: here the momentum M v.
    own = inverse_dynamics(
        free,
        rotations,
        ZERO,
        still,
        Accelerations(velocities.angular, velocities.linear, velocities.joint_rates),
    )
    omega, center = payload_twist[:3], payload.center_of_mass
    linear = scale(payload.mass, add(payload_twist[3:], cross(omega, center)))
    angular = add(matrix_vector(payload.inertia, omega), cross(center, linear))
    brought = tip_wrench_forces(free, rotations, free.tip.rotation, free.tip.position, (*linear, *angular))
    joints = [a + b for a, b in zip(own.joints, brought.joints, strict=True)]
    after = MassMatrix(loaded, rotations).solve(
        add(own.force, brought.force), add(own.torque, brought.torque), joints
    )
    return Velocities(after.angular, after.linear, after.joints)
