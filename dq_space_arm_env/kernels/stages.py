"""Parameters of the stages of an episode: the path of a target that moves, and what phases change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.kernels.bound import walk
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import CATCH, target_entries, velocity_entries
from dq_space_arm_env.scene.path import given_path

if TYPE_CHECKING:
    from dq_space_arm_env.kernels.library import KernelLibrary


def fill_stages(kernels: KernelLibrary, rows: NDArray[Any]) -> None:
    """Change rows of parameters, (N + 1, n_p), that are all those at the start, to those of their stages."""
    scene, entries, layout = kernels.scene, kernels.parameters, kernels.layout
    moving = list(entries.moving)
    if moving:
        rows[:, moving] = target_path(kernels, rows[0, moving])
    if not scene.phases:
        return
    starts, values, resting, catches = scene.staged
    ends = (*starts[1:], len(rows))
    velocity = layout.target_velocity_with(rows)
    for name, each in values.items():
        for begin, end, value in zip(starts, ends, each, strict=True):
            rows[begin:end, entries.names.index(name)] = value
    for begin, end, pose, caught in zip(starts, ends, resting, catches, strict=True):
        if caught:
            twist = velocity[begin][list(velocity_entries(scene))]
            rows[begin - 1, entries.indices(CATCH)] = [1.0, *twist]
        if moving and pose is not None:
            still = [*(pose[i] for i in target_entries(scene)), *[0.0] * len(velocity_entries(scene))]
            rows[begin:end, moving] = still


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
