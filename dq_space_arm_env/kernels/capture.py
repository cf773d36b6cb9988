"""Capture of a payload: the jump in velocities when the mass of the robot changes.

At the capture the payload and the tip, meeting at different velocities, move on as one body. The impulse
between them is internal, so linear and angular momentum are conserved; with open brakes it also does no work
at any joint: the new velocities v+ of base and joints obey M+ v+ = M v + J' p, where p is the momentum of the
payload and J the Jacobian of the tip (a plastic impact; Featherstone, Rigid Body Dynamics Algorithms, section
11.7). At a release velocities stay, and the payload leaves with the tip's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra.vectors import add, cross, matrix_vector, scale
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import (
    ZERO,
    Accelerations,
    inverse_dynamics,
    joint_rotations,
    tip_wrench_forces,
)
from dq_space_arm_env.dynamics.vector_field import spread
from dq_space_arm_env.kernels.kernels import Kernels
from dq_space_arm_env.scene.pose import PLANAR_TWIST

Scalar = Any
Vector3 = Sequence[Scalar]
Array = NDArray[Any]


class Velocities(NamedTuple):
    """Velocities of base and joints."""

    angular: Vector3  # of the base, base axes, rad/s
    linear: Vector3  # of the base's center of mass, base axes, m/s
    joint_rates: Sequence[Scalar]  # n, rad/s


def capture(
    free: Chain,
    loaded: Chain,
    payload: RigidBody,
    joint_angles: Sequence[Scalar],
    velocities: Velocities,
    payload_twist: Sequence[Scalar],
) -> Velocities:
    """Velocities right after a capture, from the chain without and with the payload.

    The payload's mass properties are in tip axes, its twist (angular [rad/s], linear [m/s]) at the tip's
    origin in tip axes; the robot has no wrist.
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


def catch_payload(free: Kernels, loaded: Kernels, x: ArrayLike, payload_twist: ArrayLike) -> Array:
    """State right after the tip has caught a payload, total momentum conserved.

    Poses and angles stay; base and joints take the velocities of a plastic impact (`capture`). A release
    needs no function: the state stays, and the payload leaves with the twist of the tip.

    Args:
        free: Kernels of the scene without the payload.
        loaded: Kernels of the same scene with the payload.
        x: State before, shape (n_x,), units of `layout.state`.
        payload_twist: Of the payload before, angular [rad/s] then linear [m/s] at the tip's origin, in tip
            axes, shape (6,).

    Returns:
        State after, shape (n_x,).

    Raises:
        ValueError: If the scenes differ in more than the payload, x or the twist have a wrong shape or are
            not finite, or a planar payload leaves the plane.
    """
    payload = loaded.scene.payload
    if payload is None:
        raise ValueError(f"loaded: scene {loaded.scene.name!r} has no payload to be caught")
    names = ("base", "links", "wrist", "tip")
    differing = [name for name in names if getattr(free.scene, name) != getattr(loaded.scene, name)]
    if free.scene.payload is not None or differing:
        which = ", ".join(differing) or "it has a payload already"
        raise ValueError(
            f"free: scene {free.scene.name!r} must be the loaded one without its payload: {which}"
        )
    state = _finite("x", x, free.n_x)
    twist = _finite("payload_twist", payload_twist, 6)
    layout, where = free.layout, free.layout.state
    directions = PLANAR_TWIST if layout.planar else tuple(range(6))
    base = spread(state[where.base_velocity].tolist(), directions, 6)
    after = capture(
        Chain.from_scene(free.scene),
        Chain.from_scene(loaded.scene),
        RigidBody(payload.mass, payload.center_of_mass, payload.inertia),
        state[where.joint_angles].tolist(),
        Velocities(base[:3], base[3:], state[where.joint_rates].tolist()),
        twist.tolist(),
    )
    state[where.base_velocity] = np.array([*after.angular, *after.linear])[list(directions)]
    state[where.joint_rates] = after.joint_rates
    return state


def _finite(name: str, value: ArrayLike, size: int) -> Array:
    numbers = real_array(name, value).astype(np.float64)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{name}: {numbers} of shape {numbers.shape}, should be finite numbers of shape {(size,)}"
        )
    return numbers
