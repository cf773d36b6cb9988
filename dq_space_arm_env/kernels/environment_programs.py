"""The programs of the environments: begin an episode, observe its start, a whole step, and goals compared.

They differ from those of `programs.py` in that target, masses and inertias are inputs (`parameters`) where
the scene draws them for each episode; in every other scene there is no such input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import casadi

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.compiler.graph import Graph, trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.cost import weighted_square
from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.kernels.equations import SceneEquations, total
from dq_space_arm_env.kernels.parameters import EpisodeParameters
from dq_space_arm_env.kernels.report import MEMORY, REPORT, STATE_LIMIT
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import number_of_draws

Scalar = Any
Scalars = Sequence[Scalar]

DEGREES = 180.0 / math.pi


class EnvironmentPrograms:
    """Builds the programs of one scene's environments by name."""

    def __init__(self, scene: Scene) -> None:
        """Collect the scene's equations.

        Args:
            scene: A validated scene.
        """
        self.scene = scene
        self.equations = SceneEquations.parametric(scene)
        self._parameters = self.equations.field.parameters

    def build(self, name: str, integrator: str) -> Program:
        """Trace a program.

        Args:
            name: One of `PROGRAMS`.
            integrator: Name of the integrator.

        Returns:
            The program.

        Raises:
            KeyError: If there is no such program or integrator.
        """
        return PROGRAMS[name](self, integrator)

    def _inputs(self, *buffers: Buffer) -> list[Buffer]:
        """Inputs of a program, the parameters after the first of them."""
        if not self._parameters:
            return list(buffers)
        return [buffers[0], Buffer("parameters", len(self._parameters)), *buffers[1:]]

    def _start(self, integrator: str) -> Program:
        """Draws to initial states, memory and parameters, for the copies in a list."""
        count = number_of_draws(self.scene)

        def outputs(draws: Scalars) -> Mapping[str, Scalars]:
            state, parameters = EpisodeParameters.values(self.scene, draws)
            begun = {"x": state, "memory": [0.0] * len(MEMORY)}
            return {**begun, "parameters": parameters} if parameters else begun

        graph = trace("start_graph", {"draws": count}, outputs)
        buffers = [Buffer(name, size) for name, size in graph.outputs]
        program = Program(
            "environment_start", [Buffer("draws", count, dtype="float64")], buffers, indexed=True
        )
        program.call(graph)
        return program

    def _observe(self, integrator: str) -> Program:
        """What is seen of the present states, without a step, for the copies in a list."""
        equations, simulation = self.equations, self.scene.simulation

        def outputs(x: Scalars, memory: Scalars) -> Mapping[str, Scalars]:
            seen = equations.observe(x, (simulation.steps - memory[0]) * simulation.dt)
            angle, distance = self._shown_errors(seen["errors"])
            costs = [0.0] * (len(REPORT) - 2)
            return {
                "memory_kept": [memory[0], *equations.state_cost_terms(x)],
                "observation": seen["observation"],
                "report": [*costs, angle, distance],
                "flags": [0.0, self._within_tolerance(angle, distance), 0.0],
            }

        sizes = {"x": equations.field.n_x, "memory": len(MEMORY)}
        graph = trace("observe_graph", sizes, outputs, parameters=self._parameters)
        inputs = self._inputs(*(Buffer(name, size) for name, size in sizes.items()))
        program = Program("environment_observe", inputs, _outputs(graph), indexed=True)
        program.call(graph)
        return program

    def _goal(self, integrator: str) -> Program:
        """How far poses of the tip are from goals: errors, cost and success, whatever the target is."""
        weights = self.scene.cost.pose

        def outputs(achieved: Scalars, desired: Scalars) -> Mapping[str, Scalars]:
            errors = [poses.error_angle(achieved, desired), poses.error_distance(achieved, desired)]
            angle, distance = self._shown_errors(errors)
            # q and -q are one goal: the nearer one counts.
            signs = (desired, [-entry for entry in desired])
            cost = casadi.fmin(*(weighted_square(achieved, goal, weights) for goal in signs))
            return {
                "errors": [angle, distance],
                "cost": [cost],
                "is_success": [self._within_tolerance(angle, distance)],
            }

        graph = trace("goal_graph", {"achieved": 8, "desired": 8}, outputs)
        dtypes = {"errors": "float64", "cost": "float64", "is_success": "bool"}
        program = Program(
            "environment_goal",
            [Buffer(name, size) for name, size in graph.inputs],
            [Buffer(name, size, dtype=dtypes[name]) for name, size in graph.outputs],
        )
        program.call(graph)
        return program

    def _shown_errors(self, errors: Scalars) -> tuple[Scalar, Scalar]:
        """Angle in degrees, distance in m."""
        return errors[0] * DEGREES, errors[1]

    def _within_tolerance(self, angle: Scalar, distance: Scalar) -> Scalar:
        success = self.scene.success
        return casadi.logic_and(angle <= success.attitude_error_deg, distance <= success.position_error)

    def _step(self, integrator: str, name: str, actions: str) -> Program:
        """Actions to inputs, motion, observation, reward and the episode's end."""
        field = self.equations.field
        n_x, n_u = field.n_x, field.n_u
        dt = self.scene.simulation.dt
        program = Program(
            name,
            self._inputs(
                Buffer("x", n_x),
                Buffer("memory", len(MEMORY)),
                Buffer("action", n_u, dtype=actions),
            ),
            [],
        )
        program.call(trace("inputs_graph", {"action": n_u}, self._commanded))
        program.call(trace("time_step_graph", {}, lambda: {"h": [dt]}))
        integrator_of(self.scene.simulation, integrator).append_step(program, field)
        sizes = {"x": n_x, "x_next": n_x, "u": n_u, "memory": len(MEMORY)}
        report = trace("report_graph", sizes, self._report, parameters=self._parameters)
        program.call(report)
        program.outputs = _outputs(report)
        return program

    def _commanded(self, action: Scalars) -> Mapping[str, Scalars]:
        """Inputs from an action, clipped to [-1, 1]."""
        limits = self.equations.layout.control_limit.tolist()
        # Written so that NaN passes: of two numbers that do not compare, the second is taken.
        clipped = [casadi.fmin(1.0, casadi.fmax(-1.0, value)) for value in action]
        return {"u": [limit * value for limit, value in zip(limits, clipped, strict=True)]}

    def _report(self, x: Scalars, x_next: Scalars, u: Scalars, memory: Scalars) -> Mapping[str, Scalars]:
        """Everything that a step tells, and the state to go on with.

        A copy whose simulation has blown up keeps its last sound state, and is charged for every step that is
        left of its episode.
        """
        equations, steps, dt = self.equations, self.scene.simulation.steps, self.scene.simulation.dt
        # NaN is not below any limit.
        sound = total([entry * entry for entry in x_next]) <= STATE_LIMIT**2
        x_kept = [casadi.if_else(sound, new, old) for new, old in zip(x_next, x, strict=True)]
        taken, *state_terms = memory
        remaining = steps - taken
        last = taken == steps - 1
        seen = equations.observe(x_kept, (remaining - 1.0) * dt)
        angle, distance = self._shown_errors(seen["errors"])
        terms = [*state_terms, equations.effort(u)]
        over = casadi.logic_or(last, casadi.logic_not(sound))
        terminal = [casadi.if_else(over, term, 0.0) for term in equations.terminal_cost_terms(x_kept)]
        charged = casadi.if_else(sound, 1.0, remaining)
        reward = -(total(terms) * charged) - total(terminal)
        success = casadi.logic_and(sound, self._within_tolerance(angle, distance))
        return {
            "x_kept": x_kept,
            "memory_kept": [taken + sound, *equations.state_cost_terms(x_kept)],
            "observation": seen["observation"],
            "report": [reward, *terms, *terminal, angle, distance],
            "flags": [over, success, casadi.logic_not(sound)],
        }


def _outputs(graph: Graph) -> list[Buffer]:
    """Buffers of a graph's outputs; report and flags have a row for each of their entries."""
    columns = {"report": "float64", "flags": "bool"}
    return [
        Buffer(name, size, dtype=columns.get(name, ""), by_column=name in columns)
        for name, size in graph.outputs
    ]


PROGRAMS: Mapping[str, Callable[[EnvironmentPrograms, str], Program]] = {
    "environment_start": EnvironmentPrograms._start,
    "environment_observe": EnvironmentPrograms._observe,
    "environment_goal": EnvironmentPrograms._goal,
    **{
        name: partial(EnvironmentPrograms._step, name=name, actions=actions)
        for name, actions in (
            ("environment_step", "float64"),
            ("environment_step_float32_actions", "float32"),
        )
    },
}
