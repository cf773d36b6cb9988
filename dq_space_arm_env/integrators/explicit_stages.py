"""The stages of explicit Runge-Kutta methods, with or without derivatives, as calls.

The rates are compiled once and called for every stage, on vectors that stay in the cache; the start of each
stage is a separate graph, with the tableau's zeros left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import symbols, zeros
from dq_space_arm_env.compiler.graph import Graph, graph_of, trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.munthe_kaas import combined, increment_jacobians
from dq_space_arm_env.integrators.pose_update import pose_blocks
from dq_space_arm_env.integrators.tableaus import ButcherTableau

Scalar = Any
Matrix = Any


class ExplicitStages:
    """Stages of an explicit method on given equations of motion.

    Buffers count from 1: stage i starts at `y{i}` and has the rates `k{i}`; with derivatives, `Y{i}` and
    `K{i}` are those of the two by (y, u) at the start of the step.
    """

    def __init__(self, field: VectorField, tableau: ButcherTableau) -> None:
        self.field, self.tableau = field, tableau
        self.prefix = f"{field.name}_rk{tableau.order}"
        self.numbers = range(1, len(tableau.stages) + 1)

    # The stages themselves.

    def append(self, program: Program) -> None:
        """Append the calls that turn x, u, h into every y{i} and k{i}."""
        self.append_first(program)
        self.append_later(program)

    def append_first(self, program: Program) -> None:
        """Append the calls that turn x, u into y1 and k1."""
        self._append_start(program)
        program.call(self._rates, y="y1", rates="k1")

    def append_later(self, program: Program, *, h: str = "h") -> None:
        """Append the calls that turn y1, k1, u and a time step into y{i} and k{i} of the other stages."""
        for number in self.numbers[1:]:
            program.call(self._start(number), h=h, y=f"y{number}")
            program.call(self._rates, y=f"y{number}", rates=f"k{number}")

    def _append_start(self, program: Program) -> None:
        field = self.field
        sizes = {"x": field.n_x}
        program.call(
            trace(f"{self.prefix}_start_1", sizes, lambda x: {"y": split_state(field, x)[1]}), y="y1"
        )

    def _start(self, number: int) -> Graph:
        """Graph of a stage's start, from y1, h and the rates of the stages it uses."""
        field, row = self.field, self.tableau.stages[number - 1]

        def start(y1: list[Scalar], h: list[Scalar], **k: list[Scalar]) -> dict[str, Any]:
            return {"y": self.moved(y1, [weight for weight in row if weight], list(k.values()), h[0])}

        used = self.tableau.used[number - 1]
        sizes = {"y1": field.n_y, "h": 1, **{f"k{j + 1}": field.n_y for j in used}}
        return trace(f"{self.prefix}_start_{number}", sizes, start)

    @cached_property
    def _rates(self) -> Graph:
        field = self.field
        return trace(
            f"{self.prefix}_rates",
            {"y": field.n_y, "u": field.n_u},
            lambda y, u: {"rates": field.rates(y, u)},
            parameters=field.parameters,
        )

    def moved(
        self, y: Sequence[Scalar], weights: Sequence[float], rates: Sequence[Sequence[Scalar]], h: Scalar
    ) -> list[Scalar]:
        """Y + h sum_i weights[i] rates[i]."""
        if not any(weights):
            return list(y)
        return [entry + change for entry, change in zip(y, combined(weights, rates, h), strict=True)]

    def twists(self, starts: Sequence[Sequence[Scalar]]) -> list[list[Scalar]]:
        """Free entries of the base twist at each stage's start."""
        assert self.field.pose is not None
        return [[y[i] for i in self.field.pose.twist_indices] for y in starts]

    # Their derivatives.

    @cached_property
    def rate_pattern(self) -> Any:
        """Sparsity of K{i}, (n_y, n_y + n_u)."""
        return stage_pattern(self.field)

    @cached_property
    def start_pattern(self) -> Any:
        """Sparsity of Y{i}, (n_y, n_y + n_u): that of K{i} and the identity."""
        n_y, n_u = self.field.n_y, self.field.n_u
        identity = casadi.horzcat(casadi.Sparsity.diag(n_y), casadi.Sparsity(n_y, n_u))
        return self.rate_pattern.unite(identity)

    @property
    def identity(self) -> Matrix:
        """Derivative of the start of a step by (y, u) there."""
        return casadi.horzcat(casadi.SX.eye(self.field.n_y), zeros(self.field.n_y, self.field.n_u))

    def append_linearized(self, program: Program) -> None:
        """Append the calls that turn x, u, h into every y{i}, k{i}, Y{i} and K{i}."""
        self.append_linearized_first(program)
        self.append_linearized_later(program)

    def append_linearized_first(self, program: Program) -> None:
        """Append the calls that turn x, u into y1, k1, Y1 and K1."""
        self._append_start(program)
        values = casadi.project(self.identity, self.start_pattern).nonzeros()
        program.call(graph_of(f"{self.prefix}_identity", {}, {"start_change": values}), start_change="Y1")
        self._append_linearized_rates(program, 1)

    def append_linearized_later(self, program: Program, *, h: str = "h", is_carried: bool = False) -> None:
        """Append the calls that turn y1, k1, Y1, K1, u and a time step into those of the other stages.

        Y1 is an input if `is_carried`, and the identity otherwise.
        """
        for number in self.numbers[1:]:
            program.call(self._start(number), h=h, y=f"y{number}")
            program.call(self._start_change(number, is_carried), h=h, start_change=f"Y{number}")
            self._append_linearized_rates(program, number)

    def _append_linearized_rates(self, program: Program, number: int) -> None:
        program.call(
            self._linearized_rates,
            y=f"y{number}",
            start_change=f"Y{number}",
            rates=f"k{number}",
            rate_change=f"K{number}",
        )

    def _start_change(self, number: int, is_carried: bool) -> Graph:
        """Graph of Y{i} from h, the K{j} it depends on, and Y1 unless that is the identity."""
        used, row = self.tableau.used[number - 1], self.tableau.stages[number - 1]
        h = casadi.SX.sym("h")
        change, symbols_of = self.change([(row[j], j + 1) for j in used], h, is_carried)
        return graph_of(
            f"{self.prefix}_start_change_{number}",
            {"h": [h], **symbols_of},
            {"start_change": casadi.project(change, self.start_pattern).nonzeros()},
        )

    def change(
        self, terms: Sequence[tuple[float, int]], h: Scalar, is_carried: bool
    ) -> tuple[Matrix, dict[str, Sequence[Scalar]]]:
        """Y1 + h sum_j weight_j K{j} of (weight, number) terms, and its symbols by buffer name."""
        inputs: dict[str, Sequence[Scalar]] = {}
        start = self.identity
        if is_carried:
            start = casadi.SX.sym("Y1", self.start_pattern)
            inputs["Y1"] = start.nonzeros()
        total = zeros(*start.shape)
        for weight, number in terms:
            rate_change = casadi.SX.sym(f"K{number}", self.rate_pattern)
            inputs[f"K{number}"] = rate_change.nonzeros()
            total = total + weight * rate_change
        return start + h * total, inputs

    @cached_property
    def _linearized_rates(self) -> Graph:
        """Graph of a stage's rates and of their derivative K = F Y + [0, G]."""
        field = self.field
        y, u = symbols("y", field.n_y), symbols("u", field.n_u)
        start_change = casadi.SX.sym("Y", self.start_pattern)
        rates, by_y, by_u = field.linearized_rates(y, u)
        direct = casadi.horzcat(zeros(field.n_y, field.n_y), by_u)
        rate_change = casadi.mtimes(by_y, start_change) + direct
        return graph_of(
            f"{self.prefix}_linearized_rates",
            graph_inputs(field, y=y, u=u, start_change=start_change.nonzeros()),
            {"rates": rates, "rate_change": casadi.project(rate_change, self.rate_pattern).nonzeros()},
        )

    # The pose's derivatives.

    def append_pose_change(
        self, program: Program, *, h: str = "h", numbers: Sequence[int]
    ) -> tuple[str, Any]:
        """Append the calls that turn y{i} and Y{i} of some stages into Omega (`increment`) and its change.

        Returns the buffer of its derivative by (y, u) and the pattern (n, n_y + n_u), n being the base's
        directions.
        """
        field = self.field
        assert field.pose is not None
        step = casadi.SX.sym("h")
        starts = [symbols(f"y{i}", field.n_y) for i in self.numbers]
        increment, jacobians = increment_jacobians(field.pose, self.tableau, self.twists(starts), step)
        slots = casadi.Sparsity(*jacobians[0].shape)
        for jacobian in jacobians:
            slots = slots.unite(jacobian.sparsity())
        outputs = {"increment": [increment[i] for i in field.pose.directions]}
        outputs |= {f"J{i}": casadi.project(jacobians[i - 1], slots).nonzeros() for i in numbers}
        inputs = {"h": [step], **{f"y{i}": y for i, y in zip(self.numbers, starts, strict=True)}}
        program.call(graph_of(f"{self.prefix}_pose_jacobians", inputs, outputs), h=h)

        start_change = casadi.SX.sym("Y", self.start_pattern)
        jacobian = casadi.SX.sym("J", slots)
        product = casadi.mtimes(jacobian, start_change[list(field.pose.twist_indices), :])
        before = casadi.SX.sym("before", product.sparsity())
        total = graph_of(
            f"{self.prefix}_pose_change",
            {
                "jacobian": jacobian.nonzeros(),
                "start_change": start_change.nonzeros(),
                "before": before.nonzeros(),
            },
            {"total": (before + product).nonzeros()},
        )
        previous = "pose_change_0"
        for i in numbers:
            program.call(
                total, jacobian=f"J{i}", start_change=f"Y{i}", before=previous, total=f"pose_change_{i}"
            )
            previous = f"pose_change_{i}"
        return previous, product.sparsity()

    def linearized_pose(self, pattern: Any) -> tuple[Matrix, Matrix, dict[str, Sequence[Scalar]]]:
        """Derivatives of the new pose by pose and (y, u), and their symbols `increment` and `pose_change`."""
        pose = self.field.pose
        assert pose is not None
        increment = symbols("increment", len(pose.directions))
        pose_change = casadi.SX.sym("pose_change", pattern)
        by_pose, by_increment = pose_blocks(pose, pose.full_twist(increment))
        moved = casadi.mtimes(by_increment, pose_change)
        return by_pose, moved, {"increment": increment, "pose_change": pose_change.nonzeros()}


def stage_pattern(field: VectorField) -> Any:
    """Sparsity that contains the derivative of any stage's rates with respect to (y, u)."""
    y = symbols("y", field.n_y)
    u = symbols("u", field.n_u)
    _, by_y, by_u = field.linearized_rates(y, u)
    direct = casadi.horzcat(by_y.sparsity(), by_u.sparsity())
    identity = casadi.horzcat(casadi.Sparsity.diag(field.n_y), casadi.Sparsity(field.n_y, field.n_u))
    pattern = direct
    while True:
        product = casadi.mtimes(casadi.DM(by_y.sparsity(), 1), casadi.DM(pattern.unite(identity), 1))
        grown = direct.unite(casadi.sparsify(product).sparsity())
        if grown == pattern:
            return pattern
        pattern = grown
