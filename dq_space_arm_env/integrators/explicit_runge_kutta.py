"""Explicit Runge-Kutta methods on SE(3) from any tableau, with Munthe-Kaas for the pose."""

from __future__ import annotations

from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import zeros
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.explicit_stages import ExplicitStages
from dq_space_arm_env.integrators.munthe_kaas import combined, stage_slopes
from dq_space_arm_env.integrators.tableaus import ButcherTableau

Scalar = Any


class ExplicitRungeKutta:
    """An explicit Runge-Kutta-Munthe-Kaas method with fixed steps."""

    embedded_order = 5

    def __init__(self, tableau: ButcherTableau) -> None:
        self.tableau = tableau

    def append_step(self, program: Program, field: VectorField) -> None:
        self._append(program, field, self.tableau)

    def append_embedded_step(self, program: Program, field: VectorField) -> None:
        """See `EmbeddedIntegrator`."""
        self._append(program, field, self.tableau.with_end, estimates=True)

    def _append(
        self, program: Program, field: VectorField, tableau: ButcherTableau, *, estimates: bool = False
    ) -> None:
        """Append the step; with its estimated error, if wanted."""
        stages = ExplicitStages(field, tableau)
        stages.append(program)

        def step(x: list[Scalar], h: list[Scalar], **others: list[Scalar]) -> dict[str, Any]:
            stored, start = split_state(field, x)
            rates = [others.get(f"k{i}", []) for i in stages.numbers]
            y = stages.moved(start, tableau.weights, rates, h[0])  # y + h sum_i b_i k_i
            error = combined(tableau.error, rates, h[0]) if estimates else []
            if field.pose is None:
                return {"x_next": y} | ({"estimate": error} if estimates else {})
            twists = stages.twists([others[f"y{i}"] for i in stages.numbers])
            # q exp(Omega / 2) with Omega = h sum_i b_i w_i, w_i the slopes dexp^-1(omega_i).
            slopes = stage_slopes(field.pose, tableau, twists, h[0])
            found = {"x_next": [*field.pose.moved(stored, combined(tableau.weights, slopes, h[0])), *y]}
            if estimates:
                moved = combined(tableau.error, slopes, h[0])
                found["estimate"] = [*(moved[i] for i in field.pose.directions), *error]
            return found

        weights = zip(stages.numbers, tableau.weights, strict=True)
        sizes = {"x": field.n_x, "h": 1} | {f"k{i}": field.n_y for i, w in weights if w or estimates}
        if field.pose is not None:
            sizes |= {f"y{i}": field.n_y for i in stages.numbers}
        program.call(trace(f"{stages.prefix}_sum", sizes, step))

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        stages = ExplicitStages(field, self.tableau)
        stages.append_linearized(program)
        h = casadi.SX.sym("h")
        weights = zip(self.tableau.weights, stages.numbers, strict=True)
        # dy+ = dy + h sum_i b_i K_i.
        change, inputs = stages.change([term for term in weights if term[0]], h, is_carried=False)
        bindings = {}
        if field.pose is None:
            a, b = change[:, : field.n_y], change[:, field.n_y :]
        else:
            bindings["pose_change"], pattern = stages.append_pose_change(program, numbers=stages.numbers)
            by_pose, moved, pose_inputs = stages.linearized_pose(pattern)
            moved = casadi.vertcat(moved, change)
            a = casadi.horzcat(
                casadi.vertcat(by_pose, zeros(field.n_y, by_pose.shape[1])), moved[:, : field.n_y]
            )
            b = moved[:, field.n_y :]
            inputs |= pose_inputs
        a, b = casadi.sparsify(a), casadi.sparsify(b)
        outputs = {"A": a.nonzeros(), "B": b.nonzeros()}
        graph = graph_of(f"{stages.prefix}_linearized_sum", {"h": [h], **inputs}, outputs)
        program.call(graph, **bindings)
        return a.sparsity(), b.sparsity()
