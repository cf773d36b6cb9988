"""Dormand and Prince's pair of orders 5 and 4 on the group, with steps as small as the tolerances ask for.

A time step is divided into shares, each tried with the method of order 5; the embedded one of order 4 tells
its error. Every state of a batch has shares of its own: the calls are repeated until the last lane has
arrived, and lanes that wait pass through them unchanged.

Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section II.4 (2nd ed., 1993).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.compiler.symbols import zeros
from dq_space_arm_env.integrators.explicit_stages import ExplicitStages
from dq_space_arm_env.integrators.field import VectorField, split_state
from dq_space_arm_env.integrators.munthe_kaas import combined, stage_slopes
from dq_space_arm_env.integrators.tableaus import (
    DORMAND_PRINCE_5,
    DORMAND_PRINCE_DENSE,
    DORMAND_PRINCE_ERROR,
)

Scalar = Any
Scalars = Sequence[Scalar]

SMALLEST_SHARE = 1e-6
"""A time step that needs smaller shares than this is given up."""
MOST_SHARES = 10_000
"""So is one that needs more of them than this, rejected ones included."""
STRETCH = 1.01
"""How much longer than chosen the last share may be."""
SAFETY, SMALLEST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 5.0
"""A share follows another that was 0.9 error^-3/16 as long, within these factors."""


@dataclass(frozen=True)
class DormandPrince:
    """Dormand-Prince 5(4) with steps chosen inside the time step; the Munthe-Kaas method for the pose.

    The error of a share is the root mean square, over the tangent coordinates, of the difference between both
    solutions in multiples of what is tolerated: atol + rtol |v| for a velocity v, atol + rtol for the pose
    and the angles, which have no natural zero to be relative to. A state that cannot be advanced within the
    tolerances becomes NaN.

    Derivatives are those of the steps that were taken, with their lengths held fixed.

    Attributes:
        rtol: Relative tolerance.
        atol: Absolute tolerance, rad, m, rad/s and m/s.
    """

    rtol: float = 1e-8
    atol: float = 1e-10

    name = "dormand_prince"
    order = 5
    has_curvature = False

    def append_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn buffers x, u, h into x_next."""
        shares = _Shares(field)
        shares.append_begin(program, (self.rtol, self.atol))
        shares.stages.append_first(program)
        with program.repeated_while("unfinished"):
            shares.append_length(program)
            shares.stages.append_later(program, h="share_time")
            shares.append_attempt(program)
            shares.append_choice(program, {"state": "state_tried", "y1": "y7", "k1": "k7"})
        shares.append_end(program)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """Append the calls that turn x, u, h into the nonzeros of A and B; returns their patterns."""
        shares = _Shares(field)
        shares.append_begin(program, (self.rtol, self.atol))
        shares.stages.append_linearized_first(program)
        names = {"state": "state_tried", "y1": "y7", "k1": "k7", "Y1": "Y7", "K1": "K7"}
        if field.pose is not None:
            shares.append_pose_begin(program)
            names["pose_change"] = "pose_change_tried"
        with program.repeated_while("unfinished"):
            shares.append_length(program)
            shares.stages.append_linearized_later(program, h="share_time", is_carried=True)
            shares.append_attempt(program)
            shares.append_pose_attempt(program)
            shares.append_choice(program, names)
        return shares.append_linearized_end(program)


def append_measured_step(program: Program, field: VectorField) -> None:
    """Append the calls that turn x, u, h, tolerances into x_next, `error` and `dense`: a step, undivided.

    The error is that of `DormandPrince`, one scalar, at most 1 within the tolerances. `dense` has four
    tangent vectors d_n: the solution passes x (+) sum_n theta^n d_n, a share theta of the step, to order 4.

    Args:
        program: Program to append to; its buffer `tolerances` has the relative and the absolute one.
        field: The equations of motion.
    """
    shares = _Shares(field)
    shares.stages.append(program)
    shares.append_attempt(program, x="x", h="h", state_tried="x_next")
    program.call(shares.dense_graph())


class _Shares:
    """The calls of a time step that is divided into shares.

    Buffers: `state` and `left`, where the step stands and the share of it that is left; `share`, the length
    to try next; `taken` and `share_time`, the length that is tried now, as a share and in s; `tries`.
    """

    def __init__(self, field: VectorField) -> None:
        self.field = field
        self.stages = ExplicitStages(field, DORMAND_PRINCE_5, DormandPrince.name)
        self.prefix = self.stages.prefix

    def append_begin(self, program: Program, tolerances: tuple[float, float]) -> None:
        """The state at the start; the whole step is tried first."""

        def begin(x: Scalars) -> dict[str, Any]:
            return {"state": x, "left": [1.0], "share": [1.0], "tries": [0.0], "tolerances": tolerances}

        program.call(trace(f"{self.prefix}_begin", {"x": self.field.n_x}, begin))

    def append_length(self, program: Program) -> None:
        """The share to try: no more than is left."""

        def length(h: Scalars, left: Scalars, share: Scalars) -> dict[str, Any]:
            # A little more than was chosen, if a sliver would be left otherwise.
            taken = casadi.if_else(left[0] <= STRETCH * share[0], left[0], share[0])
            return {"taken": [taken], "share_time": [taken * h[0]]}

        program.call(trace(f"{self.prefix}_length", {"h": 1, "left": 1, "share": 1}, length))

    def append_attempt(
        self, program: Program, x: str = "state", h: str = "share_time", state_tried: str = "state_tried"
    ) -> None:
        """The state that the stages lead to, and how its error compares with the tolerances."""
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
        """Take what was tried if its error is tolerable, and choose the next share.

        Args:
            program: Program to append to.
            names: For each buffer that moves on, the buffer that was tried.
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
            share = taken[0] * casadi.fmin(factor, LARGEST_FACTOR)
            going = casadi.logic_and(remaining > 0.0, share >= SMALLEST_SHARE)
            unfinished = casadi.logic_and(going, tries[0] < MOST_SHARES - 1.0)
            kept = {
                f"{old}_kept": [
                    casadi.if_else(accepted, b, a) for a, b in zip(others[old], others[new], strict=True)
                ]
                for old, new in names.items()
            }
            # A lane that is given up goes no further, however long others in its block take.
            following = casadi.if_else(unfinished, share, 0.0)
            scalars = {"left_kept": [remaining], "share_kept": [following], "tries_kept": [tries[0] + 1.0]}
            return {**kept, **scalars, "unfinished": [unfinished]}

        values = {name: sizes[name] for pair in names.items() for name in pair}
        scalars = dict.fromkeys(("error", "taken", "left", "tries"), 1)
        program.call(trace(f"{self.prefix}_choice", {**scalars, **values}, choose))
        # A graph may not write where it reads.
        carried = {name: sizes[name] for name in (*names, "left", "share", "tries")}

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
        """Graph of the tangent vectors of the solution inside a step."""
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
        """Derivative of the pose that was tried, by pose, y and u: dense, column by column."""
        field, stages = self.field, self.stages
        if field.pose is None:
            return
        n = len(field.pose.directions)
        buffer, pattern = stages.append_pose_change(program, h="share_time", numbers=stages.numbers)
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
        """A and B from the derivatives that were carried to the end; NaN if it was not reached."""
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
    """The values, or NaN while something is left of the step."""
    return [casadi.if_else(left > 0.0, math.nan, value) for value in values]
