"""DQ Space Arm: a spacecraft with an arm in dual quaternions, as an environment and as compiled functions.

Importing this package registers `DQSpaceArm-v0` and `DQSpaceArmGoal-v0` and loads little else: each public
name imports what it needs when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.registration import register_environments

if TYPE_CHECKING:
    from dq_space_arm_env.environment import (
        DQSpaceArmEnv,
        DQSpaceArmGoalEnv,
        DQSpaceArmGoalVectorEnv,
        DQSpaceArmVectorEnv,
    )
    from dq_space_arm_env.interoperability.casadi_dynamics import CasadiDynamics, casadi_dynamics
    from dq_space_arm_env.interoperability.jax_dynamics import JaxDynamics, jax_dynamics
    from dq_space_arm_env.interoperability.mjcf_export import scene_to_mjcf
    from dq_space_arm_env.interoperability.pinocchio_twin import (
        from_pinocchio,
        generalized_forces,
        pinocchio_model,
        to_pinocchio,
    )
    from dq_space_arm_env.interoperability.torch_dynamics import TorchDynamics, torch_dynamics
    from dq_space_arm_env.interoperability.urdf_export import scene_to_urdf
    from dq_space_arm_env.interoperability.urdf_import import scene_from_urdf
    from dq_space_arm_env.kernels import Kernels, compile_scene
    from dq_space_arm_env.scene import Scene, SceneError, list_scenes, load_scene

__version__ = "0.1.0"

__all__ = [
    "CasadiDynamics",
    "DQSpaceArmEnv",
    "DQSpaceArmGoalEnv",
    "DQSpaceArmGoalVectorEnv",
    "DQSpaceArmVectorEnv",
    "JaxDynamics",
    "Kernels",
    "Scene",
    "SceneError",
    "TorchDynamics",
    "casadi_dynamics",
    "compile_scene",
    "from_pinocchio",
    "generalized_forces",
    "jax_dynamics",
    "list_scenes",
    "load_scene",
    "pinocchio_model",
    "scene_from_urdf",
    "scene_to_mjcf",
    "scene_to_urdf",
    "to_pinocchio",
    "torch_dynamics",
]

_HOMES = {
    "CasadiDynamics": "interoperability.casadi_dynamics",
    "DQSpaceArmEnv": "environment",
    "DQSpaceArmGoalEnv": "environment",
    "DQSpaceArmGoalVectorEnv": "environment",
    "DQSpaceArmVectorEnv": "environment",
    "JaxDynamics": "interoperability.jax_dynamics",
    "Kernels": "kernels",
    "Scene": "scene",
    "SceneError": "scene",
    "TorchDynamics": "interoperability.torch_dynamics",
    "casadi_dynamics": "interoperability.casadi_dynamics",
    "compile_scene": "kernels",
    "from_pinocchio": "interoperability.pinocchio_twin",
    "generalized_forces": "interoperability.pinocchio_twin",
    "jax_dynamics": "interoperability.jax_dynamics",
    "list_scenes": "scene",
    "load_scene": "scene",
    "pinocchio_model": "interoperability.pinocchio_twin",
    "scene_from_urdf": "interoperability.urdf_import",
    "scene_to_mjcf": "interoperability.mjcf_export",
    "scene_to_urdf": "interoperability.urdf_export",
    "to_pinocchio": "interoperability.pinocchio_twin",
    "torch_dynamics": "interoperability.torch_dynamics",
}

register_environments()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
