"""The equations of motion of a scene, over CasADi symbols: what integrators advance and kernels evaluate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.algebra.vectors import add, cross, subtract
from dq_space_arm_env.compiler.symbols import column, columns, dense_entries, symbols, zeros
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.dynamics.kinematics import wrist_rotation
from dq_space_arm_env.dynamics.minimal import Accelerations, MassMatrix, Wrenches
from dq_space_arm_env.integrators.field import PoseCoordinates, spread
from dq_space_arm_env.kernels.momentum_balance import SpaceArmMomentum
from dq_space_arm_env.kernels.residual import Residual
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.start import PLANAR_POSE, PLANAR_TWIST

Scalar = Any
Matrix = Any

ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Motion:
    """Everything of a state but the pose.

    Attributes:
        joint_angles: n, rad.
        wrist_angles: psi, theta, phi, rad; empty without a wrist.
        angular: Angular velocity of the base, base axes, 3, rad/s.
        linear: Velocity of the base's center of mass, base axes, 3, m/s.
        joint_rates: n, rad/s.
    """

    joint_angles: Sequence[Scalar]
    wrist_angles: Sequence[Scalar]
    angular: Sequence[Scalar]
    linear: Sequence[Scalar]
    joint_rates: Sequence[Scalar]


@dataclass(frozen=True)
class Inputs:
    """Commanded forces and rates; what a scene has no actuator for is the number zero.

    Attributes:
        force: On the base, base axes, 3, N.
        torque: On the base, base axes, 3, N m.
        joint_torques: n, N m.
        wrist_rates: psi, theta, phi rates, rad/s; empty without a wrist.
    """

    force: Sequence[Scalar]
    torque: Sequence[Scalar]
    joint_torques: Sequence[Scalar]
    wrist_rates: Sequence[Scalar]


class SpaceArmField:
    """Vector field of a scene in minimal coordinates; implements `integrators.VectorField`."""

    name = "minimal"

    def __init__(self, chain: Chain, layout: StateLayout, parameters: Sequence[Scalar] = ()) -> None:
        """Describe the coordinates.

        Args:
            chain: Constants of the robot.
            layout: Where each quantity stands in state and input.
            parameters: Symbols among the constants of the robot.
        """
        self.chain = chain
        self.parameters = tuple(parameters)
        self.layout = layout
        self.n_x = layout.n_x
        self.n_u = layout.n_u
        self.n_t = layout.n_t
        self.n_y = self.n_x - layout.state.pose.stop
        twist = self._in_y(layout.state.base_velocity)
        self.rate_indices = (*twist, *self._in_y(layout.state.joint_rates))
        self.pose = PoseCoordinates(
            stored=PLANAR_POSE if chain.planar else tuple(range(8)),
            directions=PLANAR_TWIST if chain.planar else tuple(range(6)),
            twist_indices=twist,
        )

    @property
    def momentum_balance(self) -> SpaceArmMomentum:
        """The momentum of the whole system, and what changes it."""
        return SpaceArmMomentum(self)

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
            part(layout.state.joint_angles),
            part(layout.state.wrist_angles),
            twist[:3],
            twist[3:],
            part(layout.state.joint_rates),
        )

    def inputs(self, u: Sequence[Scalar]) -> Inputs:
        """Name the parts of an input, with zeros for absent actuators."""
        layout, planar = self.layout, self.chain.planar
        force, torque = list(u[layout.control.base_force]), list(u[layout.control.base_torque])
        torques: list[Scalar] = [0.0] * layout.n_joints
        for joint, value in zip(layout.actuated_joints, u[layout.control.joint_torque], strict=True):
            torques[joint] = value
        wrist = list(u[layout.control.wrist_rate])
        if not wrist and self.chain.wrist is not None:
            wrist = [0.0, 0.0, 0.0]
        return Inputs(
            force=spread(force, (0, 1) if planar else (0, 1, 2), 3) if force else ZERO,
            torque=spread(torque, (2,) if planar else (0, 1, 2), 3) if torque else ZERO,
            joint_torques=torques,
            wrist_rates=wrist,
        )

    def tip_forces(
        self, motion: Motion, rotations: Sequence[Any], wrench: Sequence[Scalar] | None
    ) -> Wrenches:
        """Generalized forces of a wrench at the tip.

        Args:
            motion: The motion.
            rotations: From `minimal.joint_rotations`.
            wrench: Force and torque at the tip in tip axes, 6, or None.

        Returns:
            The forces; zeros without a wrench.
        """
        n = len(self.chain.links)
        if wrench is None:
            return Wrenches(ZERO, ZERO, [0.0] * n, [(ZERO, ZERO)] * n)
        pose: Sequence[Scalar] = self.chain.tip.dual_quaternion
        if self.chain.wrist is not None:
            turned = dq.multiply(self.chain.wrist.dual_quaternion, wrist_rotation(motion.wrist_angles))
            pose = dq.multiply(turned, pose)
        return minimal.tip_wrench_forces(self.chain, rotations, *poses.to_matrix(pose), wrench)

    def _solve(
        self, motion: Motion, inputs: Inputs, wrench: Sequence[Scalar] | None
    ) -> tuple[Accelerations, MassMatrix, Sequence[Any]]:
        rotations = minimal.joint_rotations(self.chain, motion.joint_angles)
        mass_matrix = MassMatrix(self.chain, rotations)
        rest = Accelerations(ZERO, ZERO, [0.0] * len(self.chain.links))
        needed = minimal.inverse_dynamics(self.chain, rotations, motion.angular, motion.joint_rates, rest)
        tip = self.tip_forces(motion, rotations, wrench)
        passive = minimal.passive_torques(self.chain, motion.joint_angles, motion.joint_rates)
        accelerations = mass_matrix.solve(
            subtract(add(inputs.force, tip.force), needed.force),
            subtract(add(inputs.torque, tip.torque), needed.torque),
            [
                motor + other + load - bias
                for motor, other, load, bias in zip(
                    inputs.joint_torques, passive, tip.joints, needed.joints, strict=True
                )
            ],
        )
        return accelerations, mass_matrix, rotations

    def accelerations(
        self, y: Sequence[Scalar], u: Sequence[Scalar], wrench: Sequence[Scalar] | None = None
    ) -> list[Scalar]:
        """Dual acceleration of the base (free directions), then joint accelerations.

        Args:
            y: State without the pose.
            u: Input.
            wrench: Force and torque at the tip in tip axes, 6; None takes the scene's.

        Returns:
            Time derivatives of base twist (rad/s^2, m/s^2) and joint rates (rad/s^2).
        """
        motion = self.motion(y)
        wrench = self.chain.tip_wrench if wrench is None else wrench
        solved, _, _ = self._solve(motion, self.inputs(u), wrench)
        return self._dual(motion, solved)

    def _dual(self, motion: Motion, solved: Accelerations) -> list[Scalar]:
        """Accelerations in the paper's sense: the components of the linear velocity turn with the base."""
        turning = subtract(solved.linear, cross(motion.angular, motion.linear))
        dual = [*solved.angular, *turning]
        return [*(dual[i] for i in self.pose.directions), *solved.joints]

    def rates(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of y: rates of joints and wrist, base and joint accelerations."""
        return [*self.motion(y).joint_rates, *self.inputs(u).wrist_rates, *self.accelerations(y, u)]

    def reaction_wrenches(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """The paper's T: what each joint transmits to its link, in joint axes about the joint origin.

        Args:
            y: State without the pose.
            u: Input.

        Returns:
            fx, fy, fz [N], tx, ty [N m] for each joint, 5 n.
        """
        motion = self.motion(y)
        wrench = self.chain.tip_wrench
        solved, _, rotations = self._solve(motion, self.inputs(u), wrench)
        needed = minimal.inverse_dynamics(self.chain, rotations, motion.angular, motion.joint_rates, solved)
        tip = self.tip_forces(motion, rotations, wrench)
        result: list[Scalar] = []
        for (force, torque), (tip_force, tip_torque) in zip(needed.reactions, tip.reactions, strict=True):
            result += [*subtract(force, tip_force), *subtract(torque, tip_torque)[:2]]
        return result

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of y and its Jacobians.

        With M a = f - ID(y, 0), differentiating the inverse dynamics at the solved accelerations gives da =
        -M^-1 dID: far fewer operations than differentiating through the factorization.

        Args:
            y: State without the pose, n_y symbols.
            u: Input, n_u symbols.

        Returns:
            Rates (n_y), Jacobian with respect to y (n_y, n_y), Jacobian with respect to u (n_y, n_u).
        """
        free = symbols("v", self.n_y)
        motion, inputs = self.motion(y), self.inputs(u)
        solved, mass_matrix, _ = self._solve(motion, inputs, self.chain.tip_wrench)
        residual = self._residual(free)
        by_y = casadi.jacobian(residual.forces, column(*free))
        values = casadi.densify(column(*y, *solved.angular, *solved.linear, *solved.joints))
        by_y = casadi.substitute(by_y, column(*free, *residual.accelerations), values)
        responses = [
            self._response(mass_matrix, [-e for e in dense_entries(by_y[:, i])]) for i in range(self.n_y)
        ]
        response = columns(*(column(*entries) for entries in responses), rows=len(self.rate_indices))
        rates = [*motion.joint_rates, *inputs.wrist_rates, *self._dual(motion, solved)]
        angles_by_y, angles_by_u, turning_by_y = self._simple_jacobians(y)
        jacobian_y = casadi.vertcat(angles_by_y, response + turning_by_y)
        inputs_one_by_one = (self._input_response(mass_matrix, i) for i in range(self.n_u))
        by_u = columns(*inputs_one_by_one, rows=len(self.rate_indices))
        return rates, jacobian_y, casadi.vertcat(angles_by_u, by_u)

    def jacobian_along(
        self,
        y: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_y: Matrix,
        by_u: Matrix,
        direction: Sequence[Scalar],
    ) -> Matrix:
        """Derivative of by_y times a fixed direction v, from first derivatives that are there already.

        The residual R = M a + ID(y, 0) - f vanishes, and along v so does T = R_a b + R_y v with b the change
        of the accelerations along v. Differentiating T = 0 once more gives b_z = -M^-1 (T_y + T_a a_z), with
        z = (y, u): the factorization of M is not differentiated.

        Args:
            y: State without the pose, n_y expressions.
            u: Input, n_u expressions.
            rates: Time derivative of y at (y, u), n_y.
            by_y: Its Jacobian with respect to y, SX (n_y, n_y).
            by_u: Its Jacobian with respect to u, SX (n_y, n_u).
            direction: v, n_y.

        Returns:
            Derivative of by_y v with respect to (y, u), SX (n_y, n_y + n_u).
        """
        rows, n_y = list(self.rate_indices), self.n_y
        acceleration, by_state = self._inertial(y, rates, by_y, by_u)
        along = casadi.densify(casadi.mtimes(by_state[:, :n_y], column(*direction))).nonzeros()
        n = len(self.pose.directions)
        change = [*self.pose.full_twist(along[:n]), *along[n:]]
        by_accelerations, by_motion = self._residual(symbols("v", n_y)).along(
            y, acceleration, direction, change
        )
        total = casadi.horzcat(by_motion, zeros(by_motion.shape[0], self.n_u))
        total = total + casadi.mtimes(by_accelerations, by_state)
        mass_matrix = MassMatrix(self.chain, minimal.joint_rotations(self.chain, self.motion(y).joint_angles))
        sides = ([-entry for entry in dense_entries(total[:, i])] for i in range(total.shape[1]))
        responses = [self._response(mass_matrix, side) for side in sides]
        result = zeros(n_y, n_y + self.n_u)
        result[rows, :] = columns(*(column(*entries) for entries in responses), rows=len(rows))
        # omega x v is bilinear: its Jacobian changes along a direction like the Jacobian at that direction.
        result[rows, :n_y] = result[rows, :n_y] + self._simple_jacobians(direction)[2]
        return casadi.sparsify(result)

    def _inertial(
        self, y: Sequence[Scalar], rates: Sequence[Scalar], by_y: Matrix, by_u: Matrix
    ) -> tuple[list[Scalar], Matrix]:
        """Accelerations as seen by an inertial observer, and their Jacobian with respect to (y, u)."""
        rows = list(self.rate_indices)
        motion = self.motion(y)
        dual = self.pose.full_twist([rates[i] for i in self.pose.twist_indices])
        turning = cross(motion.angular, motion.linear)
        joints = [rates[i] for i in rows[len(self.pose.directions) :]]
        by_state = casadi.horzcat(by_y[rows, :] - self._simple_jacobians(y)[2], by_u[rows, :])
        # As seen by an inertial observer moving along, the velocity of the base changes no acceleration.
        linear = [
            i for i, axis in zip(self.pose.twist_indices, self.pose.directions, strict=True) if axis > 2
        ]
        by_state[:, linear] = zeros(len(rows), len(linear))
        return [*dual[:3], *add(dual[3:], turning), *joints], casadi.sparsify(by_state)

    def rates_hessian(
        self,
        y: Sequence[Scalar],
        u: Sequence[Scalar],
        rates: Sequence[Scalar],
        by_y: Matrix,
        by_u: Matrix,
        multiplier: Sequence[Scalar],
    ) -> Matrix:
        """Second derivative of multiplier . rates, from first derivatives that are there already.

        With w = M^-1 multiplier, differentiating w . (M a + ID(y, 0) - f) = 0 twice gives multiplier . a_zz =
        -[(w . ID)_zz + G' a_z + (G' a_z)'], G = d(M w)/dy: the factorization of M is not differentiated.

        Args:
            y: State without the pose, n_y expressions.
            u: Input, n_u expressions.
            rates: Time derivative of y at (y, u), n_y.
            by_y: Its Jacobian with respect to y, SX (n_y, n_y).
            by_u: Its Jacobian with respect to u, SX (n_y, n_u).
            multiplier: Weights of the rates, n_y.

        Returns:
            Hessian with respect to (y, u), symmetric SX (n_y + n_u, n_y + n_u).
        """
        rows = list(self.rate_indices)
        acceleration, by_state = self._inertial(y, rates, by_y, by_u)
        weights = self.pose.full_twist([multiplier[i] for i in self.pose.twist_indices])
        rotations = minimal.joint_rotations(self.chain, self.motion(y).joint_angles)
        response = MassMatrix(self.chain, rotations).solve(
            weights[3:], weights[:3], [multiplier[i] for i in rows[len(self.pose.directions) :]]
        )
        by_accelerations, curvature = self._residual(symbols("v", self.n_y)).weighted(
            y, acceleration, [*response.angular, *response.linear, *response.joints]
        )
        coupling = casadi.mtimes(by_accelerations.T, by_state)
        n_y, n_u = self.n_y, self.n_u
        coupling = casadi.vertcat(coupling, zeros(n_u, n_y + n_u))
        free = symbols("v", n_y)
        moving = self.motion(free)
        bilinear = casadi.dot(column(*weights[3:]), column(*cross(moving.angular, moving.linear)))
        curvature = curvature + casadi.jacobian(casadi.gradient(bilinear, column(*free)), column(*free))
        curvature = casadi.diagcat(curvature, zeros(n_u, n_u))
        return casadi.sparsify(-(curvature + coupling + coupling.T))

    def _simple_jacobians(self, y: Sequence[Scalar]) -> tuple[Matrix, Matrix, Matrix]:
        """Constant Jacobians of the angles' rates by y and u, and the Jacobian of -omega x v by y."""
        free_y = symbols("f", self.n_y)
        free_u = symbols("g", self.n_u)
        motion = self.motion(free_y)
        angles = column(*motion.joint_rates, *self.inputs(free_u).wrist_rates)
        turning = [*ZERO, *(-entry for entry in cross(motion.angular, motion.linear))]
        kept = column(*(turning[i] for i in self.pose.directions), *[0.0] * len(self.chain.links))
        by_y = casadi.substitute(
            casadi.jacobian(kept, column(*free_y)), column(*free_y), casadi.densify(column(*y))
        )
        return casadi.jacobian(angles, column(*free_y)), casadi.jacobian(angles, column(*free_u)), by_y

    def _residual(self, y: Sequence[Scalar]) -> Residual:
        """Forces that given accelerations need, less those that depend on y, over symbols."""
        n = len(self.chain.links)
        acceleration = symbols("a", 6 + n)
        motion = self.motion(y)
        rotations = minimal.joint_rotations(self.chain, motion.joint_angles)
        given = Accelerations(acceleration[:3], acceleration[3:6], acceleration[6:])
        needed = minimal.inverse_dynamics(self.chain, rotations, motion.angular, motion.joint_rates, given)
        tip = self.tip_forces(motion, rotations, self.chain.tip_wrench)
        passive = minimal.passive_torques(self.chain, motion.joint_angles, motion.joint_rates)
        joints = [
            bias - other - load for bias, other, load in zip(needed.joints, passive, tip.joints, strict=True)
        ]
        forces = [*subtract(needed.force, tip.force), *subtract(needed.torque, tip.torque), *joints]
        free = (*self.pose.directions, *range(6, 6 + n))
        return Residual(column(*forces), y, acceleration, free)

    def _response(self, mass_matrix: MassMatrix, forces: Sequence[Scalar]) -> list[Scalar]:
        """Accelerations (free directions, joints) caused by generalized forces (force, torque, joints)."""
        if all(casadi.SX(entry).is_zero() for entry in forces):
            return [0.0] * (len(self.pose.directions) + len(self.chain.links))
        solved = mass_matrix.solve(forces[:3], forces[3:6], forces[6:])
        dual = [*solved.angular, *solved.linear]
        return [*(dual[i] for i in self.pose.directions), *solved.joints]

    def _input_response(self, mass_matrix: MassMatrix, index: int) -> Matrix:
        unit = self.inputs([1.0 if i == index else 0.0 for i in range(self.n_u)])
        response = self._response(mass_matrix, [*unit.force, *unit.torque, *unit.joint_torques])
        return column(*response)
