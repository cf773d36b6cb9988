"""The paper's own formulation as a vector field: 46 redundant states, with the tip's pose appended as 8 more.

It serves comparison: the dual velocities of all bodies are integrated side by side, and only the constraint
on their accelerations keeps the arm together. `SpaceArmField` gives the same motion from 23 numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import vectors
from dq_space_arm_env.algebra.symbolic import column, matrix, symbols, zeros
from dq_space_arm_env.dynamics import kinematics, minimal, newton_euler, reaction_wheels
from dq_space_arm_env.dynamics.equations_of_motion import Inputs
from dq_space_arm_env.dynamics.newton_euler import PaperState, SchurComplement
from dq_space_arm_env.dynamics.paper_joints import count_of_coordinates, joints_of
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import split_state

Scalar = Any
Matrix = Any


class PaperField:
    """Vector field of the paper's state with the tip's pose appended.

    For three links and a wrist: base pose (8), joint angles (3), wrist angles (3), dual velocities of the
    four bodies (32), q_{G/I} (8). Wheels, which the paper does not have, add their axial momenta.
    """

    name = "paper"
    pose = None  # integrated number by number, like everything else

    def __init__(self, minimal_field: SpaceArmField) -> None:
        self.minimal = minimal_field
        self.parameters = minimal_field.parameters
        self.tree = minimal_field.tree
        self.n_u = minimal_field.n_u
        n = len(joints_of(self.tree))
        coordinates = count_of_coordinates(self.tree)
        self._positions = 8 + coordinates + (0 if self.tree.wrist is None else 3)
        self.tip = slice(self._positions + 8 * (n + 1), self._positions + 8 * (n + 2))
        self.base_twist = (
            *range(self._positions + 1, self._positions + 4),
            *range(self._positions + 5, self._positions + 8),
        )
        self.n_x = self.n_y = self.tip.stop + len(self.tree.wheels)
        self.rate_indices = tuple(range(self._positions, self.tip.start))

    def state_from_minimal(self, x: Sequence[Scalar]) -> list[Scalar]:
        """The redundant state of the same motion."""
        field, tree = self.minimal, self.tree
        stored, y = split_state(field, x)
        pose, motion = field.pose.full(stored), field.motion(y)
        frames = minimal.link_frames(tree, motion.joint_angles)
        velocities = kinematics.body_velocities(
            tree, frames, (*motion.angular, *motion.linear), motion.joint_rates
        )
        duals: list[Scalar] = []
        for body, velocity in zip(tree.bodies, velocities, strict=True):
            if not body.mass:  # of a spherical joint
                continue
            at_center = vectors.add(velocity.linear, vectors.cross(velocity.angular, body.center_of_mass))
            duals += [0.0, *velocity.angular, 0.0, *at_center]
        tip = kinematics.tip_pose(tree, pose, motion.joint_angles, motion.wrist_angles)
        angles = y[: count_of_coordinates(tree)]
        return [*pose, *angles, *motion.wrist_angles, *duals, *tip, *motion.wheel_momenta]

    def minimal_from_state(self, y: Sequence[Scalar]) -> list[Scalar]:
        """The motion in minimal coordinates.

        Joint rates follow from the dual velocities by (12); components of these velocities that the joints
        forbid are dropped, and so is the pose's deviation from a unit dual quaternion.
        """
        field, layout = self.minimal, self.minimal.layout.state
        state = PaperState.from_vector(self.tree, y[: self.tip.start])
        base = state.velocities[0]
        twist = (*base[1:4], *base[5:8])
        x: list[Scalar] = [0.0] * field.n_x
        x[layout.pose] = field.pose.reduced(dq.normalize(state.base_pose))
        x[layout.joint_angles] = list(y[8 : 8 + count_of_coordinates(self.tree)])
        x = field.with_unit_quaternions(x)
        x[layout.wrist_angles] = list(state.wrist_angles)
        x[layout.base_velocity] = [twist[i] for i in field.pose.directions]
        x[layout.joint_rates] = newton_euler.joint_speeds(self.tree, state)
        x[layout.wheel_momenta] = list(y[self.tip.stop :])
        return x

    def system(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> newton_euler.NewtonEulerSystem:
        """The linear system (20) for dual accelerations and reaction wrenches."""
        state, inputs = self._parts(y, u)
        wrench = self._base_wrench(y, state, inputs)
        return newton_euler.system_of(self.tree, state, wrench, inputs.joint_torques)

    def _base_wrench(self, y: Sequence[Scalar], state: PaperState, inputs: Inputs) -> Sequence[Scalar]:
        """Dual wrench on the base from outside, and of its wheels."""
        torque = inputs.torque
        if self.tree.wheels:
            given = inputs.wheel_torques, y[self.tip.stop :], state.velocities[0][1:4]
            torque = vectors.add(torque, reaction_wheels.torque_on_base(self.tree.wheels, *given))
        return (0.0, *inputs.force, 0.0, *torque)

    def free_accelerations(self, y: Sequence[Scalar], ydot: Sequence[Scalar]) -> list[Scalar]:
        """Accelerations of base (free directions) and joints among the dual accelerations of all bodies."""
        state = PaperState.from_vector(self.tree, y[: self.tip.start])
        bodies = [ydot[8 * i : 8 * i + 8] for i in range(len(ydot) // 8)]
        frames = newton_euler.joint_frames(self.tree, state.joint_angles, state.wrist_angles)
        joints = newton_euler.joint_accelerations(self.tree, frames, state.velocities, bodies)
        base = (*ydot[1:4], *ydot[5:8])
        return [*(base[i] for i in self.minimal.pose.directions), *joints]

    def _parts(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> tuple[PaperState, Inputs]:
        return PaperState.from_vector(self.tree, y[: self.tip.start]), self.minimal.inputs(u)

    def rates(self, y: Sequence[Scalar], u: Sequence[Scalar]) -> list[Scalar]:
        """Time derivative of the state: (11), (12), (22), and (30) for the tip."""
        state, inputs = self._parts(y, u)
        wrench = self._base_wrench(y, state, inputs)
        rates, _ = newton_euler.paper_rates(
            self.tree, state, wrench, inputs.joint_torques, inputs.wrist_rates
        )
        tip = newton_euler.paper_tip_rate(self.tree, state, inputs.wrist_rates)
        return [*rates, *tip, *inputs.wheel_torques]

    def linearized_rates(
        self, y: Sequence[Scalar], u: Sequence[Scalar]
    ) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of the state and its Jacobians, by differentiating (20) at its solution."""
        values = casadi.densify(column(*y, *u))
        y, u = symbols("y", self.n_y), symbols("u", self.n_u)
        variables = column(*y, *u)
        state, inputs = self._parts(y, u)
        system = self.system(y, u)
        schur = SchurComplement(self.tree, system)
        accelerations, reactions = schur.solve(system.b1, system.b2)
        residual, unknowns = _residual(system)
        change = casadi.substitute(
            casadi.jacobian(residual, variables), unknowns, casadi.densify(column(*accelerations, *reactions))
        )
        responses: list[Matrix] = []
        for index in range(change.shape[1]):
            by_variable = change[:, index]
            if by_variable.nnz() == 0:
                responses.append(zeros(len(accelerations), 1))
                continue
            right = [-entry for entry in casadi.vertsplit(casadi.densify(by_variable))]
            response, _ = schur.solve(right[: len(accelerations)], right[len(accelerations) :])
            responses.append(column(*response))
        positions = newton_euler.paper_position_rates(self.tree, state, inputs.wrist_rates)
        tip = newton_euler.paper_tip_rate(self.tree, state, inputs.wrist_rates)
        rates = casadi.densify(column(*positions, *accelerations, *tip, *inputs.wheel_torques))
        jacobian = casadi.vertcat(
            casadi.jacobian(column(*positions), variables),
            casadi.horzcat(*responses),
            casadi.jacobian(column(*tip), variables),
            casadi.jacobian(column(*inputs.wheel_torques), variables),
        )
        rates, jacobian = casadi.substitute([rates, jacobian], [variables], [values])
        return casadi.vertsplit(casadi.densify(rates)), jacobian[:, : self.n_y], jacobian[:, self.n_y :]


def _residual(system: newton_euler.NewtonEulerSystem) -> tuple[Matrix, Matrix]:
    """S [ydot; T] - B of (20) with ydot and T as symbols, and these symbols."""
    unknowns = casadi.SX.sym("unknown", len(system.b1) + len(system.b2))
    ydot, reactions = unknowns[: len(system.b1)], unknowns[len(system.b1) :]

    bodies: Matrix = casadi.mtimes(matrix(system.s11), ydot) - column(*system.b1)
    if not system.b2:
        return bodies, unknowns
    bodies += casadi.mtimes(matrix(system.s12), reactions)
    constraints = casadi.mtimes(matrix(system.s21), ydot) - column(*system.b2)
    if any(system.s22):
        constraints += column(*system.s22) * reactions
    return casadi.vertcat(bodies, constraints), unknowns
