"""The one-step method of a scene's stages: its integrator, and the catch that may follow a step."""

from __future__ import annotations

from functools import partial
from typing import Any

from dq_space_arm_env.integrators import Integrator, integrator_of
from dq_space_arm_env.integrators.after_jump import StepAndJump
from dq_space_arm_env.task.catching import catch_of_stage, has_catch
from dq_space_arm_env.task.equations import SceneEquations


def stage_method(equations: SceneEquations, integrator: str) -> Integrator:
    """Build the scene's integrator, or the named one, with the catch at the end of a stage, if any."""
    method: Integrator = with_catch(equations, integrator_of(equations.scene.simulation, integrator))
    return method


def with_catch(equations: SceneEquations, method: Any) -> Any:
    """Let the catch follow a method's step, where a scene has one."""
    if not has_catch(equations.scene):
        return method
    return StepAndJump(method, partial(catch_of_stage, equations))
