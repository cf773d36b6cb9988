"""Linear maps of a free-floating robot: tip velocity, momentum, and the forces of a motion.

Where nothing acts on the base, its velocity follows from the conserved momentum and the joint rates; the
generalized Jacobian of Umetani & Yoshida (IEEE Transactions on Robotics and Automation 5, 1989) rests on
that. All maps are exact and come from the scene's compiled functions: momentum is linear in the velocities,
and accelerations are linear in the forces, so unit vectors give the matrices.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import wrist_rate_matrix
from dq_space_arm_env.dynamics.minimal import angle_rates, turn_by_quaternion
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from dq_space_arm_env.scene.start import unit_quaternions
from experts.problems.shooting_problem import FloatArray

PROJECTIONS = 30
"""Rounds in which forces of thrusters become non-negative."""
_PLANAR_MOMENTUM = (0, 1, 5)  # P_x, P_y, L_z
_SKEW = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)  # cross-product matrices of e_x, e_y, e_z


class TipJacobian(NamedTuple):
    """Dual velocity of the tip, in tip axes, angular then linear, per unit velocity of the robot's parts."""

    base: FloatArray  # per unit of the base's velocity, shape (B, 6, n_b)
    joints: FloatArray  # per joint rate, shape (B, 6, n)
    wrist: FloatArray  # per Euler rate of the wrist, shape (B, 6, 3); (B, 6, 0) without a wrist


class MomentumMap(NamedTuple):
    """Momentum of the system in inertial axes per unit velocity; a planar system has P_x, P_y and L_z."""

    base: FloatArray  # per unit of the base's velocity, shape (B, n_b, n_b)
    joints: FloatArray  # per joint rate, shape (B, n_b, n)


class ElasticGear(NamedTuple):
    """An elastic gear, its numbers the scene's nominal ones."""

    joint: int  # among the joint rates
    coordinate: int  # of the joint, among the states
    control: int | None  # of its motor; None if it has none
    angle: int  # of the motor, among the states
    rate: int  # likewise
    inertia: float  # of the rotor on the joint's side, kg m^2
    stiffness: float  # N m/rad


class FreeFloatingArm:
    """Linear maps of a scene's robot.

    Attributes:
        parameters: What varies in the scene, shape (n_p,).
        pose_entries: Those of the 8 numbers of the base's pose that a state stores.
        twist_entries: Those of the 6 numbers of the base's velocity that a state stores, n_b.
        momentum_entries: Those of the 6 numbers of the momentum that the base's velocity changes, n_b.
    """

    def __init__(self, kernels: Kernels, parameters: FloatArray | None = None) -> None:
        planar, entries = kernels.layout.planar, kernels.layout.state
        self.kernels = kernels
        self.parameters = kernels.parameters.nominal if parameters is None else parameters
        self.pose_entries = list(PLANAR_POSE if planar else range(8))
        self.twist_entries = list(PLANAR_TWIST if planar else range(6))
        self.momentum_entries = list(_PLANAR_MOMENTUM if planar else range(6))
        self.velocity_entries = [*indices(entries.base_velocity), *indices(entries.joint_rates)]
        self.elastic_gears = list(_elastic_gears(kernels))
        self._tree = KinematicTree.from_scene(kernels.scene)
        # Of each joint rate, the frame that it turns about one of its axes, z but for spherical joints.
        axes = {"": 2, " x": 0, " y": 1, " z": 2}
        self._turning = [(1 + link, axes[axis]) for link, axis in freedoms(kernels.scene.links)]

    def tip_jacobian(self, states: FloatArray, frames: FloatArray) -> TipJacobian:
        """Geometric Jacobian of the tip: columns Ad(q_{X/G}) of the axes in their frames X, (B, f, 8)."""
        layout = self.kernels.layout
        components = frames.transpose(2, 0, 1)
        rotation, position = poses.to_matrix(
            dq.multiply(dq.conjugate(components[:, :, -1:]), components)
        )  # of q_{X/G}, for every frame X
        axes = matrix_of(rotation)
        # Columns p x R: linear velocity per unit angular velocity of the frame.
        swept = np.tensordot(np.stack(position, axis=-1), _SKEW, axes=1) @ axes
        turning = np.concatenate([axes, swept], axis=-2)
        moving = np.concatenate([np.zeros_like(axes[:, 0]), axes[:, 0]], axis=-2)
        base = np.concatenate([turning[:, 0], moving], axis=-1)[:, :, self.twist_entries]
        joints = np.zeros((len(states), 6, len(self._turning)))
        for joint, (frame, axis) in enumerate(self._turning):
            joints[:, :, joint] = turning[:, frame, :, axis]
        wrist = np.zeros((len(states), 6, 0))
        if layout.has_wrist:
            rates = matrix_of(wrist_rate_matrix(list(states[:, layout.state.wrist_angles].T)))
            wrist = turning[:, -2] @ rates
        return TipJacobian(base, joints, wrist)

    def momentum_of_bodies(self, states: FloatArray) -> FloatArray:
        """Momentum at states (B, n_x) without that of wheels, inertial axes, (B, 6), N s and N m s."""
        states = states.copy()
        states[:, self.kernels.layout.state.wheel_momenta] = 0.0
        return self.kernels.momentum(states, p=self.parameters)

    def momentum_map(self, states: FloatArray) -> MomentumMap:
        """Momentum per unit velocity at states (B, n_x); their velocities do not matter."""
        moving = self.velocity_entries
        moved = np.repeat(states[:, None, :], len(moving), axis=1)
        moved[:, :, moving] = np.eye(len(moving))
        momenta = self.momentum_of_bodies(moved.reshape(-1, states.shape[1]))
        columns = momenta.reshape(len(states), len(moving), 6)[:, :, self.momentum_entries].transpose(0, 2, 1)
        n_base = len(self.twist_entries)
        return MomentumMap(columns[:, :, :n_base], columns[:, :, n_base:])

    def tip_load(self, states: FloatArray, system: MomentumMap) -> FloatArray:
        """Rate of change of the momentum by the scene's tip wrench, inertial axes, (B, n_b), N and N m.

        It is the momentum of the accelerations that the wrench adds.
        """
        if self.kernels.scene.tip_wrench is None:
            return np.zeros((len(states), len(self.momentum_entries)))
        still = np.zeros((len(states), self.kernels.n_u))
        p, no_wrench = self.parameters, np.zeros((len(states), 6))
        loaded = self.kernels.forward_dynamics(states, still, p=p)
        added = loaded - self.kernels.forward_dynamics(states, still, no_wrench, p=p)
        by_velocity = np.concatenate(system, axis=2)
        load: FloatArray = by_velocity @ added[:, :, None]
        return load[:, :, 0]

    def controls(self, states: FloatArray, accelerations: FloatArray) -> FloatArray:
        """Find the inputs whose accelerations are closest to given ones, (B, n_b + n), ignoring bounds."""
        control = self.kernels.layout.control
        acting = [
            i
            for part in (
                control.base_force,
                control.base_torque,
                control.joint_torque,
                control.wheel_torque,
                control.thruster_force,
            )
            for i in indices(part)
        ]
        inputs = np.zeros((len(states), 1 + len(acting), self.kernels.n_u))
        inputs[:, range(1, 1 + len(acting)), acting] = 1.0
        repeated = np.repeat(states[:, None], 1 + len(acting), axis=1)
        for gear in self.elastic_gears:  # a motor acts through the twist of its gear
            if gear.control is not None:
                repeated[:, 1 + acting.index(gear.control), gear.angle] += 1.0 / gear.stiffness
        repeated, forces = repeated.reshape(-1, states.shape[1]), inputs.reshape(-1, self.kernels.n_u)
        reached = self.kernels.forward_dynamics(repeated, forces, p=self.parameters)
        reached = reached.reshape(len(states), 1 + len(acting), -1)
        per_unit = reached[:, 1:] - reached[:, :1]
        missing = accelerations - reached[:, 0]
        normal, right = per_unit @ per_unit.transpose(0, 2, 1), per_unit @ missing[:, :, None]
        controls = np.zeros((len(states), self.kernels.n_u))
        if indices(control.wheel_torque) or indices(control.thruster_force):
            # There may be more inputs than accelerations: the least ones.
            controls[:, acting] = (np.linalg.pinv(normal, hermitian=True) @ right)[:, :, 0]
            jets = controls[:, control.thruster_force]
            controls[:, control.thruster_force] = self._non_negative(jets)
        else:
            controls[:, acting] = np.linalg.solve(normal, right)[:, :, 0]
        for gear in self.elastic_gears:
            if gear.control is not None:  # the rotor is to follow the joint
                turning = accelerations[:, len(self.twist_entries) + gear.joint]
                controls[:, gear.control] += gear.inertia * turning
        return controls

    def _non_negative(self, forces: FloatArray) -> FloatArray:
        """Forces of thrusters, (B, k), with nearly the same net force and torque, of which none is negative.

        Alternating projections on the two (Cheney & Goldstein, Proc. AMS 10, 1959).
        """
        thrusters = self.kernels.scene.actuators.thrusters
        if not thrusters:
            return forces
        wrenches = np.array([[*each.unit_direction, *each.moment] for each in thrusters])
        wanted, back = forces @ wrenches, np.linalg.pinv(wrenches)
        for _ in range(PROJECTIONS):
            forces = np.maximum(forces, 0.0)
            forces = forces + (wanted - forces @ wrenches) @ back
        return np.maximum(forces, 0.0)

    def angle_rates(self, angles: FloatArray, rates: FloatArray) -> FloatArray:
        """Rates of the joint angles of states, (..., n_a), at joint rates (..., n)."""
        coordinates = self._tree.coordinates(list(np.moveaxis(angles, -1, 0)))
        changes = angle_rates(self._tree, coordinates, list(np.moveaxis(rates, -1, 0)))
        return np.stack(changes, axis=-1) if changes else np.zeros(angles.shape)

    def joint_rates(self, angles: FloatArray, changes: FloatArray) -> FloatArray:
        """Joint rates, (B, n), with which joint angles, (B, n_a), change so fast, the other way round."""
        coordinates = zip(*(self._tree.coordinates(list(each.T)) for each in (angles, changes)), strict=True)
        found: list[FloatArray] = []
        for link, (angle, change) in zip(self._tree.links, coordinates, strict=True):
            if link.spherical is None:
                found.append(change)
            elif link.spherical == 0:
                turns = turn_by_quaternion(angle)
                found += [sum(a * b for a, b in zip(row, change, strict=True)) for row in turns]
        return np.stack(found, axis=-1) if found else np.zeros((len(angles), 0))

    def scale_quaternions(self, states: FloatArray) -> None:
        """Give the quaternions of spherical joints unit length, in states (..., n_x), in place."""
        for where in unit_quaternions(self.kernels.scene):
            states[..., where] /= np.linalg.norm(states[..., where], axis=-1, keepdims=True)

    def drive_along(self, states: FloatArray) -> None:
        """Let the motors behind elastic gears move as their joints do, in states (B, n_x), in place."""
        entries = self.kernels.layout.state
        for gear in self.elastic_gears:
            states[:, gear.angle] = states[:, gear.coordinate]
            states[:, gear.rate] = states[:, entries.joint_rates.start + gear.joint]


def _elastic_gears(kernels: Kernels) -> Iterator[ElasticGear]:
    layout, motors = kernels.layout, 0
    torques = dict(zip(layout.actuated_joints, indices(layout.control.joint_torque), strict=True))
    tree = KinematicTree.from_scene(kernels.scene)
    coordinates = tree.coordinates(indices(layout.state.joint_angles))
    for joint, (link, _) in enumerate(freedoms(kernels.scene.links)):
        part = kernels.scene.links[link]
        if part.motor is not None and part.motor.stiffness is not None:
            angle, rate = layout.state.motor_angles.start + motors, layout.state.motor_rates.start + motors
            inertia, stiffness = part.motor.reflected_inertia, part.motor.stiffness
            driven = torques.get(joint)
            yield ElasticGear(joint, coordinates[joint], driven, angle, rate, inertia, stiffness)
            motors += 1


def indices(part: slice) -> range:
    """Indices of a slice of a layout."""
    return range(part.start, part.stop)


def matrix_of(rows: Sequence[Sequence[Any]]) -> FloatArray:
    """Stack a matrix of numbers or arrays (...) into one array (..., n, m)."""
    shape = np.broadcast_shapes(*(np.shape(entry) for row in rows for entry in row))
    matrix = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            matrix[..., i, j] = entry
    return matrix
