"""Whether an integrator's time step follows the springs and dampers of a scene's joints."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from dq_space_arm_env.dynamics.elastic_gears import elastic_joints
from dq_space_arm_env.dynamics.kinematic_tree import Friction, KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.minimal import link_frames
from dq_space_arm_env.scene import INTEGRATORS, Scene, StateLayout

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
    tank = scene.actuators.tank
    tree = KinematicTree.from_scene(scene).with_propellant(() if tank is None else (tank.propellant,))
    links, gears = tree.links, elastic_joints(tree)
    slopes = [link.damping + _slope(link.friction) for link in links]
    if not gears and not any(link.stiffness or slope for link, slope in zip(links, slopes, strict=True)):
        return JointMotion(0.0, 0.0)
    layout = StateLayout.of(scene)
    start = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    whole = np.array(mass_matrix(tree, link_frames(tree, start)), dtype=float)
    free = [2, 3, 4, *range(6, len(whole))] if tree.planar else range(len(whole))
    n = len(links)
    inverse = np.zeros((n + len(gears),) * 2)  # of joints, and of the motors behind elastic gears
    inverse[:n, :n] = np.linalg.inv(whole[np.ix_(free, free)])[-n:, -n:]
    for motor, (_, gear) in enumerate(gears, n):
        inverse[motor, motor] = 1.0 / gear.inertia

    def largest(of_joints: list[float], of_gears: list[float], of_motors: list[float]) -> float:
        slopes = np.diag([*of_joints, *of_motors])
        for motor, ((joint, _), slope) in enumerate(zip(gears, of_gears, strict=True), n):
            slopes[np.ix_([joint, motor], [joint, motor])] += slope * np.array([[1.0, -1.0], [-1.0, 1.0]])
        # M^-1 D has the eigenvalues of the symmetric L' D L with M^-1 = L L'.
        root = np.linalg.cholesky(inverse)
        return max(0.0, float(np.linalg.eigvalsh(root.T @ slopes @ root)[-1]))

    springs = [link.stiffness for link in links], [gear.stiffness for _, gear in gears], [0.0] * len(gears)
    dampers = slopes, [gear.damping for _, gear in gears], [_slope(gear.friction) for _, gear in gears]
    return JointMotion(sqrt(largest(*springs)), largest(*dampers))


def _slope(friction: Friction | None) -> float:
    """Damping by friction at rest, N m s/rad."""
    return 0.0 if friction is None else float(friction.torque / friction.speed)


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
    unstable = _used(scene) > _MARGIN and INTEGRATORS[STIFF].takes(scene)
    return scene.replace(simulation={"integrator": STIFF}) if unstable else scene


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
    stiff = f"integrator to {STIFF}, or " if INTEGRATORS[STIFF].takes(scene) else ""
    return (
        f"joints {' and '.join(parts)}, where {simulation.integrator} is unstable in steps of "
        f"{simulation.dt:g} s: set simulation.{stiff}dt to {_MARGIN * simulation.dt / used:.2g}"
    )
