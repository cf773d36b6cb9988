"""What the joints of a scene need to swing in free flight: the scale of its torques."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.minimal import link_frames
from dq_space_arm_env.scene import Scene, StateLayout

FloatArray = NDArray[np.float64]

FREQUENCY = 0.7
"""Natural frequency of a swing that takes seconds, rad/s."""


def swing_efforts(scene: Scene) -> list[float]:
    """Find the effort with which every joint swings by 1 rad (a slide by 1 m) within seconds, all at once.

    It accelerates the arm on a held base against the coupling of all joints, and pulls at the joint's
    damper: the hypotenuse of omega^2 sum_j |M_ij| and omega c_i with omega = 0.7 rad/s.

    Args:
        scene: A scene.

    Returns:
        For each degree of freedom of the joints, base to tip, N m (slides: N).
    """
    inertial = FREQUENCY**2 * np.abs(_mass_matrix(scene)[6:, 6:]).sum(axis=1)
    return [math.hypot(a, FREQUENCY * c) for a, c in zip(inertial.tolist(), _dampers(scene), strict=True)]


def swing_torques(scene: Scene, amplitude: float) -> FloatArray:
    """Find torques that swing all joints once there and back together, on the free base.

    Args:
        scene: A scene.
        amplitude: How far they go, roughly: masses are those of the start, rad (slides: m).

    Returns:
        Torques in the middle of each time step, for each degree of freedom, shape (steps, n), N m (N).
    """
    whole, steps = _mass_matrix(scene), scene.simulation.steps
    inertia = whole[6:, 6:] - whole[6:, :6] @ np.linalg.solve(whole[:6, :6], whole[:6, 6:])
    rate = 2.0 * np.pi / (steps * scene.simulation.dt)
    phases = 2.0 * np.pi * (np.arange(steps)[:, None] + 0.5) / steps
    ones = np.full(len(inertia), 0.5 * amplitude)  # angles are 1 - cos of the phase times this
    turning, moving = rate**2 * inertia @ ones, rate * np.array(_dampers(scene)) * ones
    torques: FloatArray = np.cos(phases) * turning + np.sin(phases) * moving
    return torques


def _mass_matrix(scene: Scene) -> FloatArray:
    tree, layout = KinematicTree.from_scene(scene), StateLayout.of(scene)
    start = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    return np.array(mass_matrix(tree, link_frames(tree, start)), dtype=float)


def _dampers(scene: Scene) -> list[float]:
    return [float(link.damping) for link in KinematicTree.from_scene(scene).links]
