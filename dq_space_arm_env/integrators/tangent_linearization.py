"""Exact derivatives of any step in forward mode, for methods that divide steps or differentiate the field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.symbolic import columns, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.compiler.tangent import append_for_each, append_tangents
from dq_space_arm_env.dynamics.vector_field import PoseCoordinates, VectorField, split_state

Scalar = Any


def append_tangent_linearization(
    program: Program, field: VectorField, append_step: Callable[[Program, VectorField], None]
) -> tuple[Any, Any]:
    """Append the calls that turn x, u, h into A and B; see `Integrator.append_linearization`."""
    append_step(program, field)
    changes = append_tangents(program, ("x", "u"), "x_next")
    assert changes is not None
    names = append_for_each(program, tangent_graph(field), "change", changes, "dx_next")
    pose, n_t = field.pose, field.n_y + (len(field.pose.directions) if field.pose is not None else 0)
    x, free = symbols("x", field.n_x), [symbols(f"d{j}", n_t) for j in range(len(names))]
    by_x, by_u = (
        columns(*(casadi.vertcat(*entries) for entries in part), rows=n_t)
        for part in (free[: field.n_x], free[field.n_x :])
    )
    a = by_x
    if pose is not None:
        moved = casadi.mtimes(by_x[:, : field.n_x - field.n_y], retraction(pose, x))
        a = casadi.horzcat(moved, by_x[:, field.n_x - field.n_y :])
    a, b = casadi.densify(a), casadi.densify(by_u)
    inputs = {"x": x, **{f"d{j}": entries for j, entries in enumerate(free)}}
    graph = graph_of(f"{field.name}_derivatives", inputs, {"A": a.nonzeros(), "B": b.nonzeros()})
    program.call(graph, **{f"d{j}": name for j, name in enumerate(names)})
    return a.sparsity(), b.sparsity()


def tangent_graph(field: VectorField) -> Any:
    """Graph of the tangent coordinates of a small change of x_next, see `tangent_changes`."""
    x, change = symbols("x", field.n_x), symbols("change", field.n_x)
    outputs = {"dx_next": tangent_changes(field, x, change)}
    return graph_of(f"{field.name}_tangent", {"x_next": x, "change": change}, outputs)


def tangent_changes(field: VectorField, x: Sequence[Scalar], change: Sequence[Scalar]) -> list[Scalar]:
    """Tangent coordinates of a small change of a state, n_t: twist 2 vec(q* dq), and dy."""
    rest = list(split_state(field, change)[1])
    if field.pose is None:
        return rest
    pose, moved = (field.pose.full(split_state(field, each)[0]) for each in (x, change))
    twist = dq.to_vector(dq.scale(2.0, dq.multiply(dq.conjugate(pose), moved)))
    return [*(twist[i] for i in field.pose.directions), *rest]


def retraction(pose: PoseCoordinates, x: Sequence[Scalar]) -> Any:
    """Derivative of the stored pose q exp(d / 2) by d at zero, SX (stored, directions)."""
    here = pose.full(x[: len(pose.stored)])
    result = zeros(len(pose.stored), len(pose.directions))
    for j, direction in enumerate(pose.directions):
        half = [0.5 if i == direction else 0.0 for i in range(6)]
        change = dq.multiply(here, (0.0, *half[:3], 0.0, *half[3:]))
        for i, entry in enumerate(pose.reduced(change)):
            result[i, j] = entry
    return result
