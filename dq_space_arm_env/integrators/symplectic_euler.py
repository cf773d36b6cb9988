"""Symplectic Euler: new velocities from the accelerations, new positions from the new velocities; order 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.integrators.field import VectorField, move_pose
from dq_space_arm_env.integrators.linearization import pose_blocks

Scalar = Any


class SymplecticEuler:
    """Semi-implicit Euler (Hairer, Lubich & Wanner, Geometric Numerical Integration, I.1)."""

    name = "symplectic_euler"
    order = 1
    evaluations = 1

    def append_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn buffers x, u, h into x_next."""
        x, u, h = _symbols(field)
        y, increment = self._advance(field, x, u, h, field.rates(x[field.n_pose :], u))
        x_next = [*move_pose(field, x[: field.n_pose], increment), *y] if field.n_pose else y
        graph = graph_of(f"{field.name}_euler", {"x": x, "u": u, "h": [h]}, {"x_next": x_next})
        program.call(graph)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """Append the calls that turn x, u, h into the nonzeros of A and B; returns their patterns."""
        x, u, h = _symbols(field)
        rates, by_y, by_u = field.linearized_rates(x[field.n_pose :], u)
        identity = casadi.SX.eye(field.n_y)
        rate_change = casadi.horzcat(by_y, by_u)
        start = casadi.horzcat(identity, casadi.SX(field.n_y, field.n_u))
        # New rates first; positions then move with the new rates, whose derivative is already there.
        change = casadi.SX(field.n_y, field.n_y + field.n_u)
        rows = list(field.rate_indices)
        change[rows, :] = start[rows, :] + h * rate_change[rows, :]
        others = [i for i in range(field.n_y) if i not in set(rows)]
        velocities = casadi.mtimes(by_y[others, rows], change[rows, :])
        inputs = casadi.horzcat(casadi.SX(len(others), field.n_y), by_u[others, :])
        change[others, :] = start[others, :] + h * (velocities + inputs)
        if field.n_pose:
            _, increment = self._advance(field, x, u, h, rates)
            by_pose, by_increment = pose_blocks(field, increment)
            moved = casadi.mtimes(by_increment, h * change[list(field.twist_indices), :])
            change = casadi.vertcat(moved, change)
            pose_columns = casadi.vertcat(by_pose, casadi.SX(field.n_y, by_pose.shape[1]))
            a = casadi.horzcat(pose_columns, change[:, : field.n_y])
        else:
            a = change[:, : field.n_y]
        a, b = casadi.sparsify(a), casadi.sparsify(change[:, field.n_y :])
        graph = graph_of(
            f"{field.name}_euler_linearization",
            {"x": x, "u": u, "h": [h]},
            {"A": a.nonzeros(), "B": b.nonzeros()},
        )
        program.call(graph)
        return a.sparsity(), b.sparsity()

    def _advance(
        self, field: VectorField, x: Sequence[Scalar], u: Sequence[Scalar], h: Scalar, rates: list[Scalar]
    ) -> tuple[list[Scalar], Sequence[Scalar]]:
        """New y, and the twist times the time step."""
        y = list(x[field.n_pose :])
        for i in field.rate_indices:
            y[i] = y[i] + h * rates[i]
        positions = set(range(field.n_y)) - set(field.rate_indices)
        velocities = field.rates(y, u)
        for i in positions:
            y[i] = y[i] + h * velocities[i]
        increment = field.full_twist([h * y[i] for i in field.twist_indices])
        return y, increment


def _symbols(field: VectorField) -> tuple[list[Scalar], list[Scalar], Scalar]:
    x = [casadi.SX.sym(f"x_{i}") for i in range(field.n_x)]
    u = [casadi.SX.sym(f"u_{i}") for i in range(field.n_u)]
    return x, u, casadi.SX.sym("h")
