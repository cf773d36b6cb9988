"""The equations of motion of a scene over plain scalars: accelerations and reactions from state and input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, quaternion
from dq_space_arm_env.algebra.vectors import add, cross, subtract
from dq_space_arm_env.dynamics import elastic_gears, minimal, reaction_wheels
from dq_space_arm_env.dynamics.forward import Inertia, forward_dynamics, inertia_of, reaction_wrenches
from dq_space_arm_env.dynamics.jets import burnt, net_wrench
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import wrist_rotation
from dq_space_arm_env.dynamics.mass_matrix import mass_matrix
from dq_space_arm_env.dynamics.minimal import Accelerations, Wrenches
from dq_space_arm_env.dynamics.vector_field import PoseCoordinates, spread
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST

Scalar = Any

ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Motion:
    """The state without the pose."""

    joint_angles: Sequence[Any]  # n, rad; of spherical joints see `KinematicTree.coordinates`
    wrist_angles: Sequence[Scalar]  # psi, theta, phi, rad; empty without a wrist
    angular: Sequence[Scalar]  # of the base, base axes, rad/s
    linear: Sequence[Scalar]  # of the base's center of mass, base axes, m/s
    joint_rates: Sequence[Scalar]  # n, rad/s
    motor_angles: Sequence[Scalar]  # of elastic joints, rad
    motor_rates: Sequence[Scalar]  # of elastic joints, rad/s
    previous_controls: Sequence[Scalar]  # those of the layout, N, N m, rad/s
    wheel_momenta: Sequence[Scalar]  # axial, N m s
    propellant: Sequence[Scalar]  # mass left in the tank, kg; empty without one
    drives: Sequence[Scalar]  # commands on their way and outputs, those of the layout's chains
    wrist_rates: Sequence[Scalar]  # psi, theta, phi, rad/s, where they are states; else empty


@dataclass(frozen=True)
class Inputs:
    """Commanded forces and rates; zero where a scene has no actuator."""

    force: Sequence[Scalar]  # on the base from outside, base axes, N
    torque: Sequence[Scalar]  # on the base from outside, base axes, N m
    joint_torques: Sequence[Scalar]  # n, N m
    wrist_rates: Sequence[Scalar]  # psi, theta, phi rates, rad/s; empty without a wrist
    wheel_torques: Sequence[Scalar] = ()  # of the motors on the wheels, N m
    propellant_rates: Sequence[Scalar] = ()  # change of what is left in the tank, kg/s


class EquationsOfMotion:
    """Accelerations and reactions of a scene's robot; y is the state without the pose, u the input."""

    def __init__(
        self,
        tree: KinematicTree,
        layout: StateLayout,
        parameters: Sequence[Scalar] = (),
        formulation: str | None = None,
    ) -> None:
        """Lay out the coordinates; `parameters` are symbols among the tree's constants.

        `formulation` is a name that `forward.inertia_of` knows; None takes the fastest.
        """
        self.tree = tree
        self._given_formulation = formulation
        self._formulation = formulation or "articulated_body"
        self.parameters = tuple(parameters)
        self.layout = layout
        self.n_x = layout.n_x
        self.n_u = layout.n_u
        self.n_t = layout.n_t
        self.n_y = self.n_x - layout.state.pose.stop
        twist = self._in_y(layout.state.base_velocity)
        self.body_rate_indices = (*twist, *self._in_y(layout.state.joint_rates))
        self.rate_indices = (*self.body_rate_indices, *self._in_y(layout.state.motor_rates))
        # Angles in the order of their rates, then what has no acceleration.
        state = layout.state
        others = (state.joint_angles, state.motor_angles, state.wrist_angles, state.wheel_momenta)
        self.shape_indices = tuple(index for part in others for index in self._in_y(part))
        self.pose = PoseCoordinates(
            stored=PLANAR_POSE if tree.planar else tuple(range(8)),
            directions=PLANAR_TWIST if tree.planar else tuple(range(6)),
            twist_indices=twist,
        )

    def _in_y(self, part: slice) -> tuple[int, ...]:
        shift = self.n_x - self.n_y
        return tuple(range(part.start - shift, part.stop - shift))

    def motion(self, y: Sequence[Scalar]) -> Motion:
        """Name the parts of y."""
        layout, shift = self.layout, self.n_x - self.n_y

        def part(where: slice) -> list[Scalar]:
            return list(y[where.start - shift : where.stop - shift])

        twist = self.pose.full_twist(part(layout.state.base_velocity))
        return Motion(
            self.tree.coordinates(part(layout.state.joint_angles)),
            part(layout.state.wrist_angles),
            twist[:3],
            twist[3:],
            part(layout.state.joint_rates),
            part(layout.state.motor_angles),
            part(layout.state.motor_rates),
            part(layout.state.actuators),
            part(layout.state.wheel_momenta),
            part(layout.state.propellant),
            part(layout.state.drives),
            self._wrist_rates(part(layout.state.drives)),
        )

    def acting(self, drives: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """What acts at the start of a step: outputs of lagging actuators, commands that have waited, or u."""
        acting, start = list(u), 0
        for chain in self.layout.chains:
            output = start if chain.time_constant is None else start + chain.delay
            acting[chain.control] = drives[output]
            start += len(chain.names)
        return acting

    def _wrist_rates(self, drives: Sequence[Scalar]) -> list[Scalar]:
        where = self.layout.control.wrist_rate
        if not any(where.start <= chain.control < where.stop for chain in self.layout.chains):
            return []
        return self.acting(drives, [0.0] * self.n_u)[where]

    def inputs(self, u: Sequence[Scalar]) -> Inputs:
        """Name the parts of u, with zeros for absent actuators."""
        layout, planar = self.layout, self.tree.planar
        force, torque = list(u[layout.control.base_force]), list(u[layout.control.base_torque])
        torques: list[Scalar] = [0.0] * layout.n_joints
        for joint, value in zip(layout.actuated_joints, u[layout.control.joint_torque], strict=True):
            torques[joint] = value
        wrist = list(u[layout.control.wrist_rate])
        if not wrist and self.tree.wrist is not None:
            wrist = [0.0, 0.0, 0.0]
        net_force: Sequence[Scalar] = spread(force, (0, 1) if planar else (0, 1, 2), 3) if force else ZERO
        net_torque: Sequence[Scalar] = spread(torque, (2,) if planar else (0, 1, 2), 3) if torque else ZERO
        jets = list(u[layout.control.thruster_force])
        if self.tree.jets:
            by_jets = net_wrench(self.tree.jets, jets)
            net_force, net_torque = add(net_force, by_jets[0]), add(net_torque, by_jets[1])
        return Inputs(
            force=net_force,
            torque=net_torque,
            joint_torques=torques,
            wrist_rates=wrist,
            wheel_torques=list(u[layout.control.wheel_torque]),
            propellant_rates=[] if self.tree.tank is None else [-burnt(self.tree.jets, jets)],
        )

    def loaded(self, motion: Motion) -> KinematicTree:
        """The tree with what is left of the propellant in its base."""
        return self.tree.with_propellant(motion.propellant)

    def _tip(self, motion: Motion) -> tuple[Any, Any]:
        """Rotation and position of the tip in the frame of the body that carries it."""
        pose: Sequence[Scalar] = self.tree.tip.dual_quaternion
        if self.tree.wrist is not None:
            turned = dq.multiply(self.tree.wrist.dual_quaternion, wrist_rotation(motion.wrist_angles))
            pose = dq.multiply(turned, pose)
        return poses.to_matrix(pose)

    def tip_forces(self, motion: Motion, frames: Sequence[Any], wrench: Sequence[Scalar] | None) -> Wrenches:
        """Generalized forces of a wrench at the tip, in tip axes; zeros without one."""
        n = len(self.tree.links)
        if wrench is None:
            return Wrenches(ZERO, ZERO, [0.0] * n, [(ZERO, ZERO)] * n)
        return minimal.tip_wrench_forces(self.tree, frames, *self._tip(motion), wrench)

    def _acting(self, motion: Motion, inputs: Inputs, wrench: Sequence[Scalar] | None) -> list[Any]:
        """External force and torque on base and links, in their frames."""
        torque = inputs.torque
        if self.tree.wheels:
            torque = add(torque, self._wheel_torque(motion, inputs.wheel_torques))
        acting: list[Any] = [(inputs.force, torque), *[(ZERO, ZERO)] * len(self.tree.links)]
        if wrench is not None:
            force, torque = minimal.shift_wrench(*self._tip(motion), wrench[:3], wrench[3:])
            body = self.tree.tip_body
            acting[body] = (add(acting[body][0], force), add(acting[body][1], torque))
        return acting

    def _wheel_torque(self, motion: Motion, torques: Sequence[Scalar] = ()) -> Sequence[Scalar]:
        """Torque of the wheels on the base, base axes."""
        return reaction_wheels.torque_on_base(self.tree.wheels, torques, motion.wheel_momenta, motion.angular)

    def _inertia(self, motion: Motion, *, many: bool = False) -> Inertia:
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        return inertia_of(self._formulation, self.loaded(motion), frames, many=many)

    def _solve(
        self, motion: Motion, inputs: Inputs, wrench: Sequence[Scalar] | None, inertia: Inertia
    ) -> Accelerations:
        return forward_dynamics(self.loaded(motion), inertia, *self._driven(motion, inputs, wrench))

    def _driven(self, motion: Motion, inputs: Inputs, wrench: Sequence[Scalar] | None) -> tuple[Any, ...]:
        """Rotations of the joints, angular velocity, joint rates, external wrenches and joint torques."""
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        pairs = zip(self._on_links(inputs.joint_torques), self.passive_torques(motion), strict=True)
        torques = [motor + other for motor, other in pairs]
        return frames, motion.angular, motion.joint_rates, self._acting(motion, inputs, wrench), torques

    def passive_torques(self, motion: Motion) -> list[Scalar]:
        """Torques on the links that no motor commands, n: of springs, dampers, friction and elastic gears."""
        passive = minimal.passive_torques(self.tree, motion.joint_angles, motion.joint_rates)
        return [own + gear for own, gear in zip(passive, self._transmitted(motion), strict=True)]

    def motor_torques(self, motion: Motion, joint_torques: Sequence[Scalar]) -> list[Scalar]:
        """Torques on the rotors of elastic joints, on the joints' side, N m."""
        transmitted = self._transmitted(motion)
        return elastic_gears.motor_torques(self.tree, transmitted, motion.motor_rates, joint_torques)

    def _transmitted(self, motion: Motion) -> list[Scalar]:
        joints, motors = (motion.joint_angles, motion.joint_rates), (motion.motor_angles, motion.motor_rates)
        return elastic_gears.transmitted_torques(self.tree, *joints, *motors)

    def _on_links(self, joint_torques: Sequence[Scalar]) -> list[Scalar]:
        """Motor torques that act on links directly: through rigid gears."""
        pairs = zip(self.tree.links, joint_torques, strict=True)
        return [0.0 if link.elastic is not None else torque for link, torque in pairs]

    def accelerations(
        self, y: Sequence[Scalar], u: Sequence[Scalar], wrench: Sequence[Scalar] | None = None
    ) -> list[Scalar]:
        """Dual acceleration of the base (free directions), then joint accelerations, by (20) in minimal form.

        A `wrench` at the tip, 6 in tip axes, replaces the scene's.
        """
        motion = self.motion(y)
        wrench = self.tree.tip_wrench if wrench is None else wrench
        solved = self._solve(motion, self.inputs(u), wrench, self._inertia(motion))
        return self._dual(motion, solved)

    def _dual(self, motion: Motion, solved: Accelerations) -> list[Scalar]:
        """Accelerations in the paper's sense, v' = a - omega x v: components in axes that turn along."""
        turning = subtract(solved.linear, cross(motion.angular, motion.linear))
        dual = [*solved.angular, *turning]
        return [*(dual[i] for i in self.pose.directions), *solved.joints]

    def mass_matrix(self, y: Sequence[Scalar]) -> list[list[Scalar]]:
        """Mass matrix by the accelerations (free directions, joints), symmetric."""
        motion = self.motion(y)
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        free = (*self.pose.directions, *range(6, 6 + len(self.tree.links)))
        whole = mass_matrix(self.loaded(motion), frames)
        return [[whole[i][j] for j in free] for i in free]

    def bias_forces(self, y: Sequence[Scalar]) -> list[Scalar]:
        """Generalized forces (free directions, joints) that keep the accelerations (20) zero, without a load.

        Where v' = 0, an inertial observer sees the acceleration omega x v.
        """
        motion = self.motion(y)
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        given = Accelerations(ZERO, cross(motion.angular, motion.linear), [0.0] * len(self.tree.links))
        rates = motion.angular, motion.joint_rates
        needed = minimal.inverse_dynamics(self.loaded(motion), frames, *rates, given)
        passive = self.passive_torques(motion)
        torque = subtract(needed.torque, self._wheel_torque(motion)) if self.tree.wheels else needed.torque
        dual = [*torque, *needed.force]
        joints = [bias - other for bias, other in zip(needed.joints, passive, strict=True)]
        return [*(dual[i] for i in self.pose.directions), *joints]

    def rates(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of y: rates of joints and wrist, accelerations, motors', wheels', the tank's."""
        motion, inputs = self.motion(y), self.inputs(u)
        bodies = [*self.angle_rates(motion), *inputs.wrist_rates, *self.accelerations(y, u)]
        motors = self.motor_motion(motion, inputs)
        return [*bodies, *motors, *inputs.wheel_torques, *inputs.propellant_rates]

    def angle_rates(self, motion: Motion) -> list[Scalar]:
        """Time derivative of the joints' coordinates."""
        return minimal.angle_rates(self.tree, motion.joint_angles, motion.joint_rates)

    def with_unit_quaternions(self, x: Sequence[Scalar]) -> list[Scalar]:
        """A state whose spherical joints have quaternions of unit length, which rounding and steps change."""
        where, unit = self.layout.state.joint_angles, list[Scalar]()
        for link, angle in zip(self.tree.links, self.tree.coordinates(x[where]), strict=True):
            if link.spherical is None:
                unit.append(angle)
            elif link.spherical == 0:
                unit += quaternion.normalize(angle)
        return [*x[: where.start], *unit, *x[where.stop :]]

    def motor_motion(self, motion: Motion, inputs: Inputs) -> list[Scalar]:
        """Time derivative of angles and rates of the motors of elastic joints."""
        torques = self.motor_torques(motion, inputs.joint_torques)
        pairs = zip(torques, elastic_gears.elastic_joints(self.tree), strict=True)
        return [*motion.motor_rates, *(torque / gear.inertia for torque, (_, gear) in pairs)]

    def reaction_wrenches(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """The paper's T (21): fx, fy, fz [N], tx, ty [N m] that each joint transmits, in joint axes, 5 n.

        A prismatic joint transmits fx, fy [N], tx, ty, tz [N m], a spherical one fx, fy, fz.
        """
        motion = self.motion(y)
        driven = self._driven(motion, self.inputs(u), self.tree.tip_wrench)
        reactions = reaction_wrenches(self.loaded(motion), *driven)
        transmitted: list[Scalar] = []
        for link, (force, torque) in zip(self.tree.links, reactions, strict=True):
            if link.spherical is None:
                transmitted += (*force, *torque[:2]) if link.screw.turn else (*force[:2], *torque)
            elif link.spherical == 2:  # whose frame is the link's
                transmitted += force
        return transmitted

    def _missing_wrenches(self, motion: Motion, given: Accelerations) -> tuple[list[Any], list[Scalar]]:
        """Force and torque on base and links that given accelerations need besides the tip's wrench.

        Besides, the torques that the joints' rotors need.
        """
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        rates = motion.angular, motion.joint_rates
        needed, rotors = minimal.body_wrenches(self.loaded(motion), frames, *rates, given)
        acting = self._acting(motion, Inputs(ZERO, ZERO, [], []), self.tree.tip_wrench)
        pairs = zip(needed, acting, strict=True)
        return [(subtract(a[0], b[0]), subtract(a[1], b[1])) for a, b in pairs], rotors

    def _reactions(self, motion: Motion, solved: Accelerations) -> Sequence[Any]:
        """Force and torque that each joint transmits to its link, in joint axes."""
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        missing, _ = self._missing_wrenches(motion, solved)
        return minimal.passed_to_base(self.tree, frames, missing).reactions
