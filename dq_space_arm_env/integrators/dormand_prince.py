"""The Dormand-Prince pair of orders 5 and 4 on SE(3), with substeps as small as the tolerances require.

A time step is divided into substeps, each tried with the method of order 5; the embedded one of order 4
estimates its error. Every state of a batch has its own substeps: the calls are repeated until the last
lane has arrived, and waiting lanes pass through them unchanged.

Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.4 (2nd ed., 1993).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import zeros
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.explicit_stages import ExplicitStages
from dq_space_arm_env.integrators.munthe_kaas import combined, stage_slopes
from dq_space_arm_env.integrators.tableaus import DORMAND_PRINCE_5, DORMAND_PRINCE_DENSE, DORMAND_PRINCE_ERROR

Scalar = Any
Scalars = Sequence[Scalar]

SMALLEST_SUBSTEP = 1e-6
"""Smallest substep, as a fraction of the step, before it is given up."""
MOST_SUBSTEPS = 10_000
"""So is one that needs more of them than this, rejected ones included."""
STRETCH = 1.01
"""Factor by which the last substep may exceed the chosen length."""
SAFETY, SMALLEST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 5.0
"""The next substep is 0.9 error^-3/16 times the last one, within these factors."""


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
        substeps = _Substeps(field)
        substeps.append_begin(program, (self.rtol, self.atol))
        substeps.stages.append_first(program)
        with program.repeated_while("unfinished"):
            substeps.append_length(program)
            substeps.stages.append_later(program, h="substep_time")
            substeps.append_attempt(program)
            substeps.append_choice(program, {"state": "state_tried", "y1": "y7", "k1": "k7"})
        substeps.append_end(program)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        substeps = _Substeps(field)
        substeps.append_begin(program, (self.rtol, self.atol))
        substeps.stages.append_linearized_first(program)
        names = {"state": "state_tried", "y1": "y7", "k1": "k7", "Y1": "Y7", "K1": "K7"}
        if field.pose is not None:
            substeps.append_pose_begin(program)
            names["pose_change"] = "pose_change_tried"
        with program.repeated_while("unfinished"):
            substeps.append_length(program)
            substeps.stages.append_linearized_later(program, h="substep_time", is_carried=True)
            substeps.append_attempt(program)
            substeps.append_pose_attempt(program)
            substeps.append_choice(program, names)
        return substeps.append_linearized_end(program)


def append_measured_step(program: Program, field: VectorField) -> None:
    """Append the calls that turn x, u, h, tolerances into x_next, `error` and `dense`: one undivided step.

    The error is that of `DormandPrince`, at most 1 within the tolerances (rtol, atol). `dense` has four
    tangent vectors d_n: the solution at a fraction theta of the step is x (+) sum_n theta^n d_n, to order 4.
    """
    substeps = _Substeps(field)
    substeps.stages.append(program)
    substeps.append_attempt(program, x="x", h="h", state_tried="x_next")
    program.call(substeps.dense_graph())


class _Substeps:
    """The calls of a time step that is divided into substeps.

    Buffers: `state` and `left`, the present state and the fraction of the step left; `substep`, the fraction
    to try next; `taken` and `substep_time`, the one being tried, as a fraction and in s; `tries`.
    """

    def __init__(self, field: VectorField) -> None:
        self.field = field
        self.stages = ExplicitStages(field, DORMAND_PRINCE_5)
        self.prefix = self.stages.prefix

    def append_begin(self, program: Program, tolerances: tuple[float, float]) -> None:
        """Start at x; the whole step is tried first."""

        def begin(x: Scalars) -> dict[str, Any]:
            return {"state": x, "left": [1.0], "substep": [1.0], "tries": [0.0], "tolerances": tolerances}

        program.call(trace(f"{self.prefix}_begin", {"x": self.field.n_x}, begin))

    def append_length(self, program: Program) -> None:
        """Length of the substep to try: at most what is left."""

        def length(h: Scalars, left: Scalars, substep: Scalars) -> dict[str, Any]:
            # A little more than was chosen, if a sliver would be left otherwise.
            taken = casadi.if_else(left[0] <= STRETCH * substep[0], left[0], substep[0])
            return {"taken": [taken], "substep_time": [taken * h[0]]}

        program.call(trace(f"{self.prefix}_length", {"h": 1, "left": 1, "substep": 1}, length))
        program.held |= {"taken", "substep_time"}

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
            errors = combined(DORMAND_PRINCE_ERROR, rates, h[0])
            moved = starts[-1]
            scaled = []
            for i, error in enumerate(errors):
                size = casadi.fmax(casadi.fabs(start[i]), casadi.fabs(moved[i]))
                scaled.append(error / (atol + rtol * (size if i in field.rate_indices else 1.0)))
            pose: Scalars = []
            if field.pose is not None:
                slopes = stage_slopes(field.pose, DORMAND_PRINCE_5, stages.twists(starts), h[0])
                pose = field.pose.moved(stored, combined(DORMAND_PRINCE_5.weights, slopes, h[0]))
                pose_errors = combined(DORMAND_PRINCE_ERROR, slopes, h[0])
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

    def append_choice(self, program: Program, names: Mapping[str, str]) -> None:
        """Accept the attempt if its error is tolerable, and choose the next length.

        `names` maps each buffer that moves on to the one tried.
        """
        sizes = program.scratch_sizes()

        def choose(
            error: Scalars, taken: Scalars, left: Scalars, tries: Scalars, **others: Scalars
        ) -> dict[str, Any]:
            # Written so that NaN is rejected: of two numbers that do not compare, the second is taken.
            accepted = casadi.logic_and(error[0] <= 1.0, left[0] > 0.0)
            remaining = casadi.if_else(accepted, left[0] - taken[0], left[0])
            eighth = casadi.sqrt(casadi.sqrt(casadi.sqrt(error[0])))
            factor = casadi.fmax(SAFETY / (eighth * casadi.sqrt(eighth)), SMALLEST_FACTOR)
            substep = taken[0] * casadi.fmin(factor, LARGEST_FACTOR)
            going = casadi.logic_and(remaining > 0.0, substep >= SMALLEST_SUBSTEP)
            unfinished = casadi.logic_and(going, tries[0] < MOST_SUBSTEPS - 1.0)
            kept = {
                f"{old}_kept": [
                    casadi.if_else(accepted, b, a) for a, b in zip(others[old], others[new], strict=True)
                ]
                for old, new in names.items()
            }
            # A lane that is given up goes no further, however long others in its block take.
            following = casadi.if_else(unfinished, substep, 0.0)
            scalars = {"left_kept": [remaining], "substep_kept": [following], "tries_kept": [tries[0] + 1.0]}
            return {**kept, **scalars, "unfinished": [unfinished]}

        values = {name: sizes[name] for pair in names.items() for name in pair}
        scalars = dict.fromkeys(("error", "taken", "left", "tries"), 1)
        program.call(trace(f"{self.prefix}_choice", {**scalars, **values}, choose))
        # A graph may not write where it reads.
        carried = {name: sizes[name] for name in (*names, "left", "substep", "tries")}

        def move(**kept: Scalars) -> dict[str, Any]:
            return {name: kept[f"{name}_kept"] for name in carried}

        kept_sizes = {f"{name}_kept": size for name, size in carried.items()}
        program.call(trace(f"{self.prefix}_move", kept_sizes, move))

    def append_end(self, program: Program) -> None:
        """The state at the end of the step; NaN if it was not reached."""

        def end(state: Scalars, left: Scalars) -> dict[str, Any]:
            return {"x_next": _or_nan(state, left[0])}

        program.call(trace(f"{self.prefix}_end", {"state": self.field.n_x, "left": 1}, end))

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
        outputs = {"A": _or_nan(a.nonzeros(), left), "B": _or_nan(b.nonzeros(), left)}
        program.call(graph_of(f"{self.prefix}_linearized_end", inputs, outputs))
        return a.sparsity(), b.sparsity()


def _or_nan(values: Scalars, left: Scalar) -> list[Scalar]:
    """The values, or NaN while part of the step is left."""
    return [casadi.if_else(left > 0.0, math.nan, value) for value in values]
