"""Programs of exact derivatives by the parameters: of a step, and of the cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, dense_entries, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.compiler.tangent import append_for_each, append_matrix, append_tangents
from dq_space_arm_env.integrators.method import graph_inputs, program_inputs
from dq_space_arm_env.integrators.tangent_linearization import tangent_graph
from dq_space_arm_env.kernels.programs.stage_programs import stage_method
from dq_space_arm_env.task.equations import SceneEquations, total

Scalar = Any


class ParameterPrograms:
    """Builds the programs of one scene."""

    def __init__(self, equations: SceneEquations) -> None:
        """Keep the equations; ValueError if they have no parameters."""
        self.equations, self.field = equations, equations.field
        self.parameters = list(equations.field.parameters)
        if not self.parameters:
            raise ValueError(
                f"scene {equations.scene.name!r} has no parameters to differentiate by: name some under "
                "`parameters`, for example links.0.mass"
            )

    def linearize(self, integrator: str) -> Program:
        """P, the derivative of the next state in tangent coordinates, n_t by n_p."""
        field, n_p = self.field, len(self.parameters)
        inputs = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)]
        program = Program("linearize_parameters", program_inputs(field, *inputs), [])
        stage_method(self.equations, integrator).append_step(program, field)
        changes = append_tangents(program, ["parameters"], "x_next")
        if changes is not None:
            changes = append_for_each(program, tangent_graph(field), "change", changes, "dx_next")
        append_matrix(program, changes, (field.n_t, n_p), "P")
        program.outputs = [Buffer("P", field.n_t * n_p)]
        return program

    def cost(self) -> Program:
        """lp, the gradient of the stage cost."""
        x, u = symbols("x", self.field.n_x), symbols("u", self.field.n_u)
        value = total(self.equations.cost_terms(x, u))
        return self._gradient("cost_by_parameters", value, x=x, u=u)

    def terminal_cost(self) -> Program:
        """lp, the gradient of the terminal cost."""
        x = symbols("x", self.field.n_x)
        value = total(self.equations.terminal_cost_terms(x))
        return self._gradient("terminal_cost_by_parameters", value, x=x)

    def _gradient(self, name: str, value: Scalar, **inputs: Sequence[Scalar]) -> Program:
        """Program of the gradient of a number: in reverse mode, a single number costs least."""
        gradient = casadi.gradient(casadi.SX(value), column(*self.parameters))
        outputs = {"lp": dense_entries(gradient)}
        graph = graph_of(f"{name}_graph", graph_inputs(self.field, **inputs), outputs)
        buffers = program_inputs(self.field, *(Buffer(key, len(symbols)) for key, symbols in inputs.items()))
        program = Program(name, buffers, [Buffer("lp", len(self.parameters))])
        program.call(graph)
        return program
