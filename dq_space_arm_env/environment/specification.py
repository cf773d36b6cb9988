"""Specifications of environments that `to_json` can write: scenes as mappings, paths as text."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

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
    """A scene as a mapping, and a path as text."""
    if isinstance(value, Scene):
        return value.model_dump(mode="json")
    return str(value) if isinstance(value, Path) else value
