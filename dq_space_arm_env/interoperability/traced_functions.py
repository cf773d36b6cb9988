"""Shared by the traces' ways to other libraries: which steps they can take, and graphs evaluated by them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dq_space_arm_env.compiler.graph import Graph
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.interoperability.exporting import integrator_name
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

Scalar = Any


def step_of_fixed_stages(programs: ScenePrograms, integrator: str | None, library: str) -> Program:
    """Trace a step; ValueError if the integrator, the scene's by default, is unknown or repeats calls."""
    name = integrator_name(programs.scene, integrator)
    step = programs.build("step", name)
    if step.loops:
        raise ValueError(
            f"integrator: {name!r} repeats calls until tolerances are met or stages converge, which "
            f"{library} cannot differentiate; give one with a fixed number of stages, for example "
            "integrator='rk8'"
        )
    return step


def evaluated(
    graph: Graph,
    arguments: Sequence[Sequence[Scalar]],
    operations: Mapping[str, Callable[..., Scalar]],
    constant: Callable[[float], Scalar],
) -> list[list[Scalar]]:
    """Evaluate a graph node by node: the scalars of each output."""
    values: list[Scalar] = []
    for node in graph.nodes:
        if node.operation == "constant":
            values.append(constant(node.constant))
        elif node.operation == "input":
            values.append(arguments[node.slot[0]][node.slot[1]])
        else:
            values.append(operations[node.operation](*(values[i] for i in node.arguments)))
    return [[values[i] for i in indices] for indices in graph.results]
