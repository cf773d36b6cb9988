"""The one-step method of a scene's stages: its integrator, its actuators, and the catch that may follow."""

from __future__ import annotations

from functools import partial
from typing import Any

from dq_space_arm_env.integrators import Integrator, integrator_of
from dq_space_arm_env.integrators.actuated import actuated
from dq_space_arm_env.integrators.after_jump import StepAndJump
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.task.catching import catch_of_stage, has_catch
from dq_space_arm_env.task.equations import SceneEquations


def stage_method(equations: SceneEquations, integrator: str) -> Integrator:
    """Build the scene's integrator, or the named one, with what goes along with a stage, if anything.

    ValueError for one without quaternions among its angles, where a joint is spherical.
    """
    if integrator and equations.tree.has_spherical and not INTEGRATORS[integrator].turns_quaternions:
        raise ValueError(
            f"integrator: {integrator!r} has no quaternions among its angles, as spherical joints have"
        )
    method: Integrator = of_stage(equations, integrator_of(equations.scene.simulation, integrator))
    return method


def of_stage(equations: SceneEquations, method: Any) -> Any:
    """Let actuators step along with a method's step, and the catch follow it, where a scene has them."""
    method = actuated(method, equations.field)
    if not has_catch(equations.scene):
        return method
    return StepAndJump(method, partial(catch_of_stage, equations))
