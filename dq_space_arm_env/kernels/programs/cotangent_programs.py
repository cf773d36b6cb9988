"""Programs of vector-Jacobian products: of a step, the cost and the observation, in tangent coordinates.

The rows that multiply from the left, and the results, are cotangents: what a number changes by per unit of
each tangent coordinate, or of each input. A step whose method repeats calls is differentiated in forward
mode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.cotangent import append_cotangents
from dq_space_arm_env.compiler.graph import graph_of, trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.compiler.reverse_mode import COTANGENT
from dq_space_arm_env.integrators.method import program_inputs
from dq_space_arm_env.integrators.tangent_linearization import retraction, tangent_changes
from dq_space_arm_env.kernels.programs.stage_programs import stage_method
from dq_space_arm_env.task.episode import seen
from dq_space_arm_env.task.equations import SceneEquations, total

Scalar = Any
Scalars = Sequence[Scalar]


class CotangentPrograms:
    """Builds the programs of one scene; `program` makes one of a function of named inputs."""

    def __init__(self, equations: SceneEquations, program: Callable[..., Program]) -> None:
        self.equations, self.field, self._program = equations, equations.field, program

    def of_cost(self, cost: Program) -> Program:
        """Products with the cost's derivative, from the program of a cost."""
        by = tuple(buffer.name for buffer in cost.inputs if buffer.name in ("x", "u"))
        program = replace(cost, name=f"{cost.name}_vjp", inputs=[*cost.inputs, Buffer("v", 1)])
        append_cotangents(program, {"cost": "v"}, by)
        return self._in_tangent_coordinates(program, by)

    def observation(self) -> Program:
        """Products with the observation's derivative; the time left is a number of its own."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            return {"observation": seen(self.equations, x, 0.0)["observation"]}

        program = self._program("observation_vjp", outputs, x=self.field.n_x)
        program.inputs = [*program.inputs, replace(program.outputs[0], name="v")]
        append_cotangents(program, {"observation": "v"}, ("x",))
        return self._in_tangent_coordinates(program, ("x",))

    def step(self, integrator: str, *, with_cost: bool) -> Program:
        """A step, or a step and its cost: from v, n_t, and v_cost."""
        field = self.field
        given = [Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("v", field.n_t)]
        given += [Buffer("v_cost", 1)] if with_cost else []
        given += [Buffer("h", 1, shared=True)]
        name = "step_with_cost_vjp" if with_cost else "vjp"
        program = Program(name, program_inputs(field, *given), [])
        method = stage_method(self.equations, integrator)
        method.append_step(program, field)
        reverse, of = program, {"x_next": "landing"}
        if program.loops:
            program.calls, program.loops, program.held = [], [], set()
            self._append_product(program, *method.append_linearization(program, field))
            reverse, of = Program(name, program.inputs, []), {}
        else:
            self._append_landing(program)
        if with_cost:
            sizes = {"x": field.n_x, "u": field.n_u}
            reverse.call(trace("cost_graph", sizes, self._cost, parameters=field.parameters))
            of["cost"] = "v_cost"
        append_cotangents(reverse, of, ("x", "u"))
        if reverse is not program:
            program.calls = [*program.calls, *reverse.calls]
        return self._in_tangent_coordinates(program, ("x", "u"))

    def _cost(self, x: Scalars, u: Scalars) -> Mapping[str, Scalars]:
        return {"cost": [total(self.equations.cost_terms(x, u))]}

    def _append_landing(self, program: Program) -> None:
        """Append the call from v to the cotangent of the numbers of the next state."""
        field = self.field
        x, change, v = symbols("x", field.n_x), symbols("change", field.n_x), symbols("v", field.n_t)
        moved = column(*tangent_changes(field, x, change))
        cotangent = casadi.gradient(casadi.dot(column(*v), moved), column(*change))
        outputs = {"landing": casadi.densify(cotangent).nonzeros()}
        program.call(graph_of(f"{field.name}_landing", {"x_next": x, "v": v}, outputs))

    def _append_product(self, program: Program, a: Any, b: Any) -> None:
        """Append the call that multiplies v with A and B, given their patterns."""
        v = column(*symbols("v", self.field.n_t))
        by_x, by_u = casadi.SX.sym("A", a), casadi.SX.sym("B", b)
        products = {
            "x_product": casadi.densify(casadi.mtimes(by_x.T, v)).nonzeros(),
            "u_product": casadi.densify(casadi.mtimes(by_u.T, v)).nonzeros(),
        }
        inputs = {"A": by_x.nonzeros(), "B": by_u.nonzeros(), "v": v.nonzeros()}
        program.call(graph_of(f"{self.field.name}_product", inputs, products))

    def _in_tangent_coordinates(self, program: Program, by: tuple[str, ...]) -> Program:
        """Append the call that gives the cotangents of state and input, the former in tangent coordinates."""
        field, products = self.field, {name: f"{name}_product" for name in by}
        products = {k: v for k, v in products.items() if v in program.scratch_sizes()}
        sizes = {"x": field.n_x, f"x{COTANGENT}": field.n_x, f"u{COTANGENT}": field.n_u}
        sizes |= {"x_product": field.n_t, "u_product": field.n_u}
        names = [*(("x",) if field.n_x > field.n_y else ()), *(f"{name}{COTANGENT}" for name in by)]
        names += products.values()

        def outputs(**given: Scalars) -> Mapping[str, Scalars]:
            found = {f"{name}_cotangent": list(given[f"{name}{COTANGENT}"]) for name in by}
            if field.pose is not None:
                stored = field.n_x - field.n_y
                by_pose = retraction(field.pose, given["x"])
                cotangent = column(*found["x_cotangent"][:stored])
                turned = casadi.densify(casadi.mtimes(by_pose.T, cotangent)).nonzeros()
                found["x_cotangent"][:stored] = turned
            for name, product in products.items():
                key = f"{name}_cotangent"
                found[key] = [a + b for a, b in zip(found[key], given[product], strict=True)]
            return found

        given = {name: sizes[name] for name in names}
        graph = trace(f"{program.name}_in_tangent_coordinates", given, outputs)
        program.call(graph)
        program.outputs = [Buffer(name, size) for name, size in graph.outputs]
        return program
