"""Elastic joints after Spong: the gear of a motor is a spring between its rotor and the link.

With the motor's angle th on the joint's side, the inertia B = N^2 J_r of its rotor there, and the rotor's
motion relative to the body that carries it alone,

    B th'' + K (th - q) + D (th' - q') + friction(th') = motor torque,

and K (th - q) + D (th' - q') drives the link (Spong, Modeling and Control of Elastic Joint Robots, 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.dynamics.kinematic_tree import Elasticity, KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import Accelerations, LinkFrame, Vector3, rubbing

Scalar = Any
Scalars = Sequence[Scalar]


def elastic_joints(tree: KinematicTree) -> list[tuple[int, Elasticity]]:
    """The joints with elastic gears, each with its own."""
    return [(index, link.elastic) for index, link in enumerate(tree.links) if link.elastic is not None]


def transmitted_torques(
    tree: KinematicTree, angles: Scalars, rates: Scalars, motor_angles: Scalars, motor_rates: Scalars
) -> list[Scalar]:
    """Torques of elastic gears on their links, n, N m; none of rigid ones."""
    torques: list[Scalar] = [0.0] * len(tree.links)
    for (index, gear), angle, rate in zip(elastic_joints(tree), motor_angles, motor_rates, strict=True):
        twisted = gear.stiffness * (angle - angles[index])
        torques[index] = twisted + gear.damping * (rate - rates[index])
    return torques


def motor_torques(
    tree: KinematicTree, transmitted: Scalars, motor_rates: Scalars, joint_torques: Scalars
) -> list[Scalar]:
    """Torques on the rotors of elastic joints on the joints' side, one each, N m."""
    return [
        joint_torques[index] - transmitted[index] - rubbing(gear.friction, rate)
        for (index, gear), rate in zip(elastic_joints(tree), motor_rates, strict=True)
    ]


def drive_energy(tree: KinematicTree, angles: Scalars, motor_angles: Scalars, motor_rates: Scalars) -> Scalar:
    """Energy of the elastic gears and their rotors, J."""
    energy: Scalar = 0.0
    for (index, gear), angle, rate in zip(elastic_joints(tree), motor_angles, motor_rates, strict=True):
        twist = angle - angles[index]
        energy = energy + 0.5 * (gear.stiffness * (twist * twist) + gear.inertia * (rate * rate))
    return energy


class DrivenMassMatrix(MassMatrix):
    """The mass matrix of a robot and the rotors of its elastic joints, whose rates follow the joints'."""

    def __init__(self, tree: KinematicTree, frames: Sequence[LinkFrame]) -> None:
        super().__init__(tree, frames)
        self._count = len(tree.links)
        self._rotors = [gear.inertia for _, gear in elastic_joints(tree)]

    def canonical_momenta(
        self, angular_velocity: Vector3, joint_rates: Scalars
    ) -> tuple[Vector3, list[Scalar]]:
        """Likewise with the momenta B th' of the rotors."""
        angular, momenta = super().canonical_momenta(angular_velocity, joint_rates[: self._count])
        rates = joint_rates[self._count :]
        return angular, [*momenta, *(b * rate for b, rate in zip(self._rotors, rates, strict=True))]

    def velocities(self, angular: Vector3, joint_momenta: Scalars) -> Accelerations:
        """Likewise with the rates of the rotors."""
        solved = super().velocities(angular, joint_momenta[: self._count])
        momenta = joint_momenta[self._count :]
        rates = [momentum / b for b, momentum in zip(self._rotors, momenta, strict=True)]
        return Accelerations(solved.angular, solved.linear, [*solved.joints, *rates])
