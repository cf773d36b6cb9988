"""What the joints of a scene need to swing in free flight: the scale of its torques."""

from __future__ import annotations

import math

import numpy as np

from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.minimal import link_frames
from dq_space_arm_env.scene import Scene, StateLayout

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
    tree, layout = KinematicTree.from_scene(scene), StateLayout.of(scene)
    start = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    matrix = np.array(mass_matrix(tree, link_frames(tree, start)), dtype=float)[6:, 6:]
    inertial = FREQUENCY**2 * np.abs(matrix).sum(axis=1)
    dampers = [link.damping for link in tree.links]
    return [math.hypot(a, FREQUENCY * c) for a, c in zip(inertial.tolist(), dampers, strict=True)]
