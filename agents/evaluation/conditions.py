"""Evaluation conditions: the scene that agents are trained in, and variants they have not seen.

Some change the scene, others disturb the flights in it.
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env import Scene, SceneError
from dq_space_arm_env.environment.disturbances import Disturbance, Disturbances, load_numbers, load_place

WIDER = 1.5
"""Factor of the spread of starts."""
PAYLOAD_CHANGE = 0.3
"""Share by which the payload is lighter or heavier."""
SPIN = 0.05
"""Angular velocity of the base that is added about its z axis, rad/s: 43 degrees in the paper's 15 s."""
DELAY = 0.15
"""Time from an action to its effect, s."""
NOISE = 0.01
"""Standard deviation of the noise on every tangent coordinate, rad, m, rad/s, m/s."""
PUSH, PUSHES = 0.05, 3
"""Root mean square of the jumps of the base's velocities, rad/s, m/s; and their mean number."""

_WIDENED = (
    "base_rotation",
    "base_position",
    "joint_angles",
    "wrist_angles",
    "base_angular_velocity",
    "base_linear_velocity",
    "joint_rates",
    "wheel_speeds",
)
_MEASURED = ("training", "wide_starts", "spin")
"""Conditions that change nothing but the start, which a controller measures."""


def scene_under(scene: Scene, condition: str) -> Scene:
    """Apply a condition to a scene.

    Args:
        scene: The scene that agents are trained in.
        condition: One of `CONDITIONS`: "training" changes nothing; "wide_starts" spreads starts 1.5 times as
            far, those of wheels up to their largest speeds; "light_payload" and "heavy_payload" change mass
            and inertia of the payload by 30 %, or, where there is no payload, as with the paper's massless
            wrist, of the last link; "spin" starts with a turning base; "delay", "noise" and "push" change
            nothing but the name, see `disturbance_under`.

    Returns:
        The scene to evaluate in.

    Raises:
        ValueError: If the condition is unknown, the scene has no mass to change or phases that change it, or
            is no valid one with the change.
    """
    if condition not in _CHANGES:
        raise ValueError(f"condition: {condition!r} is unknown; choose from {', '.join(CONDITIONS)}")
    if condition == "training":
        return scene
    try:
        return _CHANGES[condition](scene).replace(name=f"{scene.name}, {condition}")
    except SceneError as error:
        raise ValueError(f"condition: {condition!r} does not suit scene {scene.name!r}: {error}") from error


def as_known(scene: Scene, condition: str) -> Scene:
    """The scene that a controller plans in: it measures its start, and does not know a changed payload."""
    flown = scene_under(scene, condition)
    return flown if condition in _MEASURED else scene


class FlightDisturbance(NamedTuple):
    """How a condition disturbs flights. The default: not at all."""

    delay: float = 0.0  # from an action to its effect, s
    noise: float = 0.0  # standard deviation of the measured state, rad, m, rad/s, m/s
    push: float = 0.0  # standard deviation along each axis of the base's jumps in velocity, rad/s, m/s

    @property
    def is_drawn(self) -> bool:
        """Whether flights from one start differ."""
        return bool(self.noise or self.push)

    def steps(self, scene: Scene) -> int:
        """Whole time steps of the delay, at least 1 if there is any."""
        return max(round(self.delay / scene.simulation.dt), 1) if self.delay else 0

    def drawn(self, scene: Scene, flights: Sequence[int], of: int, seed: int) -> "Disturbances | None":
        """Noise and pushes of some of many flights; those of a flight depend on its number alone."""
        if not self.is_drawn:
            return None
        settings = {"measurement": self.noise or None, "push": self.push or None, "pushes": PUSHES}
        return ChosenDisturbances(flights, scene, np.random.default_rng([seed, 1]), count=of, **settings)


class ChosenDisturbances(Disturbances):
    """Disturbances of some flights, equal to those that they meet among all flights.

    Args:
        flights: Their numbers.
        scene: The scene.
        rng: Source of random numbers.
        settings: As of `Disturbances`, for all flights.
    """

    def __init__(
        self, flights: Sequence[int], scene: Scene, rng: np.random.Generator, **settings: Any
    ) -> None:
        super().__init__(scene, rng, **settings)
        self._flights = np.array(flights, dtype=np.int64)

    @property
    def episodes(self) -> int:
        """Number of flights that `draw` disturbs."""
        return len(self._flights)

    def draw(self) -> Disturbance:
        """Draw the disturbances of the next step."""
        return Disturbance(*(None if part is None else part[self._flights] for part in super().draw()))


def disturbance_under(condition: str) -> FlightDisturbance:
    """Tell how a condition, one of `CONDITIONS`, disturbs flights."""
    return _DISTURBANCES.get(condition, FlightDisturbance())


def physics_hash(scene: Scene) -> str:
    """SHA-256 of the dynamics: everything but names, starts, cost and tolerances."""
    named = ("name", "description", "spread", "initial_state", "cost", "success")
    content = scene.model_dump(mode="json", exclude=set(named))
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _wide_starts(scene: Scene) -> Scene:
    spread = {name: WIDER * getattr(scene.spread, name) for name in _WIDENED}
    wheels = scene.actuators.wheels or ()
    speeds = scene.initial_state.wheel_speeds or [0.0] * len(wheels)
    left = (wheel.speed - abs(speed) for wheel, speed in zip(wheels, speeds, strict=True))
    return scene.replace(spread={**spread, "wheel_speeds": min(spread["wheel_speeds"], *left, math.inf)})


def _with_load(factor: float) -> Callable[[Scene], Scene]:
    def change(scene: Scene) -> Scene:
        place = load_place(scene)
        if place is None:
            raise ValueError(f"scene {scene.name!r} has its tip on the base: no load can be changed")
        if scene.phases and scene.payload is None:  # a payload is held as it is, or not at all
            staged = [each.name for each in load_numbers(scene) if each.name in scene.staged.values]
            if staged:
                raise ValueError(
                    f"scene {scene.name!r} has phases that change {staged[0]}: no load is scaled"
                )
        load = scene.payload or scene.links[scene.tip_body - 1]
        inertia = (factor * np.array(load.inertia)).tolist()
        return scene.replace({f"{place}.mass": factor * load.mass, f"{place}.inertia": inertia})

    return change


def _spin(scene: Scene) -> Scene:
    velocity = list(scene.initial_state.base_velocity)
    velocity[2] += SPIN
    return scene.replace(initial_state={"base_velocity": velocity})


_DISTURBANCES = {
    "delay": FlightDisturbance(delay=DELAY),
    "noise": FlightDisturbance(noise=NOISE),
    "push": FlightDisturbance(push=PUSH / 3.0**0.5),
}
_CHANGES: Mapping[str, Callable[[Scene], Scene]] = {
    "training": lambda scene: scene,
    "wide_starts": _wide_starts,
    "light_payload": _with_load(1.0 - PAYLOAD_CHANGE),
    "heavy_payload": _with_load(1.0 + PAYLOAD_CHANGE),
    "spin": _spin,
    **dict.fromkeys(_DISTURBANCES, lambda scene: scene),
}
CONDITIONS = tuple(_CHANGES)
"""Names of the conditions."""
