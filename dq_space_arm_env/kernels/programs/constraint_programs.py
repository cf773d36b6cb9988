"""Programs of the constraints of a scene: residuals, and their first derivatives in tangent coordinates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.integrators.method import graph_inputs, program_inputs
from dq_space_arm_env.task.constraint_residuals import path_residuals
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.terminal_residuals import terminal_residuals

Scalar = Any
Scalars = Sequence[Scalar]
Matrix = Any


def constraint_residuals(
    equations: SceneEquations,
    x: Scalars,
    u: Scalars | None,
    of_path: Callable[..., list[Scalar]] = path_residuals,
) -> tuple[list[Scalar], Matrix, Matrix]:
    """Residuals as functions of tangent state and input around x and u, those symbols, and their values.

    Args:
        equations: The scene's.
        x: State, n_x scalars.
        u: Input, n_u scalars; None for the rows at the end, of a tangent state alone.
        of_path: Which of the path's rows.

    Returns:
        The residuals, the column of symbols, and the column of their values.
    """
    field = equations.field
    z = symbols("z", field.n_t)
    moved = equations.moved(x, z)
    if u is None:
        values = casadi.DM.zeros(field.n_t)
        return terminal_residuals(equations, *moved), column(*z), values
    w = symbols("w", field.n_u)
    values = casadi.densify(column(*[0.0] * field.n_t, *u))
    return of_path(equations, *moved, w), column(*z, *w), values


class ConstraintPrograms:
    """Builds the programs of one scene, of the path's rows and of those at the end."""

    def __init__(self, equations: SceneEquations) -> None:
        self.equations, self.field = equations, equations.field
        self.builders: Mapping[str, Callable[[], Program]] = {
            "constraints": partial(self._program, "constraints"),
            "constraint_jacobian": partial(self._program, "constraint_jacobian", is_jacobian=True),
            "terminal_constraints": partial(self._program, "terminal_constraints", at_end=True),
            "terminal_constraint_jacobian": partial(
                self._program, "terminal_constraint_jacobian", at_end=True, is_jacobian=True
            ),
        }

    def _program(self, name: str, *, at_end: bool = False, is_jacobian: bool = False) -> Program:
        field = self.field
        x, u = symbols("x", field.n_x), symbols("u", field.n_u)
        given = {"x": x} if at_end else {"x": x, "u": u}
        residuals, moved, values = constraint_residuals(self.equations, x, None if at_end else u)
        found: Matrix = casadi.densify(column(*residuals))
        if is_jacobian:
            found = casadi.densify(casadi.jacobian(found, moved)).T  # CasADi's order is by column
        found = casadi.substitute(found, moved, values)
        entries = casadi.densify(found).nonzeros()
        buffers = [Buffer(key, len(scalars)) for key, scalars in given.items()]
        program = Program(name, program_inputs(field, *buffers), [Buffer("rows", len(entries))])
        program.call(graph_of(f"{name}_graph", graph_inputs(field, **given), {"rows": entries}))
        return program
