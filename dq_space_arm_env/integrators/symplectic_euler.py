"""Symplectic Euler: new velocities from the accelerations, new positions from the new velocities; order 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import (
    PoseCoordinates,
    TwiceDifferentiableField,
    VectorField,
    split_state,
)
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.pose_update import pose_blocks, pose_curvature, upper_triangle

Scalar = Any


class SymplecticEuler:
    """Semi-implicit Euler, v+ = v + h a(q, v, u) and q+ = q + h v+.

    Hairer, Lubich & Wanner, Geometric Numerical Integration, section I.1.
    """

    def append_step(self, program: Program, field: VectorField) -> None:
        x, u, h = symbols("x", field.n_x), symbols("u", field.n_u), casadi.SX.sym("h")
        stored, start = split_state(field, x)
        y = self._advance(field, start, u, h, field.rates(start, u))
        x_next = (
            y if field.pose is None else [*field.pose.moved(stored, self._increment(field.pose, y, h)), *y]
        )
        graph = graph_of(f"{field.name}_euler", graph_inputs(field, x=x, u=u, h=[h]), {"x_next": x_next})
        program.call(graph)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        x, u, h = symbols("x", field.n_x), symbols("u", field.n_u), casadi.SX.sym("h")
        start_y = split_state(field, x)[1]
        rates, by_y, by_u = field.linearized_rates(start_y, u)
        identity = casadi.SX.eye(field.n_y)
        rate_change = casadi.horzcat(by_y, by_u)
        start = casadi.horzcat(identity, zeros(field.n_y, field.n_u))
        # dv+ = dv + h da; positions then move with v+: dq+ = dq + h dv+.
        change = zeros(field.n_y, field.n_y + field.n_u)
        rows = list(field.rate_indices)
        change[rows, :] = start[rows, :] + h * rate_change[rows, :]
        others = [i for i in range(field.n_y) if i not in set(rows)]
        velocities = casadi.mtimes(by_y[others, rows], change[rows, :])
        inputs = casadi.horzcat(zeros(len(others), field.n_y), by_u[others, :])
        change[others, :] = start[others, :] + h * (velocities + inputs)
        if field.pose is not None:
            increment = self._increment(field.pose, self._advance(field, start_y, u, h, rates), h)
            by_pose, by_increment = pose_blocks(field.pose, increment)
            # d+ = Ad(exp(-Omega / 2)) d + Jr(Omega) h dv+.
            moved = casadi.mtimes(by_increment, h * change[list(field.pose.twist_indices), :])
            change = casadi.vertcat(moved, change)
            pose_columns = casadi.vertcat(by_pose, zeros(field.n_y, by_pose.shape[1]))
            a = casadi.horzcat(pose_columns, change[:, : field.n_y])
        else:
            a = change[:, : field.n_y]
        a, b = casadi.sparsify(a), casadi.sparsify(change[:, field.n_y :])
        graph = graph_of(
            f"{field.name}_euler_linearization",
            graph_inputs(field, x=x, u=u, h=[h]),
            {"A": a.nonzeros(), "B": b.nonzeros()},
        )
        program.call(graph)
        return a.sparsity(), b.sparsity()

    def append_curvature(self, program: Program, field: TwiceDifferentiableField) -> Any:
        x, u, h = symbols("x", field.n_x), symbols("u", field.n_u), casadi.SX.sym("h")
        n_y, n_u, twist = field.n_y, field.n_u, list(field.pose.twist_indices)
        multiplier = symbols("l", len(twist) + n_y)
        weights = column(*multiplier[len(twist) :])
        y = split_state(field, x)[1]
        rates, by_y, by_u = field.linearized_rates(y, u)
        increment = self._increment(field.pose, self._advance(field, y, u, h, rates), h)
        curved = pose_curvature(field.pose, increment, multiplier[: len(twist)])
        # Everything is linear in the new velocities but the pose: their multiplier collects what they move.
        rows = list(field.rate_indices)
        others = [i for i in range(n_y) if i not in set(rows)]
        moved = zeros(n_y, 1)
        moved[rows, 0] = weights[rows] + h * casadi.mtimes(by_y[others, rows].T, weights[others])
        moved[twist, 0] = moved[twist, 0] + h * curved.by_increment
        mu = h * casadi.densify(moved)
        hessian = field.rates_hessian(y, u, rates, by_y, by_u, mu.nonzeros())
        start = casadi.horzcat(casadi.SX.eye(n_y), zeros(n_y, n_u))
        twist_change = h * (start + h * casadi.horzcat(by_y, by_u))[twist, :]
        hessian = hessian + casadi.mtimes(twist_change.T, casadi.mtimes(curved.increment_twice, twist_change))
        above = casadi.horzcat(zeros(len(twist), len(twist)), casadi.mtimes(curved.mixed, twist_change))
        below = casadi.horzcat(zeros(n_y + n_u, len(twist)), hessian)
        curvature = upper_triangle(casadi.vertcat(above, below))
        graph = graph_of(
            f"{field.name}_euler_curvature",
            graph_inputs(field, x=x, u=u, h=[h], multiplier=multiplier),
            {"curvature": curvature.nonzeros()},
        )
        program.call(graph)
        return curvature.sparsity()

    def _advance(
        self, field: VectorField, y: Sequence[Scalar], u: Sequence[Scalar], h: Scalar, rates: list[Scalar]
    ) -> list[Scalar]:
        """New y: first its velocities, then the rest from the new velocities."""
        moved = list(y)
        for i in field.rate_indices:
            moved[i] = y[i] + h * rates[i]
        velocities = field.rates(moved, u)
        for i in set(range(field.n_y)) - set(field.rate_indices):
            moved[i] = y[i] + h * velocities[i]
        return moved

    def _increment(self, pose: PoseCoordinates, y: Sequence[Scalar], h: Scalar) -> list[Scalar]:
        """The new twist times the time step."""
        return pose.full_twist([h * y[i] for i in pose.twist_indices])
