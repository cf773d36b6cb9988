"""What Gymnasium is told of an environment: its spaces, and arguments that `EnvSpec.to_json` can write."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.task.step_report import OBSERVATION_LIMIT, n_observations

_ROUNDING = 1e-5  # by which entries of a unit quaternion may exceed 1


def frames_per_second(scene: Scene) -> int:
    """Pictures of a second of simulated time, one for each step."""
    return max(1, round(1.0 / scene.simulation.dt))


def action_space(kernels: Kernels) -> spaces.Box:
    """Inputs as fractions of their limits; a ValueError if there are none, or one is unlimited."""
    layout = kernels.layout
    limits = zip(layout.control.names, layout.control_limit, strict=True)
    unlimited = [name for name, limit in limits if np.isinf(limit)]
    if unlimited or not layout.n_u:
        verb = "has" if len(unlimited) == 1 else "have"
        problem = f"{', '.join(unlimited)} {verb} no finite limit" if unlimited else "it has no actuator"
        raise ValueError(
            f"scene {kernels.scene.name!r} has no normalized actions: {problem}; "
            "give each actuator a finite limit"
        )
    return spaces.Box(-1.0, 1.0, (layout.n_u,), np.float32)


def observation_space(kernels: Kernels) -> spaces.Box:
    """Observations of `DQSpaceArmEnv`: the goal in tip axes, rates and angles, and the time left."""
    scene, simulation = kernels.scene, kernels.scene.simulation
    high = np.full(n_observations(scene), OBSERVATION_LIMIT)
    high[: 2 if kernels.layout.planar else 4] = 1.0 + _ROUNDING
    if scene.target.motion is not None:  # seen from the tip, which turns, far from the target
        high[kernels.n_x : -1] = OBSERVATION_LIMIT**2
    high[-1] = simulation.steps * simulation.dt * (1.0 + 1e-6)
    low = -high
    low[-1] = 0.0
    return spaces.Box(low.astype(kernels.dtype), high.astype(kernels.dtype), dtype=kernels.dtype.type)


def goal_observation_space(kernels: Kernels) -> spaces.Dict:
    """Observations of `DQSpaceArmGoalEnv`: the state, the pose of the tip, and the goal."""
    layout = kernels.layout
    seen = layout.goal_observation(layout.initial_state, layout.parameters.nominal)
    sizes = {"observation": seen.size, "achieved_goal": 8, "desired_goal": 8}
    boxes: dict[str, spaces.Space[Any]] = {}
    for name, size in sizes.items():
        high = np.full(size, OBSERVATION_LIMIT, kernels.dtype)
        high[: 2 if layout.planar and name == "observation" else 4] = 1.0 + _ROUNDING
        boxes[name] = spaces.Box(-high, high, dtype=high.dtype.type)
    return spaces.Dict(boxes)


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
