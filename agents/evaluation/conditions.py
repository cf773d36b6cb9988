"""What agents are evaluated on: the scene they were trained on, and scenes that they have not seen."""

import hashlib
import json
from collections.abc import Callable, Mapping

from dq_space_arm_env import Scene
from dq_space_arm_env.scene import Link, Payload

WIDER = 1.5
"""Factor of the spread of starts."""
PAYLOAD_CHANGE = 0.3
"""Share by which the payload is lighter or heavier."""
SPIN = 0.05
"""Angular velocity of the base that is added about its z axis, rad/s: 43 degrees in the paper's 15 s."""

_WIDENED = (
    "base_rotation",
    "base_position",
    "joint_angles",
    "wrist_angles",
    "base_angular_velocity",
    "base_linear_velocity",
    "joint_rates",
)
_MEASURED = ("training", "wide_starts", "spin")
"""Conditions that differ in their starts alone."""


def scene_under(scene: Scene, condition: str) -> Scene:
    """Change a scene as a condition says.

    Args:
        scene: The scene that agents are trained on.
        condition: One of `CONDITIONS`: "training" leaves it as it is; "wide_starts" spreads starts 1.5 times
            as far; "light_payload" and "heavy_payload" take 30 % off the payload's mass and inertia, or add
            them, and where there is no payload, as with the paper's massless wrist, to the last link; "spin"
            lets the base start turning.

    Returns:
        The scene to evaluate on.

    Raises:
        ValueError: If there is no such condition, or the scene has no arm whose mass could be changed.
    """
    if condition not in _CHANGES:
        raise ValueError(f"condition: {condition!r} is unknown; there are {', '.join(CONDITIONS)}")
    if condition == "training":
        return scene
    return _CHANGES[condition](scene).replace(name=f"{scene.name}, {condition}")


def as_known(scene: Scene, condition: str) -> Scene:
    """The scene as a controller knows it that plans a flight under a condition.

    Where a flight starts, and how fast, is measured before it; what the payload weighs is not.

    Args:
        scene: The scene that agents are trained on.
        condition: One of `CONDITIONS`.

    Returns:
        The scene to plan in: that of the condition if it changes nothing but starts, else the unchanged one.

    Raises:
        ValueError: As for `scene_under`.
    """
    flown = scene_under(scene, condition)
    return flown if condition in _MEASURED else scene


def physics_hash(scene: Scene) -> str:
    """Identify what a policy flies in: neither names, nor where it starts, what is charged and tolerated.

    Args:
        scene: The scene.

    Returns:
        SHA-256 of the rest as canonical JSON, 64 hexadecimal digits.
    """
    named = ("name", "description", "spread", "initial_state", "cost", "success")
    content = scene.model_dump(mode="json", exclude=set(named))
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _wide_starts(scene: Scene) -> Scene:
    spread = scene.spread.model_dump()
    return scene.replace(spread=spread | {name: WIDER * spread[name] for name in _WIDENED})


def _with_load(factor: float) -> Callable[[Scene], Scene]:
    def change(scene: Scene) -> Scene:
        if scene.payload is not None:
            return scene.replace(payload=_scaled(scene.payload, factor))
        if not scene.links:
            raise ValueError(f"scene {scene.name!r} has neither payload nor links: no load can be changed")
        *others, last = scene.links
        return scene.replace(links=[*others, _scaled(last, factor)])

    return change


def _scaled(body: Link | Payload, factor: float) -> dict[str, object]:
    inertia = tuple(tuple(factor * entry for entry in row) for row in body.inertia)
    return body.model_dump() | {"mass": factor * body.mass, "inertia": inertia}


def _spin(scene: Scene) -> Scene:
    velocity = list(scene.initial_state.base_velocity)
    velocity[2] += SPIN
    return scene.replace(initial_state=scene.initial_state.model_dump() | {"base_velocity": velocity})


_CHANGES: Mapping[str, Callable[[Scene], Scene]] = {
    "training": lambda scene: scene,
    "wide_starts": _wide_starts,
    "light_payload": _with_load(1.0 - PAYLOAD_CHANGE),
    "heavy_payload": _with_load(1.0 + PAYLOAD_CHANGE),
    "spin": _spin,
}
CONDITIONS = tuple(_CHANGES)
"""Names of the conditions."""
