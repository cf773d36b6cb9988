"""Where the bodies of a scene are at its start, for tests of pictures."""

import numpy as np

from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import frame_poses


def start_poses(scene, joint_angles=None):
    """Poses of all frames at the scene's nominal start, from the equations themselves."""
    start = scene.initial_state
    angles = start.joint_angles if joint_angles is None else joint_angles
    frames = frame_poses(
        KinematicTree.from_scene(scene), start.base_pose.dual_quaternion, angles, start.wrist_angles
    )
    return np.array(frames, dtype=np.float64)
