"""Whether an integrator's time step follows the springs and dampers of a scene's joints."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.minimal import link_frames
from dq_space_arm_env.scene import INTEGRATORS, Scene

STIFF = "rodas4"
"""The integrator for joints that are too stiff for explicit ones."""
_MARGIN = 0.5  # of a limit: the inertia that a joint turns changes along the motion


class JointMotion(NamedTuple):
    """The fastest motions of the joints about their springs, at the start of a scene."""

    frequency: float  # of the stiffest swing, rad/s
    decay: float  # of the fastest relaxation in dampers and friction, 1/s


def joint_motion(scene: Scene) -> JointMotion:
    """Solve the eigenvalue problems of M^-1 K and M^-1 D, M the joints' inertia on the free base.

    Args:
        scene: A scene.

    Returns:
        Square root of the largest eigenvalue of the first, and largest of the second; zeros without any.
    """
    tree, links = KinematicTree.from_scene(scene), scene.links
    slopes = [
        link.damping + (0.0 if link.friction is None else link.friction.torque / link.friction.speed)
        for link in tree.links
    ]
    if not any(link.stiffness or slope for link, slope in zip(links, slopes, strict=True)):
        return JointMotion(0.0, 0.0)
    whole = np.array(mass_matrix(tree, link_frames(tree, scene.initial_state.joint_angles)), dtype=float)
    free = [2, 3, 4, *range(6, len(whole))] if tree.planar else range(len(whole))
    inverse = np.linalg.inv(whole[np.ix_(free, free)])[-len(links) :, -len(links) :]

    def largest(diagonal: list[float]) -> float:
        # M^-1 D is similar to the symmetric D^1/2 M^-1 D^1/2.
        root = np.sqrt(diagonal)
        return max(0.0, float(np.linalg.eigvalsh(root[:, None] * inverse * root)[-1]))

    frequency = sqrt(largest([link.stiffness for link in links]))
    return JointMotion(frequency, largest(slopes))


def _used(scene: Scene) -> float:
    """Share of the integrator's limits that the scene's time step takes; above 1 the steps blow up."""
    entry, motion, dt = INTEGRATORS[scene.simulation.integrator], joint_motion(scene), scene.simulation.dt
    return dt * max(motion.frequency / entry.imaginary_interval, motion.decay / entry.real_interval)


def stable(scene: Scene) -> Scene:
    """The scene, with an integrator for stiff joints where its own is near a limit.

    Args:
        scene: A scene.

    Returns:
        The scene itself, or one with integrator `rodas4`.
    """
    return scene.replace(simulation={"integrator": STIFF}) if _used(scene) > _MARGIN else scene


def advice(scene: Scene) -> str | None:
    """Say what a scene's integrator cannot follow, and what to take.

    Args:
        scene: A scene.

    Returns:
        A sentence; None where the steps are stable at the start.
    """
    used = _used(scene)
    if used <= 1.0:
        return None
    simulation, motion = scene.simulation, joint_motion(scene)
    parts = [
        words
        for words, rate in (
            (f"swing at {motion.frequency:.3g} rad/s", motion.frequency),
            (f"relax at {motion.decay:.3g} 1/s", motion.decay),
        )
        if rate > 0.0
    ]
    return (
        f"joints {' and '.join(parts)}, where {simulation.integrator} is unstable in steps of "
        f"{simulation.dt:g} s: set simulation.integrator to {STIFF}, or dt to "
        f"{_MARGIN * simulation.dt / used:.2g}"
    )
