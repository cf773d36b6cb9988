"""Path of a target that moves, stage by stage, as the environment takes it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.kernels.bound import walk
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import target_entries, velocity_entries
from dq_space_arm_env.scene.path import given_path

if TYPE_CHECKING:
    from dq_space_arm_env.kernels.library import KernelLibrary


def target_path(kernels: KernelLibrary, start: NDArray[Any]) -> NDArray[Any]:
    """Pose and velocity of the target's body from those at the start: what varies of them, a row a stage."""
    scene, steps = kernels.scene, kernels.scene.simulation.steps
    if not isinstance(scene.target.motion, Waypoints):
        return walk(kernels.kernel("next_target", lanes=1), start, {}, {}, steps)
    path, entries = given_path(scene, steps), list(target_entries(scene))
    pose = np.zeros(8)
    pose[entries] = start[: len(entries)]
    poses = np.stack(dq.multiply(tuple(pose.tolist()), tuple(path[:, :8].T)), axis=-1)
    return np.hstack([poses[:, entries], path[:, 8:][:, list(velocity_entries(scene))]])
