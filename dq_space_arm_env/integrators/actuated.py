"""A step of the motion, and of what the actuators keep from step to step, with exact derivatives of both.

Previous controls follow no differential equation, x+ = u: they pass the method's stages by. Chains of delays
and lags (`actuator_maps`) stand between commands and motion, which sees the mean of their output over the
step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import column, symbols
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.integrators import dormand_prince
from dq_space_arm_env.integrators.actuator_maps import ActuatorMaps
from dq_space_arm_env.integrators.after_jump import StepAndJump, rename
from dq_space_arm_env.integrators.method import Integrator, TwiceDifferentiableIntegrator, program_inputs

Scalar = Any


@dataclass(frozen=True)
class ActuatedStep:
    """A method's step of the motion; actuators keep some controls of the step, by their indices."""

    method: Integrator
    controls: Sequence[int]

    def append_step(self, program: Program, field: SpaceArmField) -> None:
        """See `Integrator.append_step`."""
        _append_motion(program, field, self.method.append_step)
        given, kept = _kept(field)
        given["motion_next"] = symbols("x", field.of_motion.n_x)
        program.call(graph_of(f"{field.name}_actuated", given, {"x_next": [*given["motion_next"], *kept]}))

    def append_linearization(self, program: Program, field: SpaceArmField) -> tuple[Any, Any]:
        """See `Integrator.append_linearization`."""
        a, b = _append_motion(program, field, self.method.append_linearization)
        count, moving = len(self.controls), a.size1()
        matrix, kept = casadi.SX.sym("B", b), casadi.SX(count, field.n_u)
        for row, control in enumerate(self.controls):
            kept[row, control] = 1.0
        if field.layout.chains:
            h = casadi.SX.sym("h")
            maps, by_state = _maps(field, h), casadi.SX.sym("A", a)
            between = casadi.SX(moving + count, count)
            above = casadi.horzcat(casadi.diagcat(by_state, casadi.SX(count, 0)), between)
            driven = casadi.vertcat(casadi.mtimes(matrix, maps.p), casadi.SX(count, maps.p.shape[1]))
            below = casadi.horzcat(casadi.SX(maps.f.shape[0], moving + count), maps.f)
            whole_a = casadi.sparsify(casadi.vertcat(casadi.horzcat(above, driven), below))
            whole = casadi.sparsify(casadi.vertcat(casadi.mtimes(matrix, maps.q), kept, maps.g))
            inputs = {"A_of_motion": by_state.nonzeros(), "B_of_motion": matrix.nonzeros(), "h": [h]}
            outputs = {"A": whole_a.nonzeros(), "B": whole.nonzeros()}
            program.call(graph_of(f"{field.name}_actuated_inputs", inputs, outputs))
            return whole_a.sparsity(), whole.sparsity()
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
        if not field.layout.chains:
            places = [*range(moving), *range(field.n_t, field.n_t + field.n_u)]
            return _enlarged(pattern, places, field.n_t + field.n_u)
        h, given = casadi.SX.sym("h"), casadi.SX.sym("curvature", pattern)
        maps, count = _maps(field, h), len(self.controls)
        # (motion, w) by (motion, previous controls, k, u)
        inputs = casadi.horzcat(casadi.SX(field.n_u, count), maps.p, maps.q)
        by_all = casadi.diagcat(casadi.SX.eye(moving), inputs)
        bent = casadi.mtimes(by_all.T, casadi.mtimes(casadi.triu2symm(given), by_all))
        curvature = casadi.sparsify(casadi.triu(bent))
        graph = graph_of(
            f"{field.name}_actuated_curvature",
            {"curvature_of_motion": given.nonzeros(), "h": [h]},
            {"curvature": curvature.nonzeros()},
        )
        program.call(graph)
        return curvature.sparsity()


def actuated(method: Any, field: SpaceArmField) -> Any:
    """Let the actuators' step go along with a method's, where they keep anything.

    Quaternions of spherical joints get their unit length back after each step of the method.
    """
    layout = field.layout
    if field.tree.has_spherical:
        method = StepAndJump(method, field.of_motion.with_unit_quaternions, before="unscaled")
    if not layout.previous_controls and not layout.chains:
        return method
    return ActuatedStep(method, layout.previous_controls)


def append_measured_step(program: Program, field: SpaceArmField) -> None:
    """Append a step with its error and dense output, in which what is kept changes evenly."""
    if not field.layout.previous_controls and not field.layout.chains:
        _append_measured_motion(program, field)
        return
    _append_motion(program, field, _append_measured_motion)
    n, x = field.of_motion.n_t, symbols("x", field.n_x)
    dense, landed = symbols("dense", 4 * n), symbols("motion_next", field.of_motion.n_x)
    given, kept = _kept(field, x)
    change = [new - old for new, old in zip(kept, x[field.of_motion.n_x :], strict=True)]
    powers = [dense[power * n : (power + 1) * n] for power in range(4)]
    zeros = [0.0] * len(kept)
    whole = [
        entry for power, rest in zip(powers, (change, *[zeros] * 3), strict=True) for entry in (*power, *rest)
    ]
    given |= {"x": x, "motion_next": landed, "dense_of_motion": dense}
    outputs = {"x_next": [*landed, *kept], "dense": whole}
    program.call(graph_of(f"{field.name}_actuated_measured", given, outputs))


def _append_measured_motion(program: Program, field: SpaceArmField) -> None:
    """Append such a step of the motion alone."""
    begin = len(program.calls)
    dormand_prince.append_measured_step(program, field)
    if field.tree.has_spherical:
        rename(program, begin, {"x_next": "x_unscaled"})
        x = symbols("x", field.n_x)
        outputs = {"x_next": field.with_unit_quaternions(x)}
        program.call(graph_of(f"{field.name}_scaled", {"x_unscaled": x}, outputs))


def _maps(field: SpaceArmField, h: Scalar) -> ActuatorMaps:
    return ActuatorMaps.of(field.layout.chains, field.n_u, h)


def _kept(field: SpaceArmField, x: Sequence[Scalar] | None = None) -> tuple[dict[str, Any], list[Scalar]]:
    """What the actuators keep after a step, over symbols, and these by the names of their buffers."""
    u = symbols("u", field.n_u)
    given: dict[str, Any] = {"u": u}
    kept = [u[i] for i in field.layout.previous_controls]
    if field.layout.chains:
        x, h = x or symbols("x_before", field.n_x), casadi.SX.sym("h")
        maps, state = _maps(field, h), field.layout.state
        given |= {"x": x, "h": [h]}
        kept += maps.applied(maps.f, maps.g, column(*x[state.drives]), column(*u))
    return given, kept


def _append_motion(
    program: Program, field: SpaceArmField, append: Callable[[Program, SpaceArmField], Any]
) -> Any:
    """Append what a method appends for the motion alone, with names of its own."""
    moving = field.of_motion
    x = symbols("x", field.n_x)
    program.call(graph_of(f"{field.name}_of_motion", {"x": x}, {"motion": x[: moving.n_x]}))
    names = {name: f"{name}_of_motion" for name in ("multiplier", "B", "dense")}
    if field.layout.chains:
        u, h = symbols("u", field.n_u), casadi.SX.sym("h")
        maps, waiting = _maps(field, h), column(*x[field.layout.state.drives])
        seen = maps.applied(maps.p, maps.q, waiting, column(*u))
        program.call(graph_of(f"{field.name}_actuators", {"x": x, "u": u, "h": [h]}, {"u_of_motion": seen}))
        names |= {name: f"{name}_of_motion" for name in ("u", "A", "curvature")}
    buffers = [Buffer("x", moving.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)]
    own = Program("motion", program_inputs(moving, *buffers), [])
    found = append(own, moving)
    program.append(own, **names, x="motion", x_next="motion_next")
    return found


def _enlarged(pattern: Any, places: Sequence[int], size: int) -> Any:
    """A square pattern with its rows and columns at other places; its nonzeros keep their order."""
    rows, columns = pattern.get_triplet()
    places = list(places)
    return casadi.Sparsity.triplet(size, size, [places[i] for i in rows], [places[i] for i in columns])
