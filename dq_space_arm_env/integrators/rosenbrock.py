"""Rosenbrock methods: implicit stability for joints of any stiffness, without iterations.

Each stage solves a linear system with the exact Jacobian J of the equations of motion, and all stages share
its factors (Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7). Both methods are L-stable: a
vibration that the step cannot resolve dies within a few steps, and the arm moves on as if locked at its
springs. The order then drops to about 3, as for all methods of this kind.

Two limits. While an unresolved vibration dies, the momentum changes: by a thousandth at once for joints of
0.4 rad/s. And the torque of spring and damper at the start of a step must not be so large that it alone would
turn the arm by a radian within gamma h, as when a damper of 1e6 N m s/rad meets a moving joint beside soft
ones: J is then no guide to the motion within the step. There rodas4 is the safer method; rodas5p is the more
accurate one for vibrations that the step resolves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, columns, dense_entries, symbols, zeros
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField
from dq_space_arm_env.integrators.method import graph_inputs
from dq_space_arm_env.integrators.rosenbrock_system import RosenbrockSystem
from dq_space_arm_env.integrators.rosenbrock_tableaus import RosenbrockTableau
from dq_space_arm_env.integrators.step_field import StepField

Scalar = Any
Matrix = Any


class Rosenbrock:
    """A Rosenbrock method, given by its tableau."""

    def __init__(self, tableau: RosenbrockTableau) -> None:
        self.tableau = tableau

    def append_step(self, program: Program, field: VectorField) -> None:
        steps = _Graphs(self, StepField(field))
        program.call(steps.first(), stage="stage0")
        stage = steps.stage()
        for number in range(1, self.tableau.stages):
            program.call(steps.sums(number))
            program.call(stage, offset=f"offset{number}", carried=f"carried{number}", stage=f"stage{number}")
        program.call(steps.total())

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """See `Integrator`.

        The derivative D_i of u_i by (y, u) solves a system with the same factors, (1 - gamma h J) D_i = gamma
        h (F_i Z_i + G_i + (J u_i)') + gamma sum c_ij D_j: F_i and G_i are the Jacobians at the stage, Z_i the
        derivative of its start, and (J u_i)' that of J u_i at fixed u_i.
        """
        steps = _LinearizedGraphs(self, StepField(field))
        program.call(steps.at_start())
        program.call(steps.coefficients())
        graphs = (steps.stage(), steps.along(), steps.change())
        accumulated, (total, a_pattern, b_pattern) = steps.accumulated(), steps.total_change()
        own = ("offset", "carried", "offset_change", "carried_change", "stage", "change")
        for number in range(self.tableau.stages):
            # The sums' initial values and the inputs of the first stage are unwritten scratch: zero.
            if number:
                program.call(steps.sums(number))
            for earlier in range(number):
                before = f"{number}_{earlier}" if earlier else "_none"
                after = f"{number}_{earlier + 1}" if earlier + 1 < number else f"{number}"
                program.call(
                    accumulated,
                    weights=f"weights{number}_{earlier}",
                    change=f"change{earlier}",
                    offset=f"offset_change{before}",
                    carried=f"carried_change{before}",
                    new_offset=f"offset_change{after}",
                    new_carried=f"carried_change{after}",
                )
            for graph in graphs:
                program.call(graph, **{name: f"{name}{number}" for name in own})
        program.call(total, **{name: f"{name}{self.tableau.stages - 1}" for name in own})
        return a_pattern, b_pattern


class _Graphs:
    """Graphs of a step: first stage, sums before a stage, stage, and new state."""

    def __init__(self, method: Rosenbrock, step: StepField) -> None:
        self.step, self.field, self.tableau = step, step.field, method.tableau
        self.prefix = f"{step.field.name}_rosenbrock{self.tableau.order}"
        self.x, self.u = symbols("x", self.field.n_x), symbols("u", self.field.n_u)
        self.h = casadi.SX.sym("h")
        self.start = step.start(self.x)
        self.rates, self.by_z, self.by_u = step.linearized_rates(self.start, self.u)
        self.system = RosenbrockSystem(self.tableau.gamma * self.h, self.by_z, self.field.n_y)

    def _graph(self, name: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> Any:
        given = graph_inputs(self.field, x=self.x, u=self.u, h=[self.h], **inputs)
        return graph_of(f"{self.prefix}_{name}", given, outputs)

    def first(self) -> Any:
        """Graph of the factors and the first stage."""
        scale = self.tableau.gamma * self.h
        stage = self.system.solve([scale * rate for rate in self.rates])  # (1 - gamma h J) u_1 = gamma h f(y)
        return self._graph("first", {}, {"factor": self.system.variables, "stage": stage})

    def stage(self) -> Any:
        """Graph of any other stage."""
        known = self.system.renamed()
        offset, carried = symbols("offset", self.step.n_z), symbols("carried", self.step.n_z)
        z = [old + new for old, new in zip(self.start, offset, strict=True)]
        rates, scale = self.step.rates(z, self.u), self.tableau.gamma * self.h
        # (1 - gamma h J) u_i = gamma h f(y + sum a_ij u_j) + gamma sum c_ij u_j.
        stage = known.solve([scale * rate + other for rate, other in zip(rates, carried, strict=True)])
        inputs = {"factor": known.variables, "offset": offset, "carried": carried}
        return self._graph("stage", inputs, {"stage": stage})

    def sums(self, number: int) -> Any:
        """Graph of a stage's sums over the earlier ones: sum a_ij u_j, and gamma sum c_ij u_j."""
        starts, gamma = self.tableau.starts, self.tableau.gamma
        stages = [symbols(f"u{i}", self.step.n_z) for i in range(number)]
        inputs = {f"stage{i}": stage for i, stage in enumerate(stages)}
        if number > 1 and starts[number] == (*starts[number - 1], 1.0):
            before = symbols("before", self.step.n_z)
            inputs[f"offset{number - 1}"] = before
            offset = [a + b for a, b in zip(before, stages[-1], strict=True)]
        else:
            offset = _combined(starts[number], stages)
        carried = _combined([gamma * c for c in self.tableau.couplings[number]], stages)
        outputs = {f"offset{number}": offset, f"carried{number}": carried}
        return graph_of(f"{self.prefix}_sums{number}", inputs, outputs)

    def total(self) -> Any:
        """Graph of the new state."""
        last = self.tableau.stages - 1
        offset, stage = symbols("offset", self.step.n_z), symbols("stage", self.step.n_z)
        change = [a + b for a, b in zip(offset, stage, strict=True)]
        inputs = {"x": self.x, f"offset{last}": offset, f"stage{last}": stage}
        return graph_of(f"{self.prefix}_total", inputs, {"x_next": self.step.moved(self.x, change)})


class _LinearizedGraphs(_Graphs):
    """Graphs of a step with the derivatives of its stages by (y, u)."""

    def __init__(self, method: Rosenbrock, step: StepField) -> None:
        super().__init__(method, step)
        field = self.field
        self.identity = casadi.SX(step.n_z, field.n_y + field.n_u)
        self.identity[: field.n_y, : field.n_y] = casadi.SX.eye(field.n_y)
        self.along_pattern, self.pattern = self._patterns()

    def _patterns(self) -> tuple[Any, Any]:
        """Sparsity of the derivative of J u, and one that contains the derivative of any stage."""
        n_z, n_y = self.step.n_z, self.field.n_y
        _, by_z, by_u = self.step.linearized_rates(symbols("z", n_z), self.u)
        along = self.step.jacobian_along(
            self.start, self.u, self.rates, self.by_z, self.by_u, symbols("v", n_z)
        )
        reach = casadi.DM.eye(n_z)
        for _ in range(n_z):
            reach = _ones(reach + casadi.mtimes(_ones(by_z), reach))
        direct = casadi.horzcat(_ones(by_z[:, :n_y]), _ones(by_u)) + _ones(along)
        return along.sparsity(), casadi.mtimes(reach, _ones(direct)).sparsity()

    def at_start(self) -> Any:
        """Graph of the factors, rates and Jacobians at the start of the step."""
        outputs = {"factor": self.system.variables, "rates": self.rates}
        outputs |= {"by_z": self.by_z.nonzeros(), "by_u": self.by_u.nonzeros()}
        return self._graph("start", {}, outputs)

    def along(self) -> Any:
        """Graph of the derivative of J u_i at fixed u_i."""
        stage, rates = symbols("stage", self.step.n_z), symbols("rates", self.step.n_z)
        by_z = casadi.SX.sym("by_z", self.by_z.sparsity())
        by_u = casadi.SX.sym("by_u", self.by_u.sparsity())
        along = self.step.jacobian_along(self.start, self.u, rates, by_z, by_u, stage)
        inputs = {"stage": stage, "rates": rates, "by_z": by_z.nonzeros(), "by_u": by_u.nonzeros()}
        return self._graph("along", inputs, {"along": casadi.project(along, self.along_pattern).nonzeros()})

    def change(self) -> Any:
        """Graph of the derivative of a stage."""
        n_z, n_y, scale = self.step.n_z, self.field.n_y, self.tableau.gamma * self.h
        known = self.system.renamed()
        offset, along = symbols("offset", n_z), casadi.SX.sym("along", self.along_pattern)
        changes = [casadi.SX.sym(name, self.pattern) for name in ("offset_change", "carried_change")]
        z = [old + new for old, new in zip(self.start, offset, strict=True)]
        _, by_z, by_u = self.step.linearized_rates(z, self.u)
        moved = casadi.mtimes(by_z, self.identity + changes[0]) + along
        right = scale * (moved + casadi.horzcat(zeros(n_z, n_y), by_u)) + changes[1]
        solved = [column(*known.solve(dense_entries(right[:, i]))) for i in range(right.shape[1])]
        change = casadi.project(columns(*solved, rows=n_z), self.pattern)
        inputs = {"factor": known.variables, "offset": offset, "along": along.nonzeros()}
        inputs |= {"offset_change": changes[0].nonzeros(), "carried_change": changes[1].nonzeros()}
        return self._graph("change", inputs, {"change": change.nonzeros()})

    def coefficients(self) -> Any:
        """Graph of the constants of `accumulated`: a_ij and gamma c_ij for stages i and j < i."""
        rows = zip(self.tableau.starts, self.tableau.couplings, strict=True)
        gamma = self.tableau.gamma
        outputs = {
            f"weights{i}_{j}": [a, gamma * c]
            for i, row in enumerate(rows)
            for j, (a, c) in enumerate(zip(*row, strict=True))
        }
        return graph_of(f"{self.prefix}_coefficients", {}, outputs)

    def accumulated(self) -> Any:
        """Graph that adds a stage's contribution to the derivatives of the sums of a later one."""
        names = ("offset", "carried", "change")
        offset, carried, change = (casadi.SX.sym(name, self.pattern) for name in names)
        weights = symbols("weight", 2)
        outputs = {"new_offset": offset + weights[0] * change, "new_carried": carried + weights[1] * change}
        return graph_of(
            f"{self.prefix}_accumulated",
            {
                "weights": weights,
                "offset": offset.nonzeros(),
                "carried": carried.nonzeros(),
                "change": change.nonzeros(),
            },
            {name: value.nonzeros() for name, value in outputs.items()},
        )

    def total_change(self) -> tuple[Any, Any, Any]:
        """Graph of A and B, and their patterns."""
        offset, stage = symbols("offset", self.step.n_z), symbols("stage", self.step.n_z)
        changes = [casadi.SX.sym(name, self.pattern) for name in ("offset_change", "change")]
        total = [a + b for a, b in zip(offset, stage, strict=True)]
        a, b = self.step.moved_by(total, self.identity + changes[0] + changes[1])
        inputs = {"offset": offset, "offset_change": changes[0].nonzeros()}
        inputs |= {"stage": stage, "change": changes[1].nonzeros()}
        graph = graph_of(f"{self.prefix}_total_change", inputs, {"A": a.nonzeros(), "B": b.nonzeros()})
        return graph, a.sparsity(), b.sparsity()


def _combined(weights: Sequence[float], vectors: Sequence[Sequence[Scalar]]) -> list[Scalar]:
    """Weighted sum of vectors."""
    total = [weights[0] * entry for entry in vectors[0]]
    for weight, vector in zip(weights[1:], vectors[1:], strict=True):
        total = [old + weight * entry for old, entry in zip(total, vector, strict=True)]
    return total


def _ones(pattern: Matrix) -> Any:
    """Ones where a matrix has entries."""
    return casadi.DM(pattern.sparsity(), 1.0)
