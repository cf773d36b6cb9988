"""One-step methods for the equations of motion of any scene, built from the registry's entries."""

from importlib import import_module
from typing import Any

from dq_space_arm_env.integrators.divided_step import DividedStep
from dq_space_arm_env.integrators.method import EmbeddedIntegrator, Integrator
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.scene.simulation import Simulation

__all__ = ["Integrator", "checked_integrator_of", "integrator_of"]


def integrator_of(simulation: Simulation, name: str = "") -> Integrator:
    """Build the scene's integrator, or the named one, with the scene's tolerances."""
    entry = INTEGRATORS[name or simulation.integrator]
    method, *parts = (_find(each) for each in entry.implementation)
    given = [part() if isinstance(part, type) else part for part in parts]
    found: Integrator = method(*given, *(simulation.tolerance_of(key) for key in entry.tolerances))
    return found


def checked_integrator_of(simulation: Simulation, name: str = "") -> Integrator | DividedStep | None:
    """Build the integrator whose steps tell their error; None where nothing estimates it.

    Methods that do not adapt their steps, but have an embedded one, are divided by the scene's tolerance.
    """
    name = name or simulation.integrator
    if not simulation.estimates_error(name):
        return None
    method = integrator_of(simulation, name)
    if INTEGRATORS[name].is_adaptive:
        return method
    assert isinstance(method, EmbeddedIntegrator)
    return DividedStep(method, simulation.division)


def _find(name: str) -> Any:
    """The class or tableau `module.name` of this package."""
    module, attribute = name.split(".")
    return getattr(import_module(f"{__name__}.{module}"), attribute)
