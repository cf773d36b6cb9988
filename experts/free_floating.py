"""The linear maps of a robot whose base floats freely: tip velocity, momentum, and the forces of a motion.

Where nothing acts on the base its velocity follows from the momentum, which is conserved, and from the joint
rates; that is what the generalized Jacobian of Umetani & Yoshida (IEEE Transactions on Robotics and
Automation 5, 1989) stands on. All maps are exact and come from the scene's compiled functions: the momentum
is linear in the velocities and accelerations are linear in the forces, so unit vectors give the matrices.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematics import wrist_rate_matrix
from dq_space_arm_env.scene.start import PLANAR_POSE, PLANAR_TWIST
from experts.problem import FloatArray

_PLANAR_MOMENTUM = (0, 1, 5)  # P_x, P_y, L_z
_SKEW = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)  # the matrices of e_x x, e_y x, e_z x


class TipJacobian(NamedTuple):
    """Dual velocity of the tip in tip axes, angular then linear, per unit velocity of what moves it.

    Attributes:
        base: Per unit of the base's velocity, shape (B, 6, n_b).
        joints: Per joint rate, shape (B, 6, n).
        wrist: Per Euler rate of the wrist, shape (B, 6, 3); (B, 6, 0) without a wrist.
    """

    base: FloatArray
    joints: FloatArray
    wrist: FloatArray


class MomentumMap(NamedTuple):
    """Momentum of the system in inertial axes per unit velocity; a planar one keeps P_x, P_y and L_z.

    Attributes:
        base: Per unit of the base's velocity, shape (B, n_b, n_b).
        joints: Per joint rate, shape (B, n_b, n).
    """

    base: FloatArray
    joints: FloatArray


class FreeFloatingArm:
    """The linear maps of a scene's robot.

    Attributes:
        kernels: Compiled functions of the scene.
        pose_entries: Which of the 8 numbers of the base's pose a state stores.
        twist_entries: Which of the 6 numbers of the base's velocity a state stores; n_b of them.
        momentum_entries: Which of the 6 numbers of the momentum the base's velocity can change, n_b.
    """

    def __init__(self, kernels: Kernels) -> None:
        """Take a scene.

        Args:
            kernels: Compiled functions of the scene.
        """
        planar, entries = kernels.layout.planar, kernels.layout.state
        self.kernels = kernels
        self.pose_entries = list(PLANAR_POSE if planar else range(8))
        self.twist_entries = list(PLANAR_TWIST if planar else range(6))
        self.momentum_entries = list(_PLANAR_MOMENTUM if planar else range(6))
        self.velocity_entries = [*indices(entries.base_velocity), *indices(entries.joint_rates)]

    def tip_jacobian(self, states: FloatArray, frames: FloatArray) -> TipJacobian:
        """Geometric Jacobian of the tip: a column is Ad(q_{X/G}) of a joint's axis in the joint's frame X.

        Args:
            states: Shape (B, n_x).
            frames: Poses from `Kernels.frame_poses`, shape (B, frames, 8).

        Returns:
            The Jacobian.
        """
        layout = self.kernels.layout
        components = frames.transpose(2, 0, 1)
        rotation, position = poses.to_matrix(
            dq.multiply(dq.conjugate(components[:, :, -1:]), components)
        )  # of q_{X/G}, for every frame X
        axes = matrix_of(rotation)
        # The columns p x R: linear velocity per unit angular velocity of the frame.
        swept = np.tensordot(np.stack(position, axis=-1), _SKEW, axes=1) @ axes
        turning = np.concatenate([axes, swept], axis=-2)
        moving = np.concatenate([np.zeros_like(axes[:, 0]), axes[:, 0]], axis=-2)
        base = np.concatenate([turning[:, 0], moving], axis=-1)[:, :, self.twist_entries]
        n = layout.n_joints
        joints = turning[:, 1 : n + 1, :, 2].transpose(0, 2, 1)
        wrist = np.zeros((len(states), 6, 0))
        if layout.has_wrist:
            rates = matrix_of(wrist_rate_matrix(list(states[:, layout.state.wrist_angles].T)))
            wrist = turning[:, n + 1] @ rates
        return TipJacobian(base, joints, wrist)

    def momentum_map(self, states: FloatArray) -> MomentumMap:
        """Momentum per unit velocity: the momenta of unit velocities.

        Args:
            states: Shape (B, n_x); their velocities do not matter.

        Returns:
            The map.
        """
        moving = self.velocity_entries
        moved = np.repeat(states[:, None, :], len(moving), axis=1)
        moved[:, :, moving] = np.eye(len(moving))
        momenta = self.kernels.momentum(moved.reshape(-1, states.shape[1]))
        columns = momenta.reshape(len(states), len(moving), 6)[:, :, self.momentum_entries].transpose(0, 2, 1)
        n_base = len(self.twist_entries)
        return MomentumMap(columns[:, :, :n_base], columns[:, :, n_base:])

    def tip_load(self, states: FloatArray, system: MomentumMap) -> FloatArray:
        """Rate at which the scene's wrench at the tip changes the momentum.

        It is the momentum of the accelerations that the wrench adds.

        Args:
            states: Shape (B, n_x).
            system: The momentum map at these states.

        Returns:
            Rate of change of the momentum in inertial axes, shape (B, n_b), N and N m.
        """
        if self.kernels.scene.tip_wrench is None:
            return np.zeros((len(states), len(self.momentum_entries)))
        still = np.zeros((len(states), self.kernels.n_u))
        loaded = self.kernels.forward_dynamics(states, still)
        added = loaded - self.kernels.forward_dynamics(states, still, np.zeros((len(states), 6)))
        by_velocity = np.concatenate(system, axis=2)
        load: FloatArray = by_velocity @ added[:, :, None]
        return load[:, :, 0]

    def controls(self, states: FloatArray, accelerations: FloatArray) -> FloatArray:
        """Forces and torques with which the accelerations come as near as possible to given ones.

        Args:
            states: Shape (B, n_x).
            accelerations: Rates of base velocity and joint rates, shape (B, n_b + n), rad/s^2 and m/s^2.

        Returns:
            Controls without regard to their bounds, the wrist at rest, shape (B, n_u).
        """
        control = self.kernels.layout.control
        acting = [
            i
            for part in (control.base_force, control.base_torque, control.joint_torque)
            for i in indices(part)
        ]
        inputs = np.zeros((len(states), 1 + len(acting), self.kernels.n_u))
        inputs[:, range(1, 1 + len(acting)), acting] = 1.0
        repeated = np.repeat(states, 1 + len(acting), axis=0)
        reached = self.kernels.forward_dynamics(repeated, inputs.reshape(len(repeated), -1))
        reached = reached.reshape(len(states), 1 + len(acting), -1)
        per_unit = reached[:, 1:] - reached[:, :1]
        missing = accelerations - reached[:, 0]
        normal = per_unit @ per_unit.transpose(0, 2, 1)
        controls = np.zeros((len(states), self.kernels.n_u))
        controls[:, acting] = np.linalg.solve(normal, per_unit @ missing[:, :, None])[:, :, 0]
        return controls


def indices(part: slice) -> range:
    """The indices of a slice of a layout.

    Args:
        part: Entries of a state, tangent or input.

    Returns:
        Their indices.
    """
    return range(part.start, part.stop)


def matrix_of(rows: Sequence[Sequence[Any]]) -> FloatArray:
    """A matrix whose entries are arrays, or numbers, as one array.

    Args:
        rows: n rows of m entries, each a number or an array of shape (...).

    Returns:
        Shape (..., n, m).
    """
    shape = np.broadcast_shapes(*(np.shape(entry) for row in rows for entry in row))
    matrix = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            matrix[..., i, j] = entry
    return matrix
