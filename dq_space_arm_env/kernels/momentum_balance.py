"""The momentum of a scene's whole system, and what changes it, over CasADi symbols.

Joint torques, springs, dampers and the motion of the arm are internal: only base actuators and a wrench at
the tip act on the system from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.algebra.vectors import add
from dq_space_arm_env.dynamics import minimal
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix

if TYPE_CHECKING:
    from dq_space_arm_env.kernels.field import SpaceArmField
    from dq_space_arm_env.kernels.motion import Motion

Scalar = Any
Scalars = Sequence[Scalar]


class SpaceArmMomentum:
    """Momentum of a robot; implements `integrators.momentum_coordinates.MomentumBalance`.

    All vectors have three numbers in base axes; y is a state without the pose.
    """

    def __init__(self, field: SpaceArmField) -> None:
        """Take over the equations of motion.

        Args:
            field: They tell the parts of y and of an input.
        """
        self._field, self._chain = field, field.chain

    @property
    def mass(self) -> Scalar:
        """Mass of the whole system, kg."""
        return sum((link.body.mass for link in self._chain.links), start=self._chain.base.mass)

    @property
    def springs(self) -> tuple[list[float], list[float]]:
        """Stiffness [N m/rad] and damping [N m s/rad] of the joints, n each."""
        links = self._chain.links
        return [link.stiffness for link in links], [link.damping for link in links]

    def momentum(self, y: Scalars) -> tuple[Scalars, Scalars, Scalars]:
        """Momentum and center of mass.

        Args:
            y: State without the pose.

        Returns:
            Linear momentum [kg m/s], angular momentum about the system's center of mass [kg m^2/s], and the
            center of mass in the base frame [m].
        """
        motion, mass_matrix = self._mass_matrix(y)
        linear, angular = mass_matrix.momentum(motion.angular, motion.linear, motion.joint_rates)
        return linear, angular, mass_matrix.center

    def base_twist(self, y: Scalars, linear: Scalars, angular: Scalars) -> list[Scalar]:
        """The twist of the base that gives the system a momentum.

        Args:
            y: State without the pose; the base's own velocity in it is not read.
            linear: Linear momentum, kg m/s.
            angular: Angular momentum about the system's center of mass, kg m^2/s.

        Returns:
            Angular [rad/s], then linear velocity [m/s], 6.
        """
        motion, mass_matrix = self._mass_matrix(y)
        turning, moving = mass_matrix.base_velocity(linear, angular, motion.joint_rates)
        return [*turning, *moving]

    def external_wrench(self, y: Scalars, u: Scalars) -> tuple[Scalars, Scalars]:
        """What acts on the system from outside.

        Args:
            y: State without the pose.
            u: Input.

        Returns:
            Force [N], and torque about the base's center of mass [N m]; the number zero where nothing acts.
        """
        motion, inputs = self._field.motion(y), self._field.inputs(u)
        rotations = minimal.joint_rotations(self._chain, motion.joint_angles)
        tip = self._field.tip_forces(motion, rotations, self._chain.tip_wrench)
        return add(inputs.force, tip.force), add(inputs.torque, tip.torque)

    def joint_inertia(self, y: Scalars) -> list[list[Scalar]]:
        """Inertia that the joints feel while the base floats freely.

        Args:
            y: State without the pose; only the joint angles are read.

        Returns:
            Symmetric positive definite matrix n x n, kg m^2.
        """
        return self._mass_matrix(y)[1].joint_inertia()

    def _mass_matrix(self, y: Scalars) -> tuple[Motion, MassMatrix]:
        motion = self._field.motion(y)
        return motion, MassMatrix(self._chain, minimal.joint_rotations(self._chain, motion.joint_angles))
