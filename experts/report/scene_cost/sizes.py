"""How large a scene's equations are, whatever machine they run on, and what its compiled step takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.scene.layout import StateLayout
from experts.report.scene_cost.programs import ProgramCost, compile_cold, trace_program

COMPARED_INTEGRATORS = ("symplectic_euler", "rk4")


@dataclass(frozen=True)
class SceneSize:
    """Size of a scene.

    Attributes:
        states: Number of states.
        tangent_states: Number of tangent coordinates of the state.
        inputs: Number of inputs.
        observations: Number of entries of an observation.
        state_bytes: A state in memory.
        dynamics_operations: Operations of the forward dynamics, with nominal target and masses.
        step_operations: Operations of a step, with nominal target and masses, by name of the integrator.
        step: The compiled step with the scene's integrator.
        environment_step: That of an environment; target and masses that an episode draws are inputs of it.
    """

    states: int
    tangent_states: int
    inputs: int
    observations: int
    state_bytes: int
    dynamics_operations: int
    step_operations: Mapping[str, int]
    step: ProgramCost
    environment_step: ProgramCost


def measure_size(scene: Scene, repeats: int = 1) -> SceneSize:
    """Trace a scene's programs, and compile its steps.

    Args:
        scene: The scene.
        repeats: How often to compile; the fastest counts.

    Returns:
        Its size.
    """
    layout, integrator = StateLayout.of(scene), scene.simulation.integrator
    step, environment_step = (
        compile_cold(scene, name, integrator, repeats) for name in ("step", "environment_step")
    )
    sizes = {buffer.name: buffer.size for buffer in trace_program(scene, "environment_observe").outputs}
    return SceneSize(
        states=layout.n_x,
        tangent_states=layout.n_t,
        inputs=layout.n_u,
        observations=sizes["observation"],
        state_bytes=layout.n_x * np.dtype(scene.simulation.precision).itemsize,
        dynamics_operations=trace_program(scene, "forward_dynamics").operation_count,
        step_operations={
            name: trace_program(scene, "step", name).operation_count for name in COMPARED_INTEGRATORS
        },
        step=step,
        environment_step=environment_step,
    )
