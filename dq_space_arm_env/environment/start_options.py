"""The options of `reset`: where an episode starts when it does not start at random."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene.start import PLANAR_POSE

Array = NDArray[np.float64]

_OPTIONS = ("nominal", "initial_state")


def given_start(kernels: Kernels, options: dict[str, Any]) -> Array | None:
    """Read where an episode is to start.

    Args:
        kernels: Functions of the scene.
        options: {"nominal": True} for the scene's initial state, or {"initial_state": x} with x of shape
            (n_x,).

    Returns:
        State, shape (n_x,), units of `kernels.layout.state`; None if the options leave it to chance.

    Raises:
        ValueError: If an option is unknown, or the initial state has a wrong shape, is not finite, or its
            pose is not a unit dual quaternion.
    """
    unknown = set(options) - set(_OPTIONS)
    if unknown:
        raise ValueError(f"options: {sorted(unknown)} unknown; there are {', '.join(_OPTIONS)}")
    state, nominal = options.get("initial_state"), options.get("nominal", False)
    if state is None:
        return kernels.layout.initial_state if nominal else None
    if nominal:
        raise ValueError("options: nominal and initial_state exclude each other")
    x = np.array(state, dtype=np.float64)
    if x.shape != (kernels.n_x,) or not np.isfinite(x).all():
        raise ValueError(
            f"options: initial_state {x} of shape {x.shape}, "
            f"should be finite numbers of shape {(kernels.n_x,)}"
        )
    return _with_sign_of_target(kernels, _with_unit_pose(kernels, x))


def _with_unit_pose(kernels: Kernels, x: Array) -> Array:
    """Refuse a base pose that is not a unit dual quaternion; remove rounding errors of one that is."""
    where = kernels.layout.state.pose
    stored = list(PLANAR_POSE) if kernels.layout.planar else list(range(8))
    pose = np.zeros(8)
    pose[stored] = x[where]
    length, overlap = math.hypot(*pose[:4]), float(np.dot(pose[:4], pose[4:]))
    if abs(length - 1.0) > 1e-6 or abs(overlap) > 1e-6 * (1.0 + math.hypot(*pose[4:])):
        raise ValueError(
            f"options: initial_state has a base pose with |q_r| = {length:.9g}, q_r . q_d = {overlap:.3g}; "
            "a unit dual quaternion has 1 and 0"
        )
    x[where] = np.array(dual_quaternion.normalize(tuple(pose.tolist())))[stored]
    return x


def _with_sign_of_target(kernels: Kernels, x: Array) -> Array:
    """Of q and -q, one pose but not one cost, take the one that puts the tip near the target's quaternion."""
    target = np.array(kernels.scene.target.pose.dual_quaternion)
    if kernels.tip_pose(x)[:4] @ target[:4] < 0.0:
        where = kernels.layout.state.pose
        x[where] = -x[where]
    return x
