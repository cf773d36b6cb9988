"""What a scene's kernels compute besides motion: cost and observation, over CasADi symbols."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.cost import weighted_square
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.integrators.field import split_state
from dq_space_arm_env.kernels.field import SpaceArmField
from dq_space_arm_env.kernels.parameters import EpisodeParameters
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.schema import Scene

Scalar = Any
Scalars = Sequence[Scalar]


@dataclass(frozen=True)
class SceneEquations:
    """Equations of a scene.

    Attributes:
        scene: The scene.
        chain: Constants of the robot.
        target: Pose q_{D/I} of the target, 8 numbers.
        layout: Where each quantity stands in state and input.
        field: Equations of motion.
    """

    scene: Scene
    chain: Chain
    target: Scalars
    layout: StateLayout
    field: SpaceArmField

    @classmethod
    def nominal(cls, scene: Scene) -> SceneEquations:
        """Equations with the scene's own target, masses and inertias."""
        chain, layout = Chain.from_scene(scene), StateLayout.of(scene)
        target = scene.target.pose.dual_quaternion
        return cls(
            scene,
            chain,
            target,
            layout,
            SpaceArmField(chain, layout, formulation=scene.simulation.formulation),
        )

    @classmethod
    def parametric(cls, scene: Scene) -> SceneEquations:
        """Equations with symbols, `field.parameters`, for what the scene draws for each episode."""
        parameters, layout = EpisodeParameters.of(scene), StateLayout.of(scene)
        field = SpaceArmField(parameters.chain, layout, parameters.symbols, scene.simulation.formulation)
        return cls(scene, parameters.chain, parameters.target, layout, field)

    def y(self, x: Scalars) -> Scalars:
        """A state without the pose."""
        return split_state(self.field, x)[1]

    def base_pose(self, x: Scalars) -> Scalars:
        """Pose of the base, 8 numbers."""
        return self.field.pose.full(split_state(self.field, x)[0])

    def tip(self, x: Scalars) -> Scalars:
        """Pose of the tip q_{G/I}, 8 numbers, eq. (27)."""
        motion = self.field.motion(self.y(x))
        return kinematics.tip_pose(self.chain, self.base_pose(x), motion.joint_angles, motion.wrist_angles)

    def state_cost_terms(self, x: Scalars) -> list[Scalar]:
        """Pose and base velocity: the terms of the stage cost that depend on the state."""
        cost = self.scene.cost
        return [self._pose_cost(x, cost.pose), self._velocity_cost(x, cost.base_velocity)]

    def effort(self, u: Scalars) -> Scalar:
        """The term of the stage cost that depends on the input."""
        return weighted_square(u, [0.0] * self.field.n_u, self.layout.control_weight.tolist())

    def cost_terms(self, x: Scalars, u: Scalars) -> list[Scalar]:
        """Pose, base velocity and effort: the terms of the stage cost."""
        return [*self.state_cost_terms(x), self.effort(u)]

    def terminal_cost_terms(self, x: Scalars) -> list[Scalar]:
        """Pose and base velocity: the terms of the terminal cost."""
        cost = self.scene.cost
        return [
            self._pose_cost(x, cost.terminal_pose),
            self._velocity_cost(x, cost.terminal_base_velocity),
        ]

    def _pose_cost(self, x: Scalars, weights: Sequence[float]) -> Scalar:
        return weighted_square(self.tip(x), self.target, weights)

    def _velocity_cost(self, x: Scalars, weights: Sequence[float]) -> Scalar:
        motion = self.field.motion(self.y(x))
        return weighted_square((*motion.angular, *motion.linear), self.scene.target.base_velocity, weights)

    def observe(self, x: Scalars, time_left: Scalar) -> dict[str, list[Scalar]]:
        """Observation, and the tip's errors: angle in rad, distance in m."""
        tip = self.tip(x)
        motion = self.field.motion(self.y(x))
        # A planar scene's error pose (31) has four entries that are identically zero.
        error = self.field.pose.reduced(poses.error_pose(tip, self.target))
        observation = [
            *error,
            *x[self.layout.state.base_velocity],
            *motion.joint_angles,
            *motion.wrist_angles,
            *motion.joint_rates,
            time_left,
        ]
        errors = [poses.error_angle(tip, self.target), poses.error_distance(tip, self.target)]
        return {"observation": observation, "errors": errors}


def total(terms: Scalars) -> Scalar:
    """Sum of scalars, from left to right."""
    result: Scalar = 0.0
    for term in terms:
        result = result + term
    return result
