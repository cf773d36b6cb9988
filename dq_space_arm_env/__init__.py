"""DQ Space Arm: a spacecraft with an arm in dual quaternions, as an environment and as compiled functions.

Importing this package registers `DQSpaceArm-v0` and `DQSpaceArmGoal-v0` and loads little else: each public
name imports what it needs when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.registration import register_environments

if TYPE_CHECKING:
    from dq_space_arm_env.environment import DQSpaceArmEnv, DQSpaceArmGoalEnv, DQSpaceArmVectorEnv
    from dq_space_arm_env.kernels import Kernels, compile_scene
    from dq_space_arm_env.scene import Scene, SceneError, list_scenes, load_scene

__version__ = "0.1.0"

__all__ = [
    "DQSpaceArmEnv",
    "DQSpaceArmGoalEnv",
    "DQSpaceArmVectorEnv",
    "Kernels",
    "Scene",
    "SceneError",
    "compile_scene",
    "list_scenes",
    "load_scene",
]

_HOMES = {
    "DQSpaceArmEnv": "environment",
    "DQSpaceArmGoalEnv": "environment",
    "DQSpaceArmVectorEnv": "environment",
    "Kernels": "kernels",
    "Scene": "scene",
    "SceneError": "scene",
    "compile_scene": "kernels",
    "list_scenes": "scene",
    "load_scene": "scene",
}

register_environments()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
