"""Agents that learn on the environment, and how close they come to the optimal controller.

`train` trains an agent from a configuration, `evaluate` flies it from fixed starts beside the expert,
`compare` compares agents with the expert's controllers, `zoo` holds those that ship with the package, and
`DQSpaceArmVecEnv` is the native vector environment for Stable-Baselines3, `SB3VecEnv` adapts wrapped ones
(`agents.wrappers`), and `export_policy` turns a trained model into a file that flies with NumPy alone.
Stable-Baselines3 and PyTorch are loaded on first use; an exported policy needs neither.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.evaluation import compare, evaluate
    from agents.policies import ExportedPolicy
    from agents.reinforcement.networks import export_policy
    from agents.training import train
    from agents.vec_env import DQSpaceArmVecEnv, SB3VecEnv

__all__ = [
    "DQSpaceArmVecEnv",
    "ExportedPolicy",
    "SB3VecEnv",
    "compare",
    "evaluate",
    "export_policy",
    "train",
]

_HOMES = {
    "DQSpaceArmVecEnv": "vec_env",
    "ExportedPolicy": "policies",
    "SB3VecEnv": "vec_env",
    "compare": "evaluation",
    "evaluate": "evaluation",
    "export_policy": "reinforcement.networks",
    "train": "training",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{_HOMES[name]}")
    except ModuleNotFoundError as error:
        if error.name not in ("stable_baselines3", "torch"):
            raise
        raise ImportError(f'{name} needs {error.name}: pip install "dq-space-arm[agents]"') from error
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
