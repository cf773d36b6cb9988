"""Programs of the robot's matrices: mass matrix, bias forces, Jacobians of tip and observation.

Generalized velocities are the base's twist (free directions: angular, linear, base axes), then the joint
rates; the wrist has no mass, and its Euler rates come last, where they matter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics import kinematics, minimal
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import ZERO
from dq_space_arm_env.task.constraint_residuals import observed_besides
from dq_space_arm_env.task.episode import seen
from dq_space_arm_env.task.equations import SceneEquations, total

Scalar = Any
Scalars = Sequence[Scalar]
Columns = list[list[Scalar]]


class RobotPrograms:
    """Builds the programs of one scene; `program` makes one of a function of named inputs."""

    def __init__(self, equations: SceneEquations, program: Callable[..., Program]) -> None:
        self.equations, self._program = equations, program
        self.field, self.tree = equations.field, equations.tree

    def mass_matrix(self) -> Program:
        """Mass matrix, row by row."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            rows = self.field.mass_matrix(self.equations.y(x))
            return {"matrix": [entry for row in rows for entry in row]}

        return self._program("mass_matrix", outputs, x=self.field.n_x)

    def bias_forces(self) -> Program:
        """Forces of a motion without acceleration."""
        return self._program(
            "bias_forces",
            lambda x: {"forces": self.field.bias_forces(self.equations.y(x))},
            x=self.field.n_x,
        )

    def tip_jacobian(self) -> Program:
        """Body Jacobian of the tip, row by row."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            base, arm = self._tip_columns(x)
            return {"jacobian": row_major([*base, *arm])}

        return self._program("tip_jacobian", outputs, x=self.field.n_x)

    def generalized_jacobian(self) -> Program:
        """J_m - J_b H_b^-1 H_bm of Umetani & Yoshida, row by row."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            base, arm = self._tip_columns(x)
            n = len(self.tree.links)
            motion = self.field.motion(self.equations.y(x))
            frames = minimal.link_frames(self.tree, motion.joint_angles)
            system = MassMatrix(self.field.loaded(motion), frames)
            for joint in range(n):
                rates = [1.0 if i == joint else 0.0 for i in range(n)]
                # -H_b^-1 H_bm: the base moves such that the momentum stays zero.
                angular, linear = system.base_velocity(ZERO, ZERO, rates)
                twist = (*angular, *linear)
                carried = combined(base, [twist[i] for i in self.field.pose.directions])
                arm[joint] = [own + other for own, other in zip(arm[joint], carried, strict=True)]
            return {"jacobian": row_major(arm)}

        return self._program("generalized_jacobian", outputs, x=self.field.n_x)

    def tip_twist(self) -> Program:
        """Twist of the tip."""

        def outputs(x: Scalars, u: Scalars) -> Mapping[str, Scalars]:
            motion = self.field.motion(self.equations.y(x))
            return {"twist": self.equations.tip_twist(motion, self.field.inputs(u).wrist_rates)}

        return self._program("tip_twist", outputs, x=self.field.n_x, u=self.field.n_u)

    def observation_jacobian(self) -> Program:
        """Derivative of the observation in tangent coordinates, row by row.

        Where the tip moves by a twist xi in its axes, q_{G/I} changes by q_{G/I} xi / 2, and the observed
        error pose q_{D/G} = q_{G/I}* q_{D/I} (31) by -xi q_{D/G} / 2.
        """
        field = self.field

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            base, arm = self._tip_columns(x)
            if self.tree.has_spherical:
                arm = self._by_angles(x, arm)
            error = poses.error_pose(self.equations.tip(x), self.equations.target)
            columns = []
            for twist in (*base, *arm):
                half = dq.from_vector([-0.5 * entry for entry in twist])
                columns.append(column(*field.pose.reduced(dq.multiply(half, error))))
            size = len(field.pose.stored)
            errors = casadi.horzcat(*columns, zeros(size, field.n_t - len(columns)))
            # The rest of the observation holds entries of y, which tangent coordinates shift.
            rest = seen(self.equations, x, 0.0)["observation"][size:]
            by_y = casadi.jacobian(column(*rest), column(*self.equations.y(x)))
            by_pose = zeros(len(rest), field.n_t - field.n_y)
            if self.equations.scene.target.motion is not None:
                by_pose = self._twists_by_pose(x, base, len(rest))
            by_pose = by_pose + self._besides_by_pose(x, len(rest))
            jacobian = casadi.vertcat(errors, casadi.horzcat(by_pose, by_y))
            return {"jacobian": casadi.densify(jacobian.T).nonzeros()}

        return self._program("observation_jacobian", outputs, x=field.n_x)

    def _by_angles(self, x: Scalars, arm: Columns) -> Columns:
        """The tip's twists per unit of the angles of a state, from those per unit of rates."""
        angles, found = self.field.motion(self.equations.y(x)).joint_angles, list[list[Scalar]]()
        for index, link in enumerate(self.tree.links):
            if link.spherical is None:
                found.append(list(arm[index]))
            elif link.spherical == 0:
                turns = minimal.turn_by_quaternion(angles[index])
                found += [combined(arm[index : index + 3], turn) for turn in zip(*turns, strict=True)]
        return [*found, *arm[len(self.tree.links) :]]

    def _besides_by_pose(self, x: Scalars, count: int) -> Any:
        """Derivative of the last entries by the base's pose: `besides`, before twists and time left."""
        n = len(self.field.pose.directions)
        z = symbols("z", n)
        besides = observed_besides(
            self.equations, *self.equations.moved(x, [*z, *[0.0] * (self.field.n_t - n)])
        )
        if not besides:
            return zeros(count, n)
        after = 1 + (2 * n if self.equations.scene.target.motion is not None else 0)
        by_pose = casadi.substitute(casadi.jacobian(column(*besides), column(*z)), column(*z), [0.0] * n)
        return casadi.vertcat(zeros(count - after - len(besides), n), by_pose, zeros(after, n))

    def _twists_by_pose(self, x: Scalars, base: Columns, count: int) -> Any:
        """Derivative of the last entries but one by the base's pose: of relative and target's twist.

        As the tip moves by a twist xi in its axes, the target's twist c in these axes changes by c x xi.
        """
        carried = self.equations.target_twist(self.equations.tip(x))
        directions, columns = self.field.pose.directions, []
        for twist in base:
            change = dual_vectors.cross(carried, twist)
            both = [*(-change[i] for i in directions), *(change[i] for i in directions)]
            columns.append(column(*[0.0] * (count - len(both) - 1), *both, 0.0))
        return casadi.horzcat(*columns)

    def _tip_columns(self, x: Scalars) -> tuple[Columns, Columns]:
        """The tip's twists per unit of the base's free directions, and of joint rates and Euler rates."""
        motion = self.field.motion(self.equations.y(x))
        columns = kinematics.tip_jacobian(self.tree, motion.joint_angles, motion.wrist_angles)
        return [columns[i] for i in self.field.pose.directions], columns[6:]


def row_major(columns: Columns) -> list[Scalar]:
    """Entries of a matrix row by row, from its columns."""
    return [entry for row in zip(*columns, strict=True) for entry in row]


def combined(columns: Columns, factors: Scalars) -> list[Scalar]:
    """Matrix times vector, from the matrix's columns."""
    return [
        total([entry * factor for entry, factor in zip(row, factors, strict=True)])
        for row in zip(*columns, strict=True)
    ]
