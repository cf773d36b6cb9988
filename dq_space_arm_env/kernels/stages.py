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
from dq_space_arm_env.task.step_report import MEMORY

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
    starts, _, resting, catches = kernels.staged
    ends = (*starts[1:], len(rows))
    velocity = layout.target_velocity_with(rows)
    changed, values = kernels.values_of_phases
    rows[:, changed] = values[np.searchsorted(starts, np.arange(len(rows)), side="right") - 1]
    before = (None, *resting[:-1])
    for begin, end, pose, rested, caught in zip(starts, ends, resting, before, catches, strict=True):
        if caught:  # from where the target is in the phase before
            twist = velocity[begin] if rested is None else np.zeros(6)
            rows[begin - 1, entries.indices(CATCH)] = [1.0, *twist[list(velocity_entries(scene))]]
        if moving and pose is not None:
            still = [*(pose[i] for i in target_entries(scene)), *[0.0] * len(velocity_entries(scene))]
            rows[begin:end, moving] = still


def present_parameters(
    kernels: KernelLibrary, parameters: NDArray[Any], memory: NDArray[Any]
) -> NDArray[Any]:
    """Parameters of the stages that episodes are in.

    Args:
        kernels: Those of the scene.
        parameters: At the start of each episode, shape (k, n_p), units of `parameters`.
        memory: Of each, as a step of the environment leaves it: shape (k, m), see `task.episode.observe`.

    Returns:
        Those with the target as it is now, and what is held; shape (k, n_p).
    """
    entries, found = kernels.parameters, parameters.copy()
    size = len(entries.moving)
    if entries.staged:
        starts, _, _, catches = kernels.staged
        stages = memory[:, 0].astype(np.int64)
        caught = [start for start, catch in zip(starts, catches, strict=True) if catch]
        for row in np.flatnonzero(np.isin(stages + 1, caught)):  # with the twist of the target then
            path = np.tile(found[row], (kernels.scene.simulation.steps + 1, 1))
            fill_stages(kernels, path)
            found[row] = path[stages[row]]
        changed, values = kernels.values_of_phases
        found[:, changed] = values[np.searchsorted(starts, stages, side="right") - 1]
        if caught:  # or missed, and not held since
            found[:, entries.indices("payload")] *= memory[:, len(MEMORY) + size][:, None]
    found[:, list(entries.moving)] = memory[:, len(MEMORY) : len(MEMORY) + size]
    return found


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
