"""A step after which the velocities may jump, with exact derivatives of both, second ones included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Call, Program
from dq_space_arm_env.dynamics.vector_field import TwiceDifferentiableField, VectorField, split_state
from dq_space_arm_env.integrators.method import Integrator, TwiceDifferentiableIntegrator, graph_inputs

Scalar = Any


@dataclass(frozen=True)
class StepAndJump:
    """A method's step, then a jump of y, the state without the pose."""

    method: Integrator
    jump: Callable[[Sequence[Scalar]], Sequence[Scalar]]  # from the state after the step to that after both
    before: str = "before"  # in names of what is before the jump: each jump after a step has its own

    @property
    def _x(self) -> str:
        return f"x_{self.before}"

    def _prefix(self, field: VectorField) -> str:
        return f"{field.name}_{self.before}_jump"

    def append_step(self, program: Program, field: VectorField) -> None:
        """See `Integrator.append_step`."""
        begin = len(program.calls)
        self.method.append_step(program, field)
        rename(program, begin, {"x_next": self._x})
        x = symbols("x", field.n_x)
        inputs = graph_inputs(field, **{self._x: x})
        program.call(graph_of(self._prefix(field), inputs, {"x_next": self.jump(x)}))

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """See `Integrator.append_linearization`."""
        patterns = self._append_linearization_before(program, field)
        x = symbols("x", field.n_x)
        y, after = split_state(field, x)[1], split_state(field, self.jump(x))[1]
        by_y = casadi.jacobian(column(*after), column(*y))
        pose = patterns["A"].size1() - field.n_y
        jump = casadi.diagcat(casadi.SX.eye(pose), by_y)
        given, outputs, sparsity = {self._x: x}, {}, []
        for name, pattern in patterns.items():
            matrix = casadi.SX.sym(name, pattern)
            product = casadi.sparsify(casadi.mtimes(jump, matrix))
            given[f"{name}_{self.before}"] = matrix.nonzeros()
            outputs[name] = product.nonzeros()
            sparsity.append(product.sparsity())
        program.call(graph_of(f"{self._prefix(field)}_derivatives", graph_inputs(field, **given), outputs))
        return sparsity[0], sparsity[1]

    def append_curvature(self, program: Program, field: TwiceDifferentiableField) -> Any:
        """See `TwiceDifferentiableIntegrator.append_curvature`; the method must have second derivatives.

        With multipliers m of the jump j(f(z)): m . (j o f)'' = (j' m) . f'' + f'' (m . j'') f'.
        """
        assert isinstance(self.method, TwiceDifferentiableIntegrator)
        patterns = self._append_linearization_before(program, field)
        n_t = patterns["A"].size1()
        x, multiplier, pose = symbols("x", field.n_x), symbols("multiplier", n_t), n_t - field.n_y
        y, after = split_state(field, x)[1], split_state(field, self.jump(x))[1]
        weighted = casadi.dot(column(*multiplier[pose:]), column(*after))
        twice, slope = casadi.hessian(weighted, column(*y))
        outputs = {
            f"multiplier_{self.before}": [*multiplier[:pose], *casadi.densify(slope).nonzeros()],
            f"bend_{self.before}": casadi.triu(twice).nonzeros(),
        }
        given = graph_inputs(field, **{self._x: x}, multiplier=multiplier)
        program.call(graph_of(f"{self._prefix(field)}_curvature", given, outputs))
        begin = len(program.calls)
        before = self.method.append_curvature(program, field)
        rename(
            program,
            begin,
            {"multiplier": f"multiplier_{self.before}", "curvature": f"curvature_{self.before}"},
        )
        bend = casadi.SX.sym("bend", casadi.triu(twice).sparsity())
        curvature, a, b = (
            casadi.SX.sym(name, pattern)
            for name, pattern in (("C", before), ("A", patterns["A"]), ("B", patterns["B"]))
        )
        change = casadi.horzcat(a, b)[pose:, :]
        moved = casadi.mtimes(change.T, casadi.mtimes(casadi.triu2symm(bend), change))
        total = casadi.sparsify(curvature + casadi.triu(moved))
        matrices = {"curvature": curvature, "bend": bend, "A": a, "B": b}
        inputs = {f"{name}_{self.before}": matrix.nonzeros() for name, matrix in matrices.items()}
        program.call(graph_of(f"{self._prefix(field)}_sum", inputs, {"curvature": total.nonzeros()}))
        return total.sparsity()

    def _append_linearization_before(self, program: Program, field: VectorField) -> dict[str, Any]:
        """Append the method's step and linearization, with results of other names; their patterns."""
        begin = len(program.calls)
        self.method.append_step(program, field)
        rename(program, begin, {"x_next": self._x})
        begin = len(program.calls)
        patterns = dict(zip("AB", self.method.append_linearization(program, field), strict=True))
        rename(program, begin, {name: f"{name}_{self.before}" for name in "AB"})
        return patterns


def rename(program: Program, begin: int, names: dict[str, str]) -> None:
    """Bind buffers to other names in the calls from some number on."""
    for number in range(begin, len(program.calls)):
        graph, bindings = program.calls[number].graph, program.calls[number].bindings
        found = {name: bindings.get(name, name) for name, _ in (*graph.inputs, *graph.outputs)}
        changed = {name: names[buffer] for name, buffer in found.items() if buffer in names}
        if changed:
            program.calls[number] = Call(graph, {**bindings, **changed})
    conditions = [loop.condition for loop in program.loops] + [guard.condition for guard in program.guards]
    assert not names.keys() & set(conditions)  # which keep their names
