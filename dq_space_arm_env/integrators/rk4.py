"""The classical Runge-Kutta method on SE(3): Munthe-Kaas for the pose, order 4, four evaluations.

Each stage starts from the one before, so a single graph with a step offset serves all four: fewer operations
than the generic stages of `explicit_runge_kutta`. The pose advances by one exponential of Omega, where Omega'
= dexp^-1(omega) with the twists omega of the stages (Munthe-Kaas, High order Runge-Kutta methods on
manifolds, 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import (
    PoseCoordinates,
    TwiceDifferentiableField,
    VectorField,
    split_state,
)
from dq_space_arm_env.integrators.explicit_stages import stage_pattern
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.munthe_kaas import slope, stage_twists
from dq_space_arm_env.integrators.pose_update import pose_blocks
from dq_space_arm_env.integrators.rk4_curvature import StepCurvature
from dq_space_arm_env.integrators.tableaus import RK4_OFFSETS, RK4_WEIGHTS

Scalar = Any
Matrix = Any


def advance(y: Sequence[Scalar], stages: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """Y + h (k1 + 2 k2 + 2 k3 + k4) / 6."""
    sixth = h * (1 / 6)
    return [
        entry + sixth * (k1 + 2.0 * (k2 + k3) + k4) for entry, k1, k2, k3, k4 in zip(y, *stages, strict=True)
    ]


def pose_slopes(
    pose: PoseCoordinates, twists: Sequence[Sequence[Scalar]], h: Scalar
) -> list[Sequence[Scalar]]:
    """Omega' at the stages, 6 entries each; stage i starts from Omega_i = RK4_OFFSETS[i] h w_{i-1}."""
    slopes: list[Sequence[Scalar]] = []
    for offset, free in zip(RK4_OFFSETS, twists, strict=True):
        omega = pose.full_twist(free)
        slopes.append(slope([offset * h * entry for entry in slopes[-1]], omega, 4) if slopes else omega)
    return slopes


def pose_increment(pose: PoseCoordinates, twists: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """Omega after one step, 6."""
    return advance([0.0] * 6, pose_slopes(pose, twists, h), h)


class RungeKuttaMuntheKaas4:
    """Classical Runge-Kutta for the velocities and angles, Munthe-Kaas for the pose."""

    embedded_order = 3

    def append_step(self, program: Program, field: VectorField) -> None:
        self._append_stages(program, field)

    def append_embedded_step(self, program: Program, field: VectorField) -> None:
        """See `EmbeddedIntegrator`: beside the step, one of order 3 with the rates k5 at its end.

        Its weights are 1/6, 1/3, 1/3, 0, 1/6: the difference is h (k4 - k5) / 6.
        """
        rates = self._append_stages(program, field, shows_pose_slope=field.pose is not None)
        program.call(rates, x="x_next", k="k0", rates="k5", offset="offset1")

        def estimate(
            x_next: list[Scalar],
            h: list[Scalar],
            k4: list[Scalar],
            k5: list[Scalar],
            increment: Sequence[Scalar] = (),
            pose_slope: Sequence[Scalar] = (),
        ) -> dict[str, Any]:
            sixth = h[0] * (1 / 6)
            error = [sixth * (last - end) for last, end in zip(k4, k5, strict=True)]
            if field.pose is None:
                return {"estimate": error}
            end = split_state(field, x_next)[1]
            there = field.pose.full_twist([end[i] for i in field.pose.twist_indices])
            last = slope(increment, there, 4)
            moved = [sixth * (pose_slope[i] - last[i]) for i in field.pose.directions]
            return {"estimate": [*moved, *error]}

        sizes = {"x_next": field.n_x, "h": 1, "k4": field.n_y, "k5": field.n_y}
        sizes |= {} if field.pose is None else {"increment": 6, "pose_slope": 6}
        program.call(trace(f"{field.name}_rk4_estimate", sizes, estimate))

    def _append_stages(self, program: Program, field: VectorField, *, shows_pose_slope: bool = False) -> Any:
        """The step, and Omega with its slope at the last stage if wanted; returns the graph of its stages."""

        def stage(x: list[Scalar], u: list[Scalar], k: list[Scalar], offset: list[Scalar]) -> dict[str, Any]:
            y = [entry + offset[0] * rate for entry, rate in zip(split_state(field, x)[1], k, strict=True)]
            return {"rates": field.rates(y, u)}

        def combine(x: list[Scalar], h: list[Scalar], **k: list[Scalar]) -> dict[str, Any]:
            stages = list(k.values())
            stored, start = split_state(field, x)
            y = advance(start, stages, h[0])
            if field.pose is None:
                return {"x_next": y}
            slopes = pose_slopes(field.pose, stage_twists(field.pose, start, stages, h[0]), h[0])
            increment = advance([0.0] * 6, slopes, h[0])
            shown = {"increment": increment, "pose_slope": slopes[-1]} if shows_pose_slope else {}
            return {"x_next": [*field.pose.moved(stored, increment), *y], **shown}

        n_y = field.n_y
        sizes = {"x": field.n_x, "u": field.n_u, "k": n_y, "offset": 1}
        rates = trace(f"{field.name}_rk4_stage", sizes, stage, parameters=field.parameters)
        sum_sizes = {"x": field.n_x, "h": 1, "k1": n_y, "k2": n_y, "k3": n_y, "k4": n_y}
        total = trace(f"{field.name}_rk4_sum", sum_sizes, combine)
        program.call(_offsets_graph(field), zero="offset1", half="offset2", full="offset4")
        for number, offset in enumerate(("offset1", "offset2", "offset2", "offset4"), start=1):
            program.call(rates, k=f"k{number - 1}", rates=f"k{number}", offset=offset)
        program.call(total)
        return rates

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        pattern = stage_pattern(field)
        stage = _linearized_stage(field, pattern)
        total, a_pattern, b_pattern = _linearized_sum(field, pattern)
        program.call(_offsets_graph(field), zero="offset1", half="offset2", full="offset4")
        for number, offset in enumerate(("offset1", "offset2", "offset2", "offset4"), start=1):
            program.call(
                stage,
                k=f"k{number - 1}",
                change=f"K{number - 1}",
                rates=f"k{number}",
                rate_change=f"K{number}",
                offset=offset,
            )
        program.call(total)
        return a_pattern, b_pattern

    def append_curvature(self, program: Program, field: TwiceDifferentiableField) -> Any:
        return StepCurvature(field).append(program)


def _offsets_graph(field: VectorField) -> Any:
    return trace(
        f"{field.name}_rk4_offsets", {"h": 1}, lambda h: {"zero": [0.0], "half": [0.5 * h[0]], "full": [h[0]]}
    )


def _linearized_stage(field: VectorField, pattern: Any) -> Any:
    """Graph of a stage's rates and of their derivative K = F Y + [0, G] by (y, u) at the step's start."""
    n_y, n_u = field.n_y, field.n_u
    x = symbols("x", field.n_x)
    u = symbols("u", n_u)
    k = symbols("k", n_y)
    change = casadi.SX.sym("change", pattern)
    offset = casadi.SX.sym("offset")
    y = [entry + offset * rate for entry, rate in zip(split_state(field, x)[1], k, strict=True)]
    rates, by_y, by_u = field.linearized_rates(y, u)
    start = casadi.horzcat(casadi.SX.eye(n_y), zeros(n_y, n_u)) + offset * change
    rate_change = casadi.mtimes(by_y, start) + casadi.horzcat(zeros(n_y, n_y), by_u)
    return graph_of(
        f"{field.name}_rk4_linearized_stage",
        graph_inputs(field, x=x, u=u, k=k, change=change.nonzeros(), offset=[offset]),
        {"rates": rates, "rate_change": casadi.project(rate_change, pattern).nonzeros()},
    )


def _linearized_sum(field: VectorField, pattern: Any) -> tuple[Any, Any, Any]:
    """Graph of A and B from the stages' rates and derivatives, and their patterns."""
    n_y, n_u = field.n_y, field.n_u
    x = symbols("x", field.n_x)
    h = casadi.SX.sym("h")
    stages = [symbols(f"k{s}", n_y) for s in range(1, 5)]
    changes = [casadi.SX.sym(f"K{s}", pattern) for s in range(1, 5)]
    identity = casadi.horzcat(casadi.SX.eye(n_y), zeros(n_y, n_u))
    change = identity
    # dy+ = dy + h sum_s b_s K_s.
    for weight, rate_change in zip(RK4_WEIGHTS, changes, strict=True):
        change = change + (weight * h) * rate_change
    if field.pose is None:
        a, b = change[:, :n_y], change[:, n_y:]
    else:
        start = split_state(field, x)[1]
        by_pose, moved = _linearized_pose(field.pose, start, h, stages, changes, identity)
        moved = casadi.vertcat(moved, change)
        a = casadi.horzcat(casadi.vertcat(by_pose, zeros(n_y, by_pose.shape[1])), moved[:, :n_y])
        b = moved[:, n_y:]
    a, b = casadi.sparsify(a), casadi.sparsify(b)
    inputs: dict[str, Sequence[Scalar]] = {"x": x, "h": [h]}
    inputs |= {f"k{s}": k for s, k in enumerate(stages, start=1)}
    inputs |= {f"K{s}": k.nonzeros() for s, k in enumerate(changes, start=1)}
    graph = graph_of(f"{field.name}_rk4_linearized_sum", inputs, {"A": a.nonzeros(), "B": b.nonzeros()})
    return graph, a.sparsity(), b.sparsity()


def _linearized_pose(
    pose: PoseCoordinates,
    y: Sequence[Scalar],
    h: Scalar,
    stages: Sequence[Sequence[Scalar]],
    changes: Sequence[Matrix],
    identity: Matrix,
) -> tuple[Matrix, Matrix]:
    """Derivatives of the pose update by the pose, and by (y, u) through Omega."""
    rows = list(pose.twist_indices)
    free = [symbols(f"w{s}", len(rows)) for s in range(4)]
    increment = column(*pose_increment(pose, free, h))
    moved = zeros(len(rows), identity.shape[1])
    for s, offset in enumerate(RK4_OFFSETS):
        twist_change = identity[rows, :]
        if s:
            twist_change = twist_change + (offset * h) * changes[s - 1][rows, :]
        slope = casadi.jacobian(increment, column(*free[s]))[list(pose.directions), :]
        moved = moved + casadi.mtimes(slope, twist_change)
    twists = stage_twists(pose, y, stages, h)
    placeholders = column(*(entry for twist in free for entry in twist))
    values = casadi.densify(column(*(entry for twist in twists for entry in twist)))
    increment, moved = casadi.substitute([increment, moved], [placeholders], [values])
    by_pose, by_increment = pose_blocks(pose, casadi.vertsplit(casadi.densify(increment)))
    return by_pose, casadi.mtimes(by_increment, moved)
