"""Experts: optimal control of a scene, by control-limited differential dynamic programming."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experts.ddp.box_ddp import BoxDDP
    from experts.ddp.solution import Solution, StopReason
    from experts.demonstrations import generate_demonstrations, load_demonstrations
    from experts.guesses.guided import GuidedDDP
    from experts.problems.casadi_problem import CasadiProblem
    from experts.problems.euclidean_problem import runge_kutta
    from experts.problems.python_problem import PythonProblem
    from experts.problems.shooting_problem import ShootingProblem
    from experts.receding_horizon import RecedingHorizonExpert

__all__ = [
    "BoxDDP",
    "CasadiProblem",
    "GuidedDDP",
    "PythonProblem",
    "RecedingHorizonExpert",
    "ShootingProblem",
    "Solution",
    "StopReason",
    "generate_demonstrations",
    "load_demonstrations",
    "runge_kutta",
]

_HOMES = {
    "BoxDDP": "ddp.box_ddp",
    "CasadiProblem": "problems.casadi_problem",
    "GuidedDDP": "guesses.guided",
    "PythonProblem": "problems.python_problem",
    "RecedingHorizonExpert": "receding_horizon",
    "ShootingProblem": "problems.shooting_problem",
    "Solution": "ddp.solution",
    "StopReason": "ddp.solution",
    "generate_demonstrations": "demonstrations",
    "load_demonstrations": "demonstrations",
    "runge_kutta": "problems.euclidean_problem",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
