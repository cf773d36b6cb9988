"""Where the bodies of a scene are at its start, for tests of pictures."""

import numpy as np

from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import frame_poses
from dq_space_arm_env.scene import StateLayout


def start_poses(scene, joint_angles=None):
    """Poses of all frames at the scene's nominal start, from the equations themselves."""
    if joint_angles is not None:
        scene = scene.replace({"initial_state.joint_angles": list(joint_angles)})
    start, tree, layout = scene.initial_state, KinematicTree.from_scene(scene), StateLayout.of(scene)
    angles = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    frames = frame_poses(tree, start.base_pose.dual_quaternion, angles, start.wrist_angles)
    return np.array(frames, dtype=np.float64)
