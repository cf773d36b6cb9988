"""A scene's states and inputs as other engines want them: full vectors, whatever the scene leaves out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Kernels, Scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from experts.problems.shooting_problem import FloatArray


def beyond_rigid_bodies(scene: Scene) -> list[str]:
    """What a scene has besides rigid bodies on joints that turn, with ideal torques and a net force."""
    actuators = scene.actuators
    has = {
        "joints that slide or turn about several axes": any(x.joint_type != "revolute" for x in scene.links),
        "motors": any(link.motor is not None for link in scene.links),
        "wheels": actuators.wheels is not None,
        "thrusters": actuators.thrusters is not None,
    }
    return [words for words, applies in has.items() if applies]


def beyond_the_robot(scene: Scene) -> list[str]:
    """The same for engines, which are given the robot of the start, without what it catches later."""
    catches = any(phase.catch is not None for phase in scene.phases)
    return beyond_rigid_bodies(scene) + ["a payload that is caught"] * catches


@dataclass(frozen=True)
class Robot:
    """States and inputs, a row for each state; a planar base has zeros where it cannot move."""

    rotation: FloatArray  # attitude of the base as a unit quaternion, scalar first, shape (B, 4)
    to_inertial: FloatArray  # the same as rotation matrices, shape (B, 3, 3)
    position: FloatArray  # position of the base's center of mass, inertial axes, shape (B, 3), m
    angular: FloatArray  # angular velocity of the base, base axes, shape (B, 3), rad/s
    linear: FloatArray  # velocity of the base, base axes, shape (B, 3), m/s
    angles: FloatArray  # joint angles, shape (B, n), rad
    rates: FloatArray  # joint rates, shape (B, n), rad/s
    force: FloatArray  # on the base, base axes, shape (B, 3), N
    torque: FloatArray  # on the base, base axes, shape (B, 3), N m
    motors: FloatArray  # joint torques, shape (B, n), N m

    @classmethod
    def of(cls, kernels: Kernels, x: FloatArray, u: FloatArray) -> Robot:
        """Name the parts of states and inputs."""
        layout, count = kernels.layout, len(x)
        state, control = layout.state, layout.control
        pose, twist = np.zeros((count, 8)), np.zeros((count, 6))
        pose[:, PLANAR_POSE if layout.planar else slice(8)] = x[:, state.pose]
        twist[:, PLANAR_TWIST if layout.planar else slice(6)] = x[:, state.base_velocity]
        force, torque, motors = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, layout.n_joints))
        forces, torques = u[:, control.base_force], u[:, control.base_torque]
        force[:, : forces.shape[1]] = forces
        torque[:, 3 - torques.shape[1] :] = torques  # a planar base's only torque is the one about z
        motors[:, list(layout.actuated_joints)] = u[:, control.joint_torque]
        return cls(
            rotation=pose[:, :4],
            to_inertial=np.array([poses.to_matrix(tuple(row))[0] for row in pose.tolist()]),
            position=np.array([poses.position(tuple(row)) for row in pose.tolist()]),
            angular=twist[:, :3],
            linear=twist[:, 3:],
            angles=x[:, state.joint_angles],
            rates=x[:, state.joint_rates],
            force=force,
            torque=torque,
            motors=motors,
        )
