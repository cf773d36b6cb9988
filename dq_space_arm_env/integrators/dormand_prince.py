"""The Dormand-Prince pair of orders 5 and 4 on SE(3), with substeps as small as the tolerances require.

A time step is divided into substeps, each tried with the method of order 5; the embedded one of order 4
estimates its error. Every state of a batch has its own substeps: the calls are repeated until the last
lane has arrived, and waiting lanes pass through them unchanged.

Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.4 (2nd ed., 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import zeros
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.explicit_stages import ExplicitStages
from dq_space_arm_env.integrators.munthe_kaas import combined, stage_slopes
from dq_space_arm_env.integrators.substeps import Substeps, fifth_root, or_nan
from dq_space_arm_env.integrators.tableaus import DORMAND_PRINCE_5, DORMAND_PRINCE_DENSE

Scalar = Any
Scalars = Sequence[Scalar]

MOST_SUBSTEPS = 10_000
"""A step that needs more of them than this, rejected ones included, is given up."""


@dataclass(frozen=True)
class DormandPrince:
    """Dormand-Prince 5(4) with adaptive substeps; Munthe-Kaas for the pose.

    The error of a substep is the root mean square, over the tangent coordinates, of the difference between
    both solutions in units of the tolerance: atol + rtol |v| for a velocity v, atol + rtol for the pose and
    the angles, which have no natural zero. A state that cannot be advanced within the tolerances becomes NaN.
    Derivatives are those of the substeps taken, their lengths held fixed.
    """

    rtol: float = 1e-8
    atol: float = 1e-10  # rad, m, rad/s and m/s

    def append_step(self, program: Program, field: VectorField) -> None:
        attempts = _Attempts(field)
        substeps = self._begun(program, attempts, attempts.prefix)
        attempts.stages.append_first(program)
        with program.repeated_while("unfinished"):
            substeps.append_length(program)
            attempts.stages.append_later(program, h="substep_time")
            attempts.append_attempt(program)
            substeps.append_choice(program, {"state": "state_tried", "y1": "y7", "k1": "k7"})
        substeps.append_end(program, state="x_next")

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        attempts = _Attempts(field)
        # A step may stand before in the program, whose graphs have other names.
        substeps = self._begun(program, attempts, f"{attempts.prefix}_linearized")
        attempts.stages.append_linearized_first(program)
        names = {"state": "state_tried", "y1": "y7", "k1": "k7", "Y1": "Y7", "K1": "K7"}
        if field.pose is not None:
            attempts.append_pose_begin(program)
            names["pose_change"] = "pose_change_tried"
        with program.repeated_while("unfinished"):
            substeps.append_length(program)
            attempts.stages.append_linearized_later(program, h="substep_time", is_carried=True)
            attempts.append_attempt(program)
            attempts.append_pose_attempt(program)
            substeps.append_choice(program, names)
        return attempts.append_linearized_end(program)

    def _begun(self, program: Program, attempts: _Attempts, prefix: str) -> Substeps:
        """Begin a step, whose substeps' graphs have names with a prefix."""
        tolerances = {"tolerances": [self.rtol, self.atol]}
        program.call(trace(f"{attempts.prefix}_tolerances", {}, lambda: tolerances))
        substeps = Substeps(prefix, fifth_root, MOST_SUBSTEPS)
        substeps.append_begin(program, state="x")
        return substeps


def append_measured_step(program: Program, field: VectorField) -> None:
    """Append the calls that turn x, u, h, tolerances into x_next, `error` and `dense`: one undivided step.

    The error is that of `DormandPrince`, at most 1 within the tolerances (rtol, atol). `dense` has four
    tangent vectors d_n: the solution at a fraction theta of the step is x (+) sum_n theta^n d_n, to order 4.
    """
    attempts = _Attempts(field)
    attempts.stages.append(program)
    attempts.append_attempt(program, x="x", h="h", state_tried="x_next")
    program.call(attempts.dense_graph())


class _Attempts:
    """The calls that try a substep from buffer `state`."""

    def __init__(self, field: VectorField) -> None:
        self.field = field
        self.stages = ExplicitStages(field, DORMAND_PRINCE_5)
        self.prefix = self.stages.prefix

    def append_attempt(
        self, program: Program, x: str = "state", h: str = "substep_time", state_tried: str = "state_tried"
    ) -> None:
        """The state after the stages, and its error in units of the tolerances."""
        field, stages = self.field, self.stages

        def attempt(x: Scalars, h: Scalars, tolerances: Scalars, **others: Scalars) -> dict[str, Any]:
            rtol, atol = tolerances
            stored, start = split_state(field, x)
            starts = [others[f"y{i}"] for i in stages.numbers]
            rates = [others[f"k{i}"] for i in stages.numbers]
            errors = combined(DORMAND_PRINCE_5.error, rates, h[0])
            moved = starts[-1]
            scaled = []
            for i, error in enumerate(errors):
                size = casadi.fmax(casadi.fabs(start[i]), casadi.fabs(moved[i]))
                scaled.append(error / (atol + rtol * (size if i in field.rate_indices else 1.0)))
            pose: Scalars = []
            if field.pose is not None:
                slopes = stage_slopes(field.pose, DORMAND_PRINCE_5, stages.twists(starts), h[0])
                pose = field.pose.moved(stored, combined(DORMAND_PRINCE_5.weights, slopes, h[0]))
                pose_errors = combined(DORMAND_PRINCE_5.error, slopes, h[0])
                scaled += [pose_errors[i] / (atol + rtol) for i in field.pose.directions]
            square: Scalar = 0.0
            for error in scaled:
                square = square + error * error
            return {"x_next": [*pose, *moved], "error": [casadi.sqrt(square / len(scaled))]}

        sizes = {"x": field.n_x, "h": 1, "tolerances": 2, **self._stage_sizes()}
        graph = trace(f"{self.prefix}_attempt", sizes, attempt)
        program.call(graph, x=x, h=h, x_next=state_tried)

    def _stage_sizes(self) -> dict[str, int]:
        return {f"{name}{i}": self.field.n_y for name in "yk" for i in self.stages.numbers}

    def dense_graph(self) -> Any:
        """Graph of the tangent vectors of the dense output."""
        field, stages = self.field, self.stages

        def dense(h: Scalars, **others: Scalars) -> dict[str, Any]:
            starts = [others[f"y{i}"] for i in stages.numbers]
            rates = [list(others[f"k{i}"]) for i in stages.numbers]
            if field.pose is not None:
                slopes = stage_slopes(field.pose, DORMAND_PRINCE_5, stages.twists(starts), h[0])
                rates = [
                    [*(slope[i] for i in field.pose.directions), *rate]
                    for slope, rate in zip(slopes, rates, strict=True)
                ]
            powers = [combined(weights, rates, h[0]) for weights in zip(*DORMAND_PRINCE_DENSE, strict=True)]
            return {"dense": [entry for power in powers for entry in power]}

        return trace(f"{self.prefix}_dense", {"h": 1, **self._stage_sizes()}, dense)

    # Derivatives.

    def append_pose_begin(self, program: Program) -> None:
        """Derivative of the pose at the start of the step, by pose, y and u."""
        assert self.field.pose is not None
        n, width = len(self.field.pose.directions), self.field.n_y + self.field.n_u
        values = [*casadi.densify(casadi.SX.eye(n)).nonzeros(), *[0.0] * (n * width)]
        program.call(graph_of(f"{self.prefix}_pose_begin", {}, {"pose_change": values}))

    def append_pose_attempt(self, program: Program) -> None:
        """Derivative of the tried pose by pose, y and u: dense, by column."""
        field, stages = self.field, self.stages
        if field.pose is None:
            return
        n = len(field.pose.directions)
        buffer, pattern = stages.append_pose_change(program, h="substep_time", numbers=stages.numbers)
        by_pose, moved, inputs = stages.linearized_pose(pattern)
        before = casadi.SX.sym("before", n, n + field.n_y + field.n_u)
        after = casadi.mtimes(by_pose, before) + casadi.horzcat(zeros(n, n), moved)
        graph = graph_of(
            f"{self.prefix}_pose_attempt",
            {**inputs, "before": before.nonzeros()},
            {"after": casadi.densify(after).nonzeros()},
        )
        program.call(graph, before="pose_change", after="pose_change_tried", pose_change=buffer)

    def append_linearized_end(self, program: Program) -> tuple[Any, Any]:
        """A and B from the derivatives carried to the end; NaN if it was not reached."""
        field, stages = self.field, self.stages
        total, left = casadi.SX.sym("Y1", stages.start_pattern), casadi.SX.sym("left")
        inputs: dict[str, Scalars] = {"Y1": total.nonzeros(), "left": [left]}
        if field.pose is not None:
            n, width = len(field.pose.directions), field.n_y + field.n_u
            pose_change = casadi.SX.sym("pose_change", n, n + width)
            inputs["pose_change"] = pose_change.nonzeros()
            total = casadi.vertcat(pose_change, casadi.horzcat(zeros(field.n_y, n), total))
        n_t = total.shape[0]  # a matrix of n_t + n_u columns
        a, b = total[:, :n_t], total[:, n_t:]
        outputs = {"A": or_nan(a.nonzeros(), left), "B": or_nan(b.nonzeros(), left)}
        program.call(graph_of(f"{self.prefix}_linearized_end", inputs, outputs))
        return a.sparsity(), b.sparsity()
