"""A scene's equations of motion as a vector field over CasADi symbols, with exact derivatives to order 2.

Derivatives come from the inverse dynamics at the solved accelerations: M a + ID(y, 0) = f is differentiated,
never its solution, which only solves for more right-hand sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi

from dq_space_arm_env.algebra.symbolic import column, columns, dense_entries, symbols, zeros
from dq_space_arm_env.algebra.vectors import add, cross, scale, subtract
from dq_space_arm_env.dynamics import minimal, reaction_wheels
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion
from dq_space_arm_env.dynamics.forward import Inertia
from dq_space_arm_env.dynamics.minimal import ZERO, Accelerations
from dq_space_arm_env.dynamics.momentum_balance import SpaceArmMomentum
from dq_space_arm_env.dynamics.residual import Residual

Scalar = Any
Matrix = Any


class _SimpleJacobians(NamedTuple):
    """Jacobians of what is written in closed form."""

    angles_by_y: Matrix  # rates of joint and wrist angles, constant but for quaternions
    angles_by_u: Matrix
    turning_by_y: Matrix  # -omega x v, rows of the accelerations of base and joints
    motors_by_y: Matrix  # rates and accelerations of the motors of elastic joints
    motors_by_u: Matrix


class SpaceArmField(EquationsOfMotion):
    """Vector field of a scene in minimal coordinates."""

    name = "minimal"

    @property
    def momentum_balance(self) -> SpaceArmMomentum:
        """Momentum of the whole system, and the external wrench that changes it."""
        return SpaceArmMomentum(self)

    @property
    def of_motion(self) -> SpaceArmField:
        """The same equations without what actuators keep from step to step, which no equation moves."""
        return SpaceArmField(self.tree, self.layout.of_motion, self.parameters, self._given_formulation)

    @property
    def beside_momentum(self) -> SpaceArmField:
        """The same equations, formulated for use beside the momentum, which needs the mass matrix anyway."""
        formulation = self._given_formulation or "minimal_coordinates"
        return SpaceArmField(self.tree, self.layout, self.parameters, formulation)

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of y and its Jacobians by y and u.

        With M a = f - ID(y, 0), differentiating the inverse dynamics at the solved accelerations gives da =
        -M^-1 dID: far fewer operations than differentiating through the factorization.
        """
        motion, inputs = self.motion(y), self.inputs(u)
        inertia = self._inertia(motion, many=True)
        solved = self._solve(motion, inputs, self.tree.tip_wrench, inertia)
        by_y = self._body_residual_jacobian(y, solved)
        # da/dy = -M^-1 dID/dy, column by column; da/du = M^-1 df/du.
        responses = [
            self._response(inertia, [-e for e in dense_entries(by_y[:, i])]) for i in range(self.n_y)
        ]
        response = columns(*(column(*entries) for entries in responses), rows=len(self.body_rate_indices))
        rates = [*self.angle_rates(motion), *inputs.wrist_rates, *self._dual(motion, solved)]
        rates += [*self.motor_motion(motion, inputs), *inputs.wheel_torques, *inputs.propellant_rates]
        simple, stored = self._simple_jacobians(y), self._store_jacobians()
        jacobian_y = casadi.vertcat(
            simple.angles_by_y, response + simple.turning_by_y, simple.motors_by_y, stored[0]
        )
        inputs_one_by_one = (self._input_response(inertia, i) for i in range(self.n_u))
        by_u = columns(*inputs_one_by_one, rows=len(self.body_rate_indices))
        return rates, jacobian_y, casadi.vertcat(simple.angles_by_u, by_u, simple.motors_by_u, stored[1])

    def _inertial(
        self, y: Sequence[Scalar], rates: Sequence[Scalar], by_y: Matrix, by_u: Matrix
    ) -> tuple[list[Scalar], Matrix]:
        """Accelerations seen by an inertial observer, and their Jacobian with respect to (y, u)."""
        rows = list(self.body_rate_indices)
        motion = self.motion(y)
        dual = self.pose.full_twist([rates[i] for i in self.pose.twist_indices])
        turning = cross(motion.angular, motion.linear)
        joints = [rates[i] for i in rows[len(self.pose.directions) :]]
        by_state = casadi.horzcat(by_y[rows, :] - self._simple_jacobians(y).turning_by_y, by_u[rows, :])
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
        """Second derivative of multiplier . rates with respect to (y, u), symmetric, from first derivatives.

        With w = M^-1 multiplier, differentiating w . (M a + ID(y, 0) - f) = 0 twice gives multiplier . a_zz =
        -[(w . ID)_zz + G' a_z + (G' a_z)'], G = d(M w)/dy: the factorization of M is not differentiated.
        """
        rows = list(self.body_rate_indices)
        acceleration, by_state = self._inertial(y, rates, by_y, by_u)
        # w = M^-1 multiplier: M is symmetric.
        weights = self.pose.full_twist([multiplier[i] for i in self.pose.twist_indices])
        response = self._inertia(self.motion(y), many=True).solve(
            weights[3:], weights[:3], [multiplier[i] for i in rows[len(self.pose.directions) :]]
        )
        by_accelerations, curvature = self._residual(symbols("v", self.n_y)).weighted(
            y, acceleration, [*response.angular, *response.linear, *response.joints]
        )
        coupling = casadi.mtimes(by_accelerations.T, by_state)
        n_y, n_u = self.n_y, self.n_u
        coupling = casadi.vertcat(coupling, zeros(n_u, n_y + n_u))
        # The paper's accelerations are those of an inertial observer less omega x v, which is bilinear.
        free = symbols("v", n_y)
        moving = self.motion(free)
        bilinear = casadi.dot(column(*weights[3:]), column(*cross(moving.angular, moving.linear)))
        curvature = curvature + casadi.jacobian(casadi.gradient(bilinear, column(*free)), column(*free))
        # Friction is all that bends in the equations of motors behind elastic gears.
        motors = column(*self.motor_motion(moving, self.inputs([0.0] * n_u)))
        state = self.layout.state
        moved = [*self._in_y(state.motor_angles), *self._in_y(state.motor_rates)]
        theirs = column(*(multiplier[i] for i in moved))
        bent = casadi.hessian(casadi.dot(theirs, motors), column(*free))[0]
        if self.tree.has_spherical:  # q' = q omega / 2
            angles = self._in_y(state.joint_angles)
            turned = casadi.dot(column(*(multiplier[i] for i in angles)), column(*self.angle_rates(moving)))
            bent = bent + casadi.hessian(turned, column(*free))[0]
        curvature = curvature - casadi.substitute(bent, column(*free), casadi.densify(column(*y)))
        curvature = casadi.diagcat(curvature, zeros(n_u, n_u))
        return casadi.sparsify(-(curvature + coupling + coupling.T))

    def _simple_jacobians(self, y: Sequence[Scalar]) -> _SimpleJacobians:
        """Jacobians of all but the accelerations of base and joints, and of -omega x v."""
        free_y = symbols("f", self.n_y)
        free_u = symbols("g", self.n_u)
        motion, inputs = self.motion(free_y), self.inputs(free_u)
        angles = column(*self.angle_rates(motion), *inputs.wrist_rates)
        motors = column(*self.motor_motion(motion, inputs))
        turning = [*ZERO, *(-entry for entry in cross(motion.angular, motion.linear))]
        kept = column(*(turning[i] for i in self.pose.directions), *[0.0] * len(self.tree.links))
        by_y = [casadi.jacobian(each, column(*free_y)) for each in (angles, kept, motors)]
        values = casadi.densify(column(*y))
        angles_by_y, turning_by_y, motors_by_y = casadi.substitute(by_y, [column(*free_y)], [values])
        return _SimpleJacobians(
            angles_by_y,
            casadi.jacobian(angles, column(*free_u)),
            turning_by_y,
            motors_by_y,
            casadi.jacobian(motors, column(*free_u)),
        )

    def _store_jacobians(self) -> tuple[Matrix, Matrix]:
        """Jacobians by y and u of what the inputs alone change: momenta of wheels, mass of propellant."""
        control, count = self.layout.control, len(self.tree.wheels)
        rows = count + (0 if self.tree.tank is None else 1)
        by_u = zeros(rows, self.n_u)
        for row, index in enumerate(range(control.wheel_torque.start, control.wheel_torque.stop)):
            by_u[row, index] = 1.0
        if self.tree.tank is not None:
            for index, jet in enumerate(self.tree.jets, control.thruster_force.start):
                by_u[count, index] = -jet.mass_flow
        return zeros(rows, self.n_y), by_u

    def _body_residual_jacobian(self, y: Sequence[Scalar], solved: Accelerations) -> Matrix:
        """Jacobian by y of the body wrenches and joint torques that fixed accelerations need.

        A joint's coordinate moves the wrench that reaches the body before it along its screw s. At a fixed
        coordinate the effect is the same if the body after the joint takes the wrench's change, s x (force,
        torque), besides its own.
        """
        n = len(self.tree.links)
        free, acceleration = symbols("v", self.n_y), symbols("a", 6 + n)
        motion = self.motion(free)
        given = Accelerations(acceleration[:3], acceleration[3:6], acceleration[6:])
        passive = self.passive_torques(motion)
        wrenches, rotors = self._missing_wrenches(motion, given)
        missing = [entry for pair in wrenches for part in pair for entry in part]
        missing += [rotor - torque for rotor, torque in zip(rotors, passive, strict=True)]
        by_y = casadi.jacobian(column(*missing), column(*free))
        values = casadi.densify(column(*y, *solved.angular, *solved.linear, *solved.joints))
        by_y = casadi.substitute(by_y, column(*free, *acceleration), values)
        angles = iter(self._in_y(self.layout.state.joint_angles))
        moving = self.motion(y)
        for j, (force, torque) in enumerate(self._reactions(moving, solved)):
            link, rows = self.tree.links[j], list(range(6 * (j + 1), 6 * (j + 2)))
            changes: list[Matrix] = []
            if link.spherical is None:
                turn, slide = link.screw
                across = (-force[1], force[0], 0.0)  # z x force
                moved = add(scale(turn, (-torque[1], torque[0], 0.0)), scale(slide, across))
                changes.append(column(*scale(turn, across), *moved))
            elif link.spherical == 0:  # it takes the whole rotation, whose x is this frame's z
                for x, *others in zip(*minimal.turn_by_quaternion(moving.joint_angles[j]), strict=True):
                    turned = (*others, x)
                    changes.append(column(*cross(turned, force), *cross(turned, torque)))
            for change in changes:
                angle = next(angles)
                by_y[rows, angle] = by_y[rows, angle] + change
                if link.spherical is not None:  # the torque about z of this frame, which turns along, stays
                    by_y[6 * (n + 1) + j, angle] = by_y[6 * (n + 1) + j, angle] - change[5]
        return casadi.sparsify(by_y)

    def _residual(self, y: Sequence[Scalar]) -> Residual:
        """Forces that given accelerations need, minus those that depend on y, over symbols."""
        n = len(self.tree.links)
        acceleration = symbols("a", 6 + n)
        motion = self.motion(y)
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        given = Accelerations(acceleration[:3], acceleration[3:6], acceleration[6:])
        rates = motion.angular, motion.joint_rates
        needed = minimal.inverse_dynamics(self.loaded(motion), frames, *rates, given)
        tip = self.tip_forces(motion, frames, self.tree.tip_wrench)
        passive = self.passive_torques(motion)
        joints = [
            bias - other - load for bias, other, load in zip(needed.joints, passive, tip.joints, strict=True)
        ]
        torque = subtract(needed.torque, tip.torque)
        if self.tree.wheels:
            torque = subtract(torque, self._wheel_torque(motion))
        forces = [*subtract(needed.force, tip.force), *torque, *joints]
        free = (*self.pose.directions, *range(6, 6 + n))
        return Residual(column(*forces), y, acceleration, free)

    def _on_base(self, forces: Sequence[Scalar]) -> list[Scalar]:
        """Generalized forces (force, torque, joints) as wrenches on the bodies and joint torques."""
        return [*forces[:6], *[0.0] * (6 * len(self.tree.links)), *forces[6:]]

    def _response(self, inertia: Inertia, forces: Sequence[Scalar]) -> list[Scalar]:
        """Accelerations (free directions, joints) from wrenches on the bodies and joint torques."""
        n = len(self.tree.links)
        if all(casadi.SX(entry).is_zero() for entry in forces):
            return [0.0] * (len(self.pose.directions) + n)
        wrenches = [(forces[6 * i : 6 * i + 3], forces[6 * i + 3 : 6 * i + 6]) for i in range(n + 1)]
        solved = inertia.accelerations(wrenches, forces[6 * (n + 1) :])
        dual = [*solved.angular, *solved.linear]
        return [*(dual[i] for i in self.pose.directions), *solved.joints]

    def _input_response(self, inertia: Inertia, index: int) -> Matrix:
        unit = self.inputs([1.0 if i == index else 0.0 for i in range(self.n_u)])
        torque = unit.torque
        if self.tree.wheels:
            torque = subtract(torque, reaction_wheels.along_axes(self.tree.wheels, unit.wheel_torques))
        forces = [*unit.force, *torque, *self._on_links(unit.joint_torques)]
        return column(*self._response(inertia, self._on_base(forces)))
