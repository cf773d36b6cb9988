"""A step after which the velocities may jump, with exact derivatives of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Call, Program
from dq_space_arm_env.dynamics.vector_field import VectorField, split_state
from dq_space_arm_env.integrators.method import Integrator, graph_inputs

Scalar = Any


@dataclass(frozen=True)
class StepAndJump:
    """A method's step, then a jump of y, the state without the pose."""

    method: Integrator
    jump: Callable[[Sequence[Scalar]], Sequence[Scalar]]  # from the state after the step to that after both

    def append_step(self, program: Program, field: VectorField) -> None:
        """See `Integrator.append_step`."""
        begin = len(program.calls)
        self.method.append_step(program, field)
        _rename(program, begin, {"x_next": _BEFORE})
        x = symbols("x", field.n_x)
        graph = graph_of(f"{field.name}_jump", graph_inputs(field, **{_BEFORE: x}), {"x_next": self.jump(x)})
        program.call(graph)

    def append_linearization(self, program: Program, field: VectorField) -> tuple[Any, Any]:
        """See `Integrator.append_linearization`."""
        begin = len(program.calls)
        self.method.append_step(program, field)
        _rename(program, begin, {"x_next": _BEFORE})
        begin = len(program.calls)
        patterns = dict(zip("AB", self.method.append_linearization(program, field), strict=True))
        _rename(program, begin, {"A": "A_before", "B": "B_before"})
        x = symbols("x", field.n_x)
        y, after = split_state(field, x)[1], split_state(field, self.jump(x))[1]
        by_y = casadi.jacobian(column(*after), column(*y))
        pose = patterns["A"].size1() - field.n_y
        jump = casadi.diagcat(casadi.SX.eye(pose), by_y)
        given, outputs, sparsity = {_BEFORE: x}, {}, []
        for name, pattern in patterns.items():
            matrix = casadi.SX.sym(name, pattern)
            product = casadi.sparsify(casadi.mtimes(jump, matrix))
            given[f"{name}_before"] = matrix.nonzeros()
            outputs[name] = product.nonzeros()
            sparsity.append(product.sparsity())
        program.call(graph_of(f"{field.name}_jump_derivatives", graph_inputs(field, **given), outputs))
        return sparsity[0], sparsity[1]


_BEFORE = "x_before"


def _rename(program: Program, begin: int, names: dict[str, str]) -> None:
    """Bind buffers to other names in the calls from some number on."""
    for number in range(begin, len(program.calls)):
        graph, bindings = program.calls[number].graph, program.calls[number].bindings
        found = {name: bindings.get(name, name) for name, _ in (*graph.inputs, *graph.outputs)}
        changed = {name: names[buffer] for name, buffer in found.items() if buffer in names}
        if changed:
            program.calls[number] = Call(graph, {**bindings, **changed})
