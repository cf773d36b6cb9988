"""One-step methods for the equations of motion of any scene, built from the registry's entries."""

from importlib import import_module
from typing import Any

from dq_space_arm_env.integrators.method import Integrator
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.scene.simulation import Simulation

__all__ = ["Integrator", "integrator_of"]


def integrator_of(simulation: Simulation, name: str = "") -> Integrator:
    """Build the scene's integrator, or the named one, with the scene's tolerances."""
    entry = INTEGRATORS[name or simulation.integrator]
    method, *parts = (_find(each) for each in entry.implementation)
    given = [part() if isinstance(part, type) else part for part in parts]
    found: Integrator = method(*given, *(simulation.tolerance_of(key) for key in entry.tolerances))
    return found


def _find(name: str) -> Any:
    """The class or tableau `module.name` of this package."""
    module, attribute = name.split(".")
    return getattr(import_module(f"{__name__}.{module}"), attribute)
