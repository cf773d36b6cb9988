"""Plain data of small valid scenes, a way to change it, and the sentences of a refusal."""

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from dq_space_arm_env.scene import Scene

REMOVED = object()
BODY = {"inertia": [0.1, 0.2, 0.2], "center_of_mass": [0.3, 0, 0]}


@pytest.fixture
def data() -> dict[str, Any]:
    """A valid scene with two links and a wrist, as plain data."""
    return {
        "name": "small",
        "base": {"mass": 100, "inertia": [10, 11, 12]},
        "links": [
            {"name": "upper", "mass": 5, **BODY, "joint": {}},
            {"name": "lower", "mass": 4, **BODY, "joint": {"position": [0.6, 0, 0]}},
        ],
        "wrist": {"frame": {"position": [0.6, 0, 0]}},
        "actuators": {
            "base_force": {"limit": 10},
            "base_torque": {"limit": [1, 2, 3]},
            "joint_torque": {"limit": 2},
            "wrist_rate": {"limit": 0.5},
        },
        "target": {"pose": {"position": [1, 0, 0]}},
    }


@pytest.fixture
def planar_data() -> dict[str, Any]:
    """A valid planar scene with one link, as plain data."""
    return {
        "name": "planar",
        "base": {"mass": 100, "inertia": [10, 11, 12], "motion": "planar"},
        "links": [{"name": "arm", "mass": 5, **BODY, "joint": {}}],
        "actuators": {"base_force": {"limit": [1, 2, 3]}, "base_torque": {"limit": [4, 5, 6]}},
        "target": {"pose": {"position": [1, 0, 0]}},
    }


Change = Callable[..., dict[str, Any]]


@pytest.fixture
def change() -> Change:
    """Function that sets the value at a path like "links.0.mass"; without a value, it removes the key."""

    def function(data: dict[str, Any], path: str, value: Any = REMOVED) -> dict[str, Any]:
        *keys, last = (int(key) if key.isdigit() else key for key in path.split("."))
        inner: Any = data
        for key in keys:
            inner = inner.setdefault(key, {}) if isinstance(inner, dict) else inner[key]
        if value is REMOVED:
            del inner[last]
        else:
            inner[last] = value
        return data

    return function


@pytest.fixture
def refusals() -> Callable[[dict[str, Any]], list[str]]:
    """Function that validates data and returns the sentences of the refusal."""

    def function(data: dict[str, Any]) -> list[str]:
        with pytest.raises(ValidationError) as caught:
            Scene.model_validate(data)
        return [detail["msg"] for detail in caught.value.errors()]

    return function
