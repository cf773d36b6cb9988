"""Specifications of environments that `to_json` can write: scenes as mappings, paths and modes as text."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from dq_space_arm_env.scene import Scene


class PlainSpec:
    """The attribute `spec` of an environment, whose arguments Gymnasium can write as JSON.

    `gymnasium.make` keeps the arguments of an environment there, and makes the same environment again from
    `EnvSpec.from_json(env.spec.to_json())`.
    """

    def __get__(self, env: Any, owner: type[Any] | None = None) -> Any:
        return None if env is None else env.__dict__.get("_spec")

    def __set__(self, env: Any, spec: Any) -> None:
        if spec is not None:
            spec = dataclasses.replace(
                spec, kwargs={name: _plain(each) for name, each in spec.kwargs.items()}
            )
        env.__dict__["_spec"] = spec


def _plain(value: Any) -> Any:
    """A scene as a mapping, a path as text, a mode as its name, and NumPy's numbers as Python's."""
    if isinstance(value, Scene):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, Path) else value
