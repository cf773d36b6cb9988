"""Registration of the environments with Gymnasium, which importing this package does not import.

Gymnasium and NumPy take 0.15 s to import, which the command line does not need to list scenes or to show
help. If Gymnasium is not imported yet, the environments are registered as soon as it is.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_REGISTRATION = "gymnasium.envs.registration"


def register_environments() -> None:
    """Make `gymnasium.make` know `DQSpaceArm-v0` and `DQSpaceArmGoal-v0`; a second call changes nothing."""
    if _REGISTRATION in sys.modules:
        _register()
    elif not any(isinstance(finder, _RegisterOnImport) for finder in sys.meta_path):
        sys.meta_path.insert(0, _RegisterOnImport())


def _register() -> None:
    from gymnasium.envs.registration import register, registry

    if "DQSpaceArm-v0" not in registry:
        register(
            id="DQSpaceArm-v0",
            entry_point="dq_space_arm_env.environment:DQSpaceArmEnv",
            vector_entry_point="dq_space_arm_env.environment:DQSpaceArmVectorEnv",
        )
    if "DQSpaceArmGoal-v0" not in registry:
        register(
            id="DQSpaceArmGoal-v0",
            entry_point="dq_space_arm_env.environment:DQSpaceArmGoalEnv",
            vector_entry_point="dq_space_arm_env.environment:DQSpaceArmGoalVectorEnv",
        )


class _RegisterOnImport:
    """Import hook that registers the environments right after Gymnasium's registry is imported."""

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find the module as usual, and extend its execution."""
        if name != _REGISTRATION:
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)  # the usual finders do the work
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                run(module)
                _register()

            spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec
