"""Coordinates with the momentum of the whole system in place of the base's velocity.

They are local to a step, seen from the base frame at its start ("start axes"):

    rotation of the base (rotation vector), joint and wrist angles, wheel momenta, displacement of the
    system's center of mass, linear momentum, angular momentum about the center of mass, joint rates.

The base's angular velocity follows from the angular momentum, the joint rates and the locked inertia, its
position from the center of mass. Without an external wrench both momenta have time derivative zero: any
method that adds multiples of derivatives conserves them exactly, and the center of mass moves on an exact
straight line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra import poses, quaternion, rotations, screw
from dq_space_arm_env.algebra.symbolic import column, columns, symbols, zeros
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    dot,
    matrix_vector,
    scale,
    skew_matrix,
    subtract,
    transposed_matrix_vector,
)
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import composed, split_state, spread

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any

# Power series in the squared angle, the highest power first: sin(t) / t, (1 - cos(t)) / t^2, and
# (1 - (t/2) cot(t/2)) / t^2. The remainder is of order 10 in the rotation within a step, with factors
# below 3e-8.
_SINE = tuple((-1.0) ** j / math.factorial(2 * j + 1) for j in reversed(range(5)))
_COSINE = tuple((-1.0) ** j / math.factorial(2 * j + 2) for j in reversed(range(5)))
_COTANGENT = (1 / 1209600, 1 / 30240, 1 / 720, 1 / 12)


@dataclass(frozen=True)
class LocalState:
    """The parts of a state in these coordinates; vectors have 3 entries in start axes."""

    rotation: Scalars  # rotation vector of the base, rad, or its coordinates in a subclass
    # Angles of joints, of motors behind elastic gears, and of the wrist, rad, and wheel momenta, N m s.
    shape: Scalars
    displacement: Scalars  # of the system's center of mass, m
    linear: Scalars  # momentum, kg m/s
    angular: Scalars  # momentum about the center of mass, kg m^2/s
    joint_rates: Scalars  # of joints, and of motors behind elastic gears, rad/s


class MomentumCoordinates:
    """Equations of motion in these coordinates: a `VectorField` with the pose as part of y."""

    pose = None

    def __init__(self, field: SpaceArmField) -> None:
        self.base, self.balance = field.beside_momentum, field.momentum_balance
        self.name = f"{field.name}_momentum"
        self.parameters, self.n_u = field.parameters, field.n_u
        self.turning = [axis for axis in field.pose.directions if axis < 3]
        self.rotating = self._rotating()
        self.moving = [axis - 3 for axis in field.pose.directions if axis >= 3]
        twist = field.pose.twist_indices
        self.shape_indices = list(field.shape_indices)
        self.joint_indices = [i for i in field.rate_indices if i not in twist]
        sizes = [len(self.rotating), len(self.shape_indices), len(self.moving), len(self.moving)]
        sizes += [len(self.turning), len(self.joint_indices)]
        ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
        self.rotation, self.shape, self.displacement, self.linear, self.angular, self.joint_rates = (
            slice(end - size, end) for size, end in zip(sizes, ends, strict=True)
        )
        self.n_x = self.n_y = ends[-1]
        self.rate_indices = tuple(range(self.linear.start, self.n_y))

    # The coordinates of the base's rotation.

    identity: Scalars = (0.0, 0.0, 0.0)

    def _rotating(self) -> list[int]:
        """Entries of these coordinates that vary."""
        return self.turning

    def rotation_matrix(self, rotation: Scalars) -> list[list[Scalar]]:
        """Rotation matrix of the base, from its axes to start axes."""
        return rotation_matrix(rotation)

    def rotation_rate(self, rotation: Scalars, omega: Scalars) -> Scalars:
        """Time derivative of these coordinates; angular velocity in base axes."""
        return rotation_rate(rotation, omega)

    def quaternion(self, rotation: Scalars) -> Scalars:
        """The rotation as a unit quaternion."""
        return rotations.exponential(rotation)

    def scalar_less_one(self, rotation: Scalars) -> Scalar:
        """The scalar part of that quaternion less 1, without cancellation."""
        return screw.exponential_minus_identity((*rotation, 0.0, 0.0, 0.0))[0]

    # States.

    def parts(self, local: Scalars) -> LocalState:
        """Name the parts of a state."""
        return LocalState(
            spread(local[self.rotation], self.rotating, len(self.identity)),
            local[self.shape],
            spread(local[self.displacement], self.moving, 3),
            spread(local[self.linear], self.moving, 3),
            spread(local[self.angular], self.turning, 3),
            local[self.joint_rates],
        )

    def joined(self, state: LocalState) -> list[Scalar]:
        """Join the parts of a state; the inverse of `parts`."""
        return [
            *(state.rotation[i] for i in self.rotating),
            *state.shape,
            *(state.displacement[i] for i in self.moving),
            *(state.linear[i] for i in self.moving),
            *(state.angular[i] for i in self.turning),
            *state.joint_rates,
        ]

    def y(self, shape: Scalars, twist: Scalars, joint_rates: Scalars) -> list[Scalar]:
        """A state of the given equations, without the pose."""
        result = spread(shape, self.shape_indices, self.base.n_y)
        for index, direction in zip(self.base.pose.twist_indices, self.base.pose.directions, strict=True):
            result[index] = twist[direction]
        for index, rate in zip(self.joint_indices, joint_rates, strict=True):
            result[index] = rate
        return result

    def twist(self, shape: Scalars, linear: Scalars, angular: Scalars, joint_rates: Scalars) -> list[Scalar]:
        """The base's twist for a momentum of the bodies in base axes."""
        return self.balance.base_twist(self.y(shape, [0.0] * 6, joint_rates), linear, angular)

    def angular_of_bodies(self, state: LocalState) -> Scalars:
        """Angular momentum of the bodies, base axes: all but what wheels have besides them."""
        return self._less_wheels(
            state.shape, transposed_matrix_vector(self.rotation_matrix(state.rotation), state.angular)
        )

    def _less_wheels(self, shape: Scalars, angular: Scalars) -> Scalars:
        if not self.base.tree.wheels:
            return angular
        still = [0.0] * len(self.joint_indices)
        return subtract(angular, self.balance.of_wheels(self.y(shape, [0.0] * 6, still)))

    def _moving(self, state: LocalState) -> tuple[list[Scalar], list[Scalar]]:
        """The base's angular velocity, and y with it; no rate depends on the linear velocity."""
        angular = self.angular_of_bodies(state)
        omega = self.twist(state.shape, (0.0, 0.0, 0.0), angular, state.joint_rates)[:3]
        return omega, self.y(state.shape, [*omega, 0.0, 0.0, 0.0], state.joint_rates)

    def momentum_rates(self, state: LocalState, u: Scalars) -> tuple[Scalars, Scalars]:
        """Rates of both momenta due to the external wrench, in start axes."""
        y = self.y(state.shape, [0.0] * 6, state.joint_rates)
        force, torque = self.balance.external_wrench(y, u)
        about_center = subtract(torque, cross(self.balance.momentum(y)[2], force))
        attitude = self.rotation_matrix(state.rotation)
        return matrix_vector(attitude, force), matrix_vector(attitude, about_center)

    def rates(self, y: Scalars, u: Scalars) -> list[Scalar]:
        state = self.parts(y)
        omega, moving = self._moving(state)
        return self._joined_rates(state, omega, self.base.rates(moving, u), u)

    def _joined_rates(self, state: LocalState, omega: Scalars, rates: Scalars, u: Scalars) -> list[Scalar]:
        linear, angular = self.momentum_rates(state, u)
        return self.joined(
            LocalState(
                self.rotation_rate(state.rotation, omega),
                [rates[i] for i in self.shape_indices],
                scale(1.0 / self.balance.mass, state.linear),
                linear,
                angular,
                [rates[i] for i in self.joint_indices],
            )
        )

    def linearized_rates(self, y: Scalars, u: Scalars) -> tuple[list[Scalar], Matrix, Matrix]:
        """Time derivative of a state and its Jacobians.

        The Jacobians of the given equations are reused; the angular velocity varies so as to conserve the
        momentum.
        """
        free, inputs = symbols("z", self.n_y), symbols("w", self.n_u)
        both = column(*free, *inputs)
        state = self.parts(free)
        omega, moving = self._moving(state)
        rates, by_y, by_u = self.base.linearized_rates(moving, inputs)
        change = casadi.horzcat(casadi.SX.eye(self.n_y), zeros(self.n_y, self.n_u))
        momentum = column(
            0.0, 0.0, 0.0, *transposed_matrix_vector(self.rotation_matrix(state.rotation), state.angular)
        )
        twist = self.twist_change(moving, casadi.jacobian(momentum, both), change)
        moved = zeros(self.base.n_y, self.n_y + self.n_u)
        moved[self.shape_indices, :] = change[self.shape, :]
        moved[self.joint_indices, :] = change[self.joint_rates, :]
        for index, direction in zip(self.base.pose.twist_indices, self.base.pose.directions, strict=True):
            if direction < 3:
                moved[index, :] = twist[direction, :]
        moved = casadi.mtimes(by_y, moved) + casadi.horzcat(zeros(self.base.n_y, self.n_y), by_u)
        # Everything else is explicit; the angular velocity and the given rates stand as they are in it.
        turning = symbols("omega", 3)
        explicit = column(*self._joined_rates(state, turning, [0.0] * self.base.n_y, inputs))
        jacobian = casadi.jacobian(explicit, both)
        jacobian += casadi.mtimes(casadi.jacobian(explicit, column(*turning)), twist[:3, :])
        jacobian = casadi.substitute(jacobian, column(*turning), casadi.densify(column(*omega)))
        jacobian[self.shape, :] = moved[self.shape_indices, :]
        jacobian[self.joint_rates, :] = moved[self.joint_indices, :]
        value = column(*self._joined_rates(state, omega, rates, inputs))
        values = casadi.densify(column(*y, *u))
        value, jacobian = casadi.substitute([casadi.densify(value), jacobian], [both], [values])
        jacobian = casadi.sparsify(jacobian)
        return casadi.vertsplit(value), jacobian[:, : self.n_y], jacobian[:, self.n_y :]

    def momentum_jacobian(self, y: Scalars) -> tuple[Matrix, Matrix]:
        """Derivatives by y of the momentum, SX (6, n), and the center of mass, SX (3, n), in base axes."""
        free = symbols("v", self.base.n_y)
        linear, angular, center = self.balance.momentum(free)
        jacobians = [
            casadi.jacobian(column(*entries), column(*free)) for entries in ((*linear, *angular), center)
        ]
        momentum, center = casadi.substitute(jacobians, [column(*free)], [casadi.densify(column(*y))])
        return casadi.sparsify(momentum), casadi.sparsify(center)

    def twist_change(self, y: Scalars, momentum: Matrix, local: Matrix) -> Matrix:
        """Change of the base's twist, SX (6, m), for m changes of momentum (base axes) and local state."""
        by_y = self.momentum_jacobian(y)[0]
        right = momentum - casadi.mtimes(by_y[:, self.shape_indices], local[self.shape, :])
        right = right - casadi.mtimes(by_y[:, self.joint_indices], local[self.joint_rates, :])
        right = casadi.sparsify(right)
        shape, still = [y[i] for i in self.shape_indices], [0.0] * len(self.joint_indices)
        changes = []
        for k in range(right.shape[1]):
            entries: list[Scalar] = [0.0] * 6
            for row, value in zip(right[:, k].row(), right[:, k].nonzeros(), strict=True):
                entries[row] = value
            changes.append(column(*self.twist(shape, entries[:3], entries[3:], still)))
        return columns(*changes, rows=6)

    # The way into these coordinates at the start of a step, and out of them at its end.

    def start(self, y: Scalars, momentum: tuple[Scalars, Scalars] | None = None) -> dict[str, Scalars]:
        """The local state at the start of a step, and the center of mass in the base frame.

        The linear and angular momentum, base axes, are those of y unless given.
        """
        linear, angular, center = self.balance.momentum(y)
        if momentum is not None:
            linear, angular = momentum
        zero = (0.0, 0.0, 0.0)
        shape, joint_rates = ([y[i] for i in part] for part in (self.shape_indices, self.joint_indices))
        state = LocalState(self.identity, shape, zero, linear, angular, joint_rates)
        return {"local": self.joined(state), "center": center}

    def _attitude(self, x: Scalars) -> Sequence[Scalars]:
        return poses.to_matrix(self.base.pose.full(split_state(self.base, x)[0]))[0]

    def turned_back(self, x: Scalars, momentum: Scalars) -> tuple[Scalars, Scalars]:
        """Linear and angular momentum in base axes, from `Kernels.momentum`, 6 in inertial axes."""
        linear, angular = (
            transposed_matrix_vector(self._attitude(x), part) for part in (momentum[:3], momentum[3:])
        )
        return linear, angular

    def turned_out(self, x: Scalars, linear: Scalars, angular: Scalars) -> list[Scalar]:
        """Linear and angular momentum in inertial axes, 6: the inverse of `turned_back`."""
        attitude = self._attitude(x)
        return [entry for part in (linear, angular) for entry in matrix_vector(attitude, part)]

    def handed_on(self, x: Scalars, momentum: Scalars, before: LocalState, after: LocalState) -> list[Scalar]:
        """Momentum in inertial axes after a step from x: that before it, and the change in the step."""
        gained = subtract(after.linear, before.linear), subtract(after.angular, before.angular)
        added = self.turned_out(x, *gained)
        return [old + new for old, new in zip(momentum, added, strict=True)]

    def ending(self, state: LocalState) -> tuple[Scalars, Scalars, Scalars]:
        """Linear and angular momentum and twist of the base in its axes at the end of a step.

        Each vector is rotated as v + 2 r x (...), not by a matrix: the entries of a matrix near 1 round the
        same way at every step of a steady rotation, and the momentum would shrink or grow with them.
        """
        back = quaternion.conjugate(self.quaternion(state.rotation))
        linear, angular = (rotations.rotate(back, part) for part in (state.linear, state.angular))
        bodies = self._less_wheels(state.shape, angular)
        return linear, angular, self.twist(state.shape, linear, bodies, state.joint_rates)

    def relative_pose(self, state: LocalState, before: Scalars, after: Scalars) -> Scalars:
        """Pose of the base seen from the start of the step, given the centers of mass in the base frame."""
        rotation = self.quaternion(state.rotation)
        position = subtract(add(state.displacement, before), rotations.rotate(rotation, after))
        return poses.from_rotation_and_position(rotation, position)

    def end(self, x: Scalars, before: Scalars, state: LocalState) -> list[Scalar]:
        """The state after a step from x, with the center of mass there."""
        pose = self.base.pose
        end = self.y(state.shape, self.ending(state)[2], state.joint_rates)
        relative = self.relative_pose(state, before, self.balance.momentum(end)[2])
        less_one = self.scalar_less_one(state.rotation)
        moved = composed(pose.full(split_state(self.base, x)[0]), (less_one, *relative[1:]))
        return [*pose.reduced(moved), *end]

    def estimate(self, state: LocalState, error: LocalState) -> list[Scalar]:
        """The error of a state in tangent coordinates of the given equations, but for terms of its square."""
        turning = self.twist(state.shape, (0.0, 0.0, 0.0), error.angular, error.joint_rates)[:3]
        twist = [*turning, *scale(1.0 / self.balance.mass, error.linear)]
        pose = [*error.rotation, *error.displacement]
        y = self.y(error.shape, twist, error.joint_rates)
        return [*(pose[i] for i in self.base.pose.directions), *y]


def _series(x: Scalar, coefficients: tuple[float, ...]) -> Scalar:
    value: Scalar = coefficients[0]
    for coefficient in coefficients[1:]:
        value = coefficient + x * value
    return value


def rotation_matrix(rotation: Scalars) -> list[list[Scalar]]:
    """Rotation matrix of a rotation vector, by power series for rotations within a step."""
    square = dot(rotation, rotation)
    sine = scale(_series(square, _SINE), rotation)
    cosine = scale(_series(square, _COSINE), rotation)
    skew = skew_matrix(sine)
    result = [[cosine[i] * rotation[j] + skew[i][j] for j in range(3)] for i in range(3)]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        result[i][i] = 1.0 - (cosine[j] * rotation[j] + cosine[k] * rotation[k])
    return result


def rotation_rate(rotation: Scalars, angular_velocity: Scalars) -> Scalars:
    """Time derivative of the rotation vector, dexp^-1, by power series; angular velocity in rotated axes."""
    once = cross(rotation, angular_velocity)
    twice = cross(rotation, once)
    factor = _series(dot(rotation, rotation), _COTANGENT)
    return add(angular_velocity, add(scale(0.5, once), scale(factor, twice)))
