"""The distinct robots among the shipped scenes: many scenes ask another maneuver of a robot that others have.

What concerns only the equations of motion and their integration is measured and tested on one scene of each
robot, so that another maneuver of a known robot costs nothing there.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from dq_space_arm_env import Scene, list_scenes, load_scene
from dq_space_arm_env.scene import StateLayout

PREFERRED = (
    "paper",
    "planar",
    "no-wrist",
    "payload",
    "random-masses",
    "six-joint",
    "tip-load",
    "free-floating",
    "reaction-wheels",
)
"""Scenes that stand for their robots, whatever other scenes share them: records name these."""

OTHER_MOTIONS = ("tumbling",)
"""Scenes whose robots others have, but not the kind of motion: this one spins, with wide limits."""

_PARTS = ("base", "links", "tip_link", "wrist", "tip", "payload", "other_tips", "tip_wrench", "simulation")
_OF_THE_TASK: dict[str, Any] = {"links": {"__all__": {"name", "torque_limit"}}, "simulation": {"dt", "steps"}}


@cache
def robots() -> tuple[str, ...]:
    """Names of shipped scenes, one for each distinct robot; `paper` is the first.

    A scene with phases has a robot in each of them, which `tests/task/test_phases.py` compares with its own.
    """
    shipped = list_scenes()
    names = [*(name for name in PREFERRED if name in shipped), *shipped]
    first: dict[str, str] = {}
    for name in names:
        scene = load_scene(name)
        if not scene.phases:
            first.setdefault(robot(scene), name)
    return tuple(first.values())


def robot(scene: Scene) -> str:
    """Everything in a scene that the machine code of its dynamics follows from, as text.

    That is bodies, joints, which actuators there are, what acts on the tip, how motions are integrated, and
    which masses are parameters; not limits, weights, target, start, time step and number of steps.
    """
    content = scene.model_dump(include=set(_PARTS), exclude=_OF_THE_TASK)
    actuators = scene.actuators.model_dump(exclude_none=True)
    content["actuators"] = [
        (name, {key: value for key, value in actuators[name].items() if key != "limit"})
        if isinstance(actuators[name], dict)
        else (name, actuators[name])  # wheels and thrusters, one by one
        for name in sorted(actuators)
    ]
    names = StateLayout.of(scene).parameters.names
    content["parameters"] = [
        name
        for name in names
        if name.startswith(("base.", "links.", "payload.")) and not name.endswith(".torque_limit")
    ]
    return json.dumps(content, sort_keys=True)
