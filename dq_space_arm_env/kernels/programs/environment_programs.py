"""The programs of the environments: start an episode, observe, step, and compare goals.

The equations are those of `task.episode`; here they become programs. What varies in a scene is an
input, `parameters`; a scene in which nothing does has no such input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from dq_space_arm_env.compiler.graph import Graph, trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.integrators import checked_integrator_of, integrator_of
from dq_space_arm_env.integrators.actuated import actuated
from dq_space_arm_env.integrators.method import program_inputs
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import parameters
from dq_space_arm_env.scene.path import PATH
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import number_of_draws
from dq_space_arm_env.task import episode
from dq_space_arm_env.task.actuator_limits import reads_state
from dq_space_arm_env.task.catching import has_catch
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.step_report import MEMORY, memory_names


class EnvironmentPrograms:
    """Builds the programs of one scene's environments by name."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.equations = SceneEquations.of(scene)
        self._parameters = self.equations.field.parameters

    def build(self, name: str, integrator: str) -> Program:
        """Trace one of `PROGRAMS`; KeyError for an unknown program or integrator."""
        return PROGRAMS[name](self, integrator)

    def _start(self, integrator: str) -> Program:
        """From draws to initial states, memory and parameters, for the listed sub-environments."""
        count = number_of_draws(self.scene)
        graph = trace("start_graph", {"draws": count}, partial(episode.start, self.scene))
        buffers = [Buffer(name, size) for name, size in graph.outputs]
        program = Program(
            "environment_start", [Buffer("draws", count, dtype="float64")], buffers, indexed=True
        )
        program.call(graph)
        return program

    def _observe(self, integrator: str) -> Program:
        """Observations of the present states, without a step, for the listed sub-environments."""
        sizes = {"x": self.equations.field.n_x, "memory": len(memory_names(self.scene))}
        observe = partial(episode.observe, self.equations)
        graph = trace("observe_graph", sizes, observe, parameters=self._parameters)
        inputs = program_inputs(self.equations.field, *(Buffer(name, size) for name, size in sizes.items()))
        program = Program("environment_observe", inputs, _outputs(graph), indexed=True)
        program.call(graph)
        return program

    def _goal(self, integrator: str) -> Program:
        """Comparison of tip poses with any goals."""
        graph = trace("goal_graph", {"achieved": 8, "desired": 8}, partial(episode.compare_goals, self.scene))
        dtypes = {"errors": "float64", "cost": "float64", "is_success": "bool"}
        program = Program(
            "environment_goal",
            [Buffer(name, size) for name, size in graph.inputs],
            [Buffer(name, size, dtype=dtypes[name]) for name, size in graph.outputs],
        )
        program.call(graph)
        return program

    def _append_stage(self, program: Program, n_memory: int) -> None:
        """From the parameters of the episode to those of the present stage."""
        names = [number.name for number in parameters(self.scene)]
        program.inputs = [
            replace(buffer, name=EPISODE) if buffer.name == "parameters" else buffer
            for buffer in program.inputs
        ]

        def stage(memory: Sequence[Any]) -> Mapping[str, Sequence[Any]]:
            given = episode.at_stage(self.equations, memory[0], memory[len(MEMORY) :]).given
            return {"parameters": [given[each] for each in names]}

        graph = trace("stage_graph", {"memory": n_memory}, stage, episode=self._parameters)
        program.call(graph, episode=EPISODE)

    def _step(self, integrator: str, name: str, actions: str) -> Program:
        """From actions to inputs, motion, observation, reward and end of the episode."""
        equations, simulation = self.equations, self.scene.simulation
        n_x, n_u, n_memory = equations.field.n_x, equations.field.n_u, len(memory_names(self.scene))
        inputs = [Buffer("x", n_x), Buffer("memory", n_memory), Buffer("action", n_u, dtype=actions)]
        following = {"following": PATH} if isinstance(self.scene.target.motion, Waypoints) else {}
        inputs += [Buffer(key, size) for key, size in following.items()]
        program = Program(name, program_inputs(equations.field, *inputs), [])
        if self.scene.phases:
            self._append_stage(program, n_memory)
        command = partial(episode.command, equations)
        asked = {"action": n_u} | ({"x": n_x} if reads_state(self.scene) else {})
        program.call(trace("inputs_graph", asked, command, parameters=self._parameters))
        program.call(trace("time_step_graph", {}, lambda: {"h": [simulation.dt]}))
        method = checked_integrator_of(simulation, integrator)
        stepper = actuated(method or integrator_of(simulation, integrator), equations.field)
        stepper.append_step(program, equations.field)
        sizes = {"x": n_x, "x_next": n_x, "u": n_u, "memory": n_memory}
        sizes |= self._append_most_cost(program, n_memory) | ({"checked_error": 1} if method else {})
        sizes |= following
        report = trace("report_graph", sizes, partial(episode.step, equations), parameters=self._parameters)
        program.call(report, **self._episode)
        program.outputs = _outputs(report)
        return program

    def _append_most_cost(self, program: Program, n_memory: int) -> dict[str, int]:
        """What is charged where an episode ends early; sizes of the buffers that tell."""
        n_x = self.equations.field.n_x
        most = partial(episode.most_cost, self.equations)
        graph = trace("worst_graph", {"x": n_x, "memory": n_memory}, most, parameters=self._parameters)
        if has_catch(self.scene) or any(each.terminates for each in self.scene.constraints):
            program.call(graph, **self._episode)
            return {"worst": 1}
        program.call(trace("diverged_graph", {"x_next": n_x}, episode.diverged))
        with program.only_where("unsound"):
            program.call(graph, **self._episode)
        return {"worst": 1, "unsound": 1}

    @property
    def _episode(self) -> dict[str, str]:
        """Where graphs find the parameters of the episode's start."""
        return {"parameters": EPISODE} if self.scene.phases else {}


EPISODE = "episode_parameters"
"""Name of the parameters of the start of an episode, where its stages have their own."""


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
