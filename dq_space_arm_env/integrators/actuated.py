"""A step of the motion, and of what the actuators keep from step to step, with exact derivatives of both.

Previous controls follow no differential equation, x+ = u: they pass the method's stages by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.integrators import dormand_prince
from dq_space_arm_env.integrators.method import Integrator, TwiceDifferentiableIntegrator, program_inputs


@dataclass(frozen=True)
class ActuatedStep:
    """A method's step of the motion; actuators keep some controls of the step, by their indices."""

    method: Integrator
    controls: Sequence[int]

    def append_step(self, program: Program, field: SpaceArmField) -> None:
        """See `Integrator.append_step`."""
        _append_motion(program, field, self.method.append_step)
        n = field.of_motion.n_x
        given = {"motion_next": symbols("x", n), "u": symbols("u", field.n_u)}
        kept = [given["u"][i] for i in self.controls]
        program.call(graph_of(f"{field.name}_actuated", given, {"x_next": [*given["motion_next"], *kept]}))

    def append_linearization(self, program: Program, field: SpaceArmField) -> tuple[Any, Any]:
        """See `Integrator.append_linearization`."""
        a, b = _append_motion(program, field, self.method.append_linearization)
        count, moving = len(self.controls), a.size1()
        matrix, kept = casadi.SX.sym("B", b), casadi.SX(count, field.n_u)
        for row, control in enumerate(self.controls):
            kept[row, control] = 1.0
        whole = casadi.vertcat(matrix, kept)
        inputs, outputs = {"B_of_motion": matrix.nonzeros()}, {"B": whole.nonzeros()}
        program.call(graph_of(f"{field.name}_actuated_inputs", inputs, outputs))
        # What is kept moves nothing, and follows from the input alone: A only gets empty rows and columns.
        size = moving + count
        return _enlarged(a, range(moving), size), whole.sparsity()

    def append_curvature(self, program: Program, field: SpaceArmField) -> Any:
        """See `TwiceDifferentiableIntegrator.append_curvature`; what is kept has none."""
        assert isinstance(self.method, TwiceDifferentiableIntegrator)
        moving = field.of_motion.n_t
        multiplier = symbols("multiplier", field.n_t)
        outputs = {"multiplier_of_motion": multiplier[:moving]}
        program.call(graph_of(f"{field.name}_actuated_multiplier", {"multiplier": multiplier}, outputs))
        pattern = _append_motion(program, field, self.method.append_curvature)
        places = [*range(moving), *range(field.n_t, field.n_t + field.n_u)]
        return _enlarged(pattern, places, field.n_t + field.n_u)


def actuated(method: Any, field: SpaceArmField) -> Any:
    """Let the actuators' step go along with a method's, where they keep anything."""
    controls = field.layout.previous_controls
    return ActuatedStep(method, controls) if controls else method


def append_measured_step(program: Program, field: SpaceArmField) -> None:
    """Append a step with its error and dense output, in which what is kept changes evenly."""
    controls = field.layout.previous_controls
    if not controls:
        dormand_prince.append_measured_step(program, field)
        return
    _append_motion(program, field, dormand_prince.append_measured_step)
    n, x, u = field.of_motion.n_t, symbols("x", field.n_x), symbols("u", field.n_u)
    dense, landed = symbols("dense", 4 * n), symbols("motion_next", field.of_motion.n_x)
    kept = [u[i] for i in controls]
    change = [new - old for new, old in zip(kept, x[field.layout.state.actuators], strict=True)]
    powers = [dense[power * n : (power + 1) * n] for power in range(4)]
    zeros = [0.0] * len(kept)
    whole = [
        entry for power, rest in zip(powers, (change, *[zeros] * 3), strict=True) for entry in (*power, *rest)
    ]
    given = {"x": x, "u": u, "motion_next": landed, "dense_of_motion": dense}
    outputs = {"x_next": [*landed, *kept], "dense": whole}
    program.call(graph_of(f"{field.name}_actuated_measured", given, outputs))


def _append_motion(
    program: Program, field: SpaceArmField, append: Callable[[Program, SpaceArmField], Any]
) -> Any:
    """Append what a method appends for the motion alone, with names of its own."""
    moving = field.of_motion
    x = symbols("x", field.n_x)
    program.call(graph_of(f"{field.name}_of_motion", {"x": x}, {"motion": x[: moving.n_x]}))
    buffers = [Buffer("x", moving.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)]
    own = Program("motion", program_inputs(moving, *buffers), [])
    found = append(own, moving)
    names = {name: f"{name}_of_motion" for name in ("multiplier", "B", "dense")}
    program.append(own, **names, x="motion", x_next="motion_next")
    return found


def _enlarged(pattern: Any, places: Sequence[int], size: int) -> Any:
    """A square pattern with its rows and columns at other places; its nonzeros keep their order."""
    rows, columns = pattern.get_triplet()
    places = list(places)
    return casadi.Sparsity.triplet(size, size, [places[i] for i in rows], [places[i] for i in columns])
