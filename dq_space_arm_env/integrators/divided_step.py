"""Time steps of an explicit method, divided where an embedded method says that they err by more than allowed.

Where the whole step is accurate it is the method's own step, to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.dynamics.vector_field import VectorField
from dq_space_arm_env.integrators.method import EmbeddedIntegrator
from dq_space_arm_env.integrators.substeps import Substeps, fifth_root, fourth_root, largest_error

Scalars = Sequence[Any]

MOST_SUBSTEPS = 10_000
"""A step that needs more of them than this, rejected ones included, is given up."""


@dataclass(frozen=True)
class DividedStep:
    """Steps of a method, in substeps of which none errs by more than a tolerance.

    The error of a substep is the largest, over angles [rad], position [m], and velocities times the length of
    the whole step, of its embedded estimate. A state that cannot be advanced within it becomes NaN.
    """

    method: EmbeddedIntegrator
    tolerance: float  # rad, m

    def append_step(self, program: Program, field: VectorField) -> None:
        """Append the calls that turn x, u, h into x_next and `checked_error`, in units of the tolerance."""
        inner = Program("embedded_step", [], [])
        self.method.append_embedded_step(inner, field)
        n_t = inner.scratch_sizes()["estimate"]
        sizes = {"estimate": n_t, "x_next": field.n_x, "h": 1}

        def measured(estimate: Scalars, x_next: Scalars, h: Scalars) -> dict[str, Scalars]:
            error = largest_error(field, estimate, x_next, h[0], self.tolerance)
            return {"error": [error], "refused": [casadi.logic_not(error <= 1.0)]}

        measure = trace(f"{field.name}_error", sizes, measured)
        program.append(inner)
        program.call(measure, error="checked_error")
        root = fourth_root if self.method.embedded_order < 4 else fifth_root
        substeps = Substeps(f"{field.name}_divided", root, MOST_SUBSTEPS)
        # From the start again: most blocks have no such lane, and the others of its block get the same step.
        with program.only_where("refused"):
            substeps.append_begin(program, state="x")
            with program.repeated_while("unfinished"):
                substeps.append_length(program)
                program.append(inner, x="state", h="substep_time", x_next="state_tried")
                program.call(measure, x_next="state_tried")
                substeps.append_choice(program, {"state": "state_tried"})
            substeps.append_end(program, state="x_next")
