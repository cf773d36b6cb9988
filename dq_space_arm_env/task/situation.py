"""A state with its input, seen from the base, as the residuals of constraints see it.

All geometry is seen from the base: rows between the robot's own bodies then have no derivative by its pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.algebra.vectors import add, matrix_vector, scale
from dq_space_arm_env.dynamics import kinematics, minimal
from dq_space_arm_env.dynamics.elastic_gears import drive_energy
from dq_space_arm_env.scene.constraints import Point
from dq_space_arm_env.task.equations import SceneEquations, body_pose

Scalar = Any
Scalars = Sequence[Scalar]


class Situation:
    """A state with its input, seen from the base."""

    def __init__(self, equations: SceneEquations, base: Scalars, y: Scalars, u: Scalars) -> None:
        self.equations, self.base, self.scene = equations, base, equations.scene
        self.motion = equations.field.motion(y)
        self.u, self.inputs = u, equations.field.inputs(u)
        tree, motion = equations.tree, self.motion
        frames = kinematics.frame_poses(tree, dq.IDENTITY, motion.joint_angles, motion.wrist_angles)
        bodies = ["base", *(link.name for link in self.scene.links)]
        names = [*bodies, *(tip.name for tip in self.scene.other_tips)]
        self._poses: dict[str, Scalars] = dict(zip(names, frames, strict=False))
        self._poses["tip"] = frames[-1]
        self._placements: dict[str, tuple[Any, Any]] = {}

    def pose(self, frame: str) -> Scalars:
        """Pose of a frame seen from the base."""
        if frame not in self._poses:
            outside: Scalars = dq.IDENTITY
            if frame != "inertial":
                grasp = self.equations.target
                outside = grasp if frame == "grasp" else body_pose(self.scene, self.equations.given)
            self._poses[frame] = dq.multiply(dq.conjugate(self.base), outside)
        return self._poses[frame]

    def placement(self, frame: str) -> tuple[Any, Any]:
        """Rotation matrix and position of a frame seen from the base."""
        if frame not in self._placements:
            self._placements[frame] = poses.to_matrix(self.pose(frame))
        return self._placements[frame]

    def point(self, frame: str, position: Scalars) -> Scalars:
        """A point of a frame, base axes, m."""
        rotation, origin = self.placement(frame)
        return add(origin, matrix_vector(rotation, position))

    def place_of(self, point: Point) -> Scalars:
        """A point of a constraint, base axes, m."""
        return self.point(point.frame, point.position)

    def direction(self, frame: str, vector: Scalars) -> Scalars:
        """Unit vector along a direction of a frame, base axes."""
        return matrix_vector(self.placement(frame)[0], scale(1.0 / math.hypot(*vector), vector))

    def momentum(self) -> tuple[Scalars, Scalars, Scalar]:
        """Linear momentum, angular momentum about the center of mass, base axes; energy."""
        motion = self.motion
        tree = self.equations.field.loaded(motion)
        frames = minimal.link_frames(tree, motion.joint_angles)
        twist = (*motion.angular, *motion.linear)
        velocities = kinematics.body_velocities(tree, frames, twist, motion.joint_rates)
        linear, angular, _ = kinematics.momentum(tree, frames, velocities, motion.wheel_momenta)
        kinetic, potential = kinematics.energy(tree, motion.joint_angles, velocities, motion.wheel_momenta)
        motors = (motion.motor_angles, motion.motor_rates)
        return linear, angular, kinetic + potential + drive_energy(tree, motion.joint_angles, *motors)
