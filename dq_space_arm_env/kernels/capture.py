"""Capture of a payload by a single call, see `dynamics.plastic_impact`.

At a release velocities stay, and the payload leaves with the tip's.
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody
from dq_space_arm_env.dynamics.plastic_impact import Velocities, capture
from dq_space_arm_env.dynamics.vector_field import spread
from dq_space_arm_env.kernels.kernels import Kernels
from dq_space_arm_env.scene.pose import PLANAR_TWIST

Array = NDArray[Any]

_PARTS = ("base", "links", "wrist", "tip", "tip_body", "other_tips", "actuators.wheels", "actuators.tank")


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
    differing = [name for name in _PARTS if attrgetter(name)(free.scene) != attrgetter(name)(loaded.scene)]
    if free.scene.payload is not None or differing:
        which = ", ".join(differing) or "it has a payload already"
        raise ValueError(
            f"free: scene {free.scene.name!r} must be the loaded one without its payload: {which}"
        )
    state = _finite("x", x, free.n_x)
    twist = _finite("payload_twist", payload_twist, 6)
    layout, where = free.layout, free.layout.state
    directions = PLANAR_TWIST if layout.planar else tuple(range(6))
    if np.delete(twist, directions).any():
        raise ValueError(
            f"payload_twist: {twist} leaves the plane of scene {free.scene.name!r}, should be zero but for "
            "w_z, v_x and v_y, the entries 2 to 4"
        )
    base = spread(state[where.base_velocity].tolist(), directions, 6)
    tree = KinematicTree.from_scene(free.scene)
    left = state[where.propellant].tolist()
    after = capture(
        tree.with_propellant(left),
        KinematicTree.from_scene(loaded.scene).with_propellant(left),
        RigidBody(payload.mass, payload.center_of_mass, payload.inertia),
        tree.coordinates(state[where.joint_angles].tolist()),
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
