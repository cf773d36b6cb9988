"""Methods that conserve the total momentum exactly: any method for vectors, in other coordinates.

A step changes to coordinates in which the momentum is a state (`momentum_coordinates`), lets another method
advance them, and changes back. Without external wrenches the momentum is conserved to the rounding of a
single evaluation; a base actuator or a wrench at the tip changes it by the impulse that the method computes.
The order is that of the inner method.

A state holds the base's velocity, rounded, so the momentum recomputed from it at every step wanders like the
square root of the number of steps. Over millions of steps, `append_walk` also hands on the momentum itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion, poses, rotations, screw
from dq_space_arm_env.algebra.dual_vectors import transform_matrix
from dq_space_arm_env.algebra.symbolic import matrix, symbols, zeros
from dq_space_arm_env.algebra.vectors import skew_matrix
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.method import EmbeddedIntegrator, Integrator, graph_inputs
from dq_space_arm_env.integrators.momentum_coordinates import LocalState, MomentumCoordinates

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any


class MomentumPreserving:
    """A method for vectors, in coordinates with the momentum in place of the base's velocity."""

    def __init__(self, method: Integrator) -> None:
        self.method = method

    @property
    def embedded_order(self) -> int:
        """Order of the inner method's embedded one."""
        return self._embedded.embedded_order

    @property
    def _embedded(self) -> EmbeddedIntegrator:
        if not isinstance(self.method, EmbeddedIntegrator):
            raise TypeError(f"{type(self.method).__name__} does not estimate its error")
        return self.method

    def append_step(self, program: Program, field: VectorField) -> None:
        coordinates = _coordinates(field)
        x, center, local = _symbols(coordinates)
        start = coordinates.start(split_state(field, x)[1])
        program.call(self._graph("enter", coordinates, {"x": x}, start))
        self._advance(program, coordinates)
        inputs = {"x": x, "center": center, "local_next": local}
        outputs = {"x_next": coordinates.end(x, center, coordinates.parts(local))}
        program.call(self._graph("leave", coordinates, inputs, outputs))

    def append_embedded_step(self, program: Program, field: VectorField) -> None:
        """See `EmbeddedIntegrator`."""
        coordinates = _coordinates(field)
        x, center, local = _symbols(coordinates)
        start = coordinates.start(split_state(field, x)[1])
        program.call(self._graph("enter", coordinates, {"x": x}, start))
        inner = Program("embedded_step", [], [])
        self._embedded.append_embedded_step(inner, coordinates)
        program.append(inner, **_BUFFERS)
        estimate, end = symbols("e", coordinates.n_y), coordinates.parts(local)
        inputs = {"x": x, "center": center, "local_next": local, "local_estimate": estimate}
        outputs = {
            "x_next": coordinates.end(x, center, end),
            "estimate": coordinates.estimate(end, coordinates.parts(estimate)),
        }
        program.call(self._graph("leave_embedded", coordinates, inputs, outputs))

    def append_walk(self, program: Program, field: VectorField) -> None:
        """See `MomentumIntegrator`."""
        coordinates = _coordinates(field)
        x, center, local = _symbols(coordinates)
        momentum = symbols("momentum", 6)
        entered = coordinates.start(split_state(field, x)[1], coordinates.turned_back(x, momentum))
        program.call(self._graph("carry_in", coordinates, {"x": x, "momentum": momentum}, entered))
        self._advance(program, coordinates)
        begun = symbols("b", coordinates.n_y)
        before, after = coordinates.parts(begun), coordinates.parts(local)
        outputs = {
            "x_next": coordinates.end(x, center, after),
            "momentum_next": coordinates.handed_on(x, momentum, before, after),
        }
        inputs = {"x": x, "momentum": momentum, "center": center, "local": begun, "local_next": local}
        program.call(self._graph("carry_out", coordinates, inputs, outputs))

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        coordinates = _coordinates(field)
        x, center, local = _symbols(coordinates)
        y = split_state(field, x)[1]
        program.call(self._graph("enter", coordinates, {"x": x}, coordinates.start(y)))
        inner = Program("linearization", [], [])
        patterns = self.method.append_linearization(inner, coordinates)
        program.append(inner, **_BUFFERS)
        # One more step, for the state that it leads to.
        self._advance(program, coordinates)
        by_start, by_input = (
            casadi.SX.sym(key, pattern) for key, pattern in zip("AB", patterns, strict=True)
        )
        by_y, center_by_y = _linearized_start(coordinates, y)
        by_pose, by_local, by_center = _linearized_left(coordinates, coordinates.parts(local), center)
        through = casadi.mtimes(by_local, casadi.mtimes(by_start, by_y))
        through = through + casadi.mtimes(by_center, center_by_y)
        a = casadi.sparsify(casadi.horzcat(by_pose, through))
        b = casadi.sparsify(casadi.mtimes(by_local, by_input))
        inputs = {"x": x, "center": center, "local_next": local}
        inputs |= {"local_A": by_start.nonzeros(), "local_B": by_input.nonzeros()}
        outputs = {"A": a.nonzeros(), "B": b.nonzeros()}
        program.call(self._graph("linearized", coordinates, inputs, outputs))
        return a.sparsity(), b.sparsity()

    def _advance(self, program: Program, coordinates: MomentumCoordinates) -> None:
        inner = Program("step", [], [])
        self.method.append_step(inner, coordinates)
        program.append(inner, **_BUFFERS)

    def _graph(
        self,
        name: str,
        coordinates: MomentumCoordinates,
        inputs: Mapping[str, Scalars],
        outputs: Mapping[str, Scalars],
    ) -> Any:
        return graph_of(f"{coordinates.name}_{name}", graph_inputs(coordinates, **inputs), outputs)


_BUFFERS = {
    "x": "local",
    "x_next": "local_next",
    "A": "local_A",
    "B": "local_B",
    "estimate": "local_estimate",
}


def _coordinates(field: VectorField) -> MomentumCoordinates:
    if not isinstance(field, SpaceArmField):
        raise TypeError(f"equations {field.name!r} do not tell the momentum of the system")
    return MomentumCoordinates(field)


def _symbols(coordinates: MomentumCoordinates) -> tuple[list[Scalar], list[Scalar], list[Scalar]]:
    """State and center of mass in the base frame at the start of a step, local state at its end."""
    return symbols("x", coordinates.base.n_x), symbols("c", 3), symbols("z", coordinates.n_y)


def _linearized_start(coordinates: MomentumCoordinates, y: Scalars) -> tuple[Matrix, Matrix]:
    """Derivatives of the local state at the start of a step, and of the center of mass, by y."""
    momentum, center = coordinates.momentum_jacobian(y)
    identity = casadi.SX.eye(coordinates.base.n_y)
    result = zeros(coordinates.n_y, coordinates.base.n_y)
    result[coordinates.shape, :] = identity[coordinates.shape_indices, :]
    result[coordinates.linear, :] = momentum[coordinates.moving, :]
    result[coordinates.angular, :] = momentum[[3 + axis for axis in coordinates.turning], :]
    result[coordinates.joint_rates, :] = identity[coordinates.joint_indices, :]
    return casadi.sparsify(result), center


def _linearized_left(
    coordinates: MomentumCoordinates, state: LocalState, before: Scalars
) -> tuple[Matrix, Matrix, Matrix]:
    """Derivatives of the new state, in tangent coordinates.

    By the pose at the start, by the local state at the end, and by the center of mass at the start.
    """
    field, change = coordinates.base, casadi.SX.eye(coordinates.n_y)
    linear, angular, twist = coordinates.ending(state)
    y = coordinates.y(state.shape, twist, state.joint_rates)
    center = coordinates.balance.momentum(y)[2]
    jacobian = screw.exponential_right_jacobian((*state.rotation, 0.0, 0.0, 0.0))
    turned = matrix([[row[i] for i in coordinates.turning] for row in jacobian[:3]])
    turned = casadi.mtimes(turned, change[coordinates.rotation, :])
    # A vector v that is constant in start axes changes by v x (rotation) as the base turns.
    back = matrix(rotations.to_matrix(rotations.exponential(state.rotation))).T
    momentum = casadi.vertcat(
        casadi.mtimes(back[:, coordinates.moving], change[coordinates.linear, :])
        + casadi.mtimes(matrix(skew_matrix(linear)), turned),
        casadi.mtimes(back[:, coordinates.turning], change[coordinates.angular, :])
        + casadi.mtimes(matrix(skew_matrix(angular)), turned),
    )
    by_shape = coordinates.momentum_jacobian(y)[1][:, coordinates.shape_indices]
    moved = casadi.mtimes(back[:, coordinates.moving], change[coordinates.displacement, :])
    moved = moved + casadi.mtimes(matrix(skew_matrix(center)), turned)
    moved = moved - casadi.mtimes(by_shape, change[coordinates.shape, :])
    directions = list(field.pose.directions)
    rest = zeros(field.n_y, coordinates.n_y)
    rest[coordinates.shape_indices, :] = change[coordinates.shape, :]
    rest[list(field.pose.twist_indices), :] = coordinates.twist_change(y, momentum, change)[directions, :]
    rest[coordinates.joint_indices, :] = change[coordinates.joint_rates, :]
    by_local = casadi.vertcat(casadi.vertcat(turned, moved)[directions, :], rest)
    by_center = casadi.vertcat(casadi.vertcat(zeros(3, 3), back)[directions, :], zeros(field.n_y, 3))
    backward = dual_quaternion.conjugate(coordinates.relative_pose(state, before, center))
    adjoint = matrix(transform_matrix(*poses.to_matrix(backward)))[directions, directions]
    by_pose = casadi.vertcat(adjoint, zeros(field.n_y, len(directions)))
    return by_pose, casadi.sparsify(by_local), casadi.sparsify(by_center)
