"""Momentum of a scene's whole system, and the external wrench that changes it, over CasADi symbols.

Joint torques, springs, dampers, wheels and the motion of the arm are internal: only base actuators and a
wrench at the tip act from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.algebra.vectors import add
from dq_space_arm_env.dynamics import minimal, reaction_wheels
from dq_space_arm_env.dynamics.elastic_gears import DrivenMassMatrix
from dq_space_arm_env.dynamics.equations_of_motion import EquationsOfMotion, Motion
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix

Scalar = Any
Scalars = Sequence[Scalar]


class SpaceArmMomentum:
    """Momentum of a robot; all vectors have 3 entries in base axes, y is a state without the pose."""

    def __init__(self, equations: EquationsOfMotion) -> None:
        self._field, self._tree = equations, equations.tree

    @property
    def mass(self) -> Scalar:
        """Mass of the whole system, kg."""
        return sum((link.body.mass for link in self._tree.links), start=self._tree.base.mass)

    def momentum(self, y: Scalars) -> tuple[Scalars, Scalars, Scalars]:
        """Linear momentum, angular momentum about the center of mass, and the latter in the base frame."""
        motion, mass_matrix = self._mass_matrix(y)
        linear, angular = mass_matrix.momentum(motion.angular, motion.linear, motion.joint_rates)
        if self._tree.wheels:
            angular = add(angular, self.of_wheels(y))
        return linear, angular, mass_matrix.center

    def of_wheels(self, y: Scalars) -> Scalars:
        """Angular momentum that the wheels have besides the bodies; zeros without any."""
        return reaction_wheels.along_axes(self._tree.wheels, self._field.motion(y).wheel_momenta)

    def base_twist(self, y: Scalars, linear: Scalars, angular: Scalars) -> list[Scalar]:
        """Twist of the base, angular then linear, that gives the bodies a momentum; y's own is not read."""
        motion, mass_matrix = self._mass_matrix(y)
        turning, moving = mass_matrix.base_velocity(linear, angular, motion.joint_rates)
        return [*turning, *moving]

    def external_wrench(self, y: Scalars, u: Scalars) -> tuple[Scalars, Scalars]:
        """External force and torque on the system, about the base origin; zeros without any."""
        motion, inputs = self._field.motion(y), self._field.inputs(u)
        frames = minimal.link_frames(self._tree, motion.joint_angles)
        tip = self._field.tip_forces(motion, frames, self._tree.tip_wrench)
        return add(inputs.force, tip.force), add(inputs.torque, tip.torque)

    def joint_torques(self, y: Scalars, u: Scalars) -> list[Scalar]:
        """Torques on joints, and on motors behind elastic gears, with what a wrench at the tip adds."""
        motion, motors = self._field.motion(y), self._field.inputs(u).joint_torques
        frames = minimal.link_frames(self._tree, motion.joint_angles)
        parts = (
            [0.0 if link.elastic else torque for link, torque in zip(self._tree.links, motors, strict=True)],
            self._field.passive_torques(motion),
            self._field.tip_forces(motion, frames, self._tree.tip_wrench).joints,
        )
        on_joints = [sum(torques) for torques in zip(*parts, strict=True)]
        return [*on_joints, *self._field.motor_torques(motion, motors)]

    def passive_torques(self, y: Scalars) -> list[Scalar]:
        """Torques on joints, and on motors behind elastic gears, that no motor commands."""
        motion, still = self._field.motion(y), [0.0] * len(self._tree.links)
        return [*self._field.passive_torques(motion), *self._field.motor_torques(motion, still)]

    def mass_matrix(self, y: Scalars) -> MassMatrix:
        """The mass matrix at the joint angles."""
        return self._mass_matrix(y)[1]

    def _mass_matrix(self, y: Scalars) -> tuple[Motion, MassMatrix]:
        motion = self._field.motion(y)
        frames = minimal.link_frames(self._tree, motion.joint_angles)
        return motion, DrivenMassMatrix(self._field.loaded(motion), frames)
