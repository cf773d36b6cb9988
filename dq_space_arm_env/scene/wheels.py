"""Reaction wheels of a scene: balanced rotors in the base, each with a motor about its axis."""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from dq_space_arm_env.scene.constraints import Direction
from dq_space_arm_env.validation.fields import Angle, Limit, Positive, Three, numbers_of
from dq_space_arm_env.validation.problems import Model, Problem, problem

Scene = Any  # `schema.Scene`


class _Rotor(Model):
    inertia: Positive = Field(description="inertia about the wheel's axis, part of base.inertia, kg m^2")
    torque: Limit = Field(description="largest torque of the motor, N m; .inf: unlimited")
    speed: Limit = Field(
        default=math.inf,
        description="largest speed relative to the base, rad/s, where its torque stops; .inf: any",
    )
    power: Limit = Field(
        default=math.inf,
        description="largest power of the motor, torque times speed, driving or braking, W; .inf: any",
    )


class Wheel(_Rotor):
    """A balanced reaction wheel; mass and inertia of the base include it, locked.

    Its motor's torque acts on the wheel about the axis, and against it on the base.
    """

    axis: Direction = Field(description="axis of the wheel in base axes, of any length but zero")

    @property
    def unit_axis(self) -> Three:
        """The axis as a unit vector."""
        length = math.hypot(*self.axis)
        x, y, z = (entry / length for entry in self.axis)
        return x, y, z


class WheelSet(_Rotor):
    """Wheels that are alike: `orthogonal` about x, y, z; or a `pyramid` of four about z."""

    set: Literal["orthogonal", "pyramid"] = Field(description="arrangement")
    elevation_deg: Angle = Field(
        default=math.degrees(math.atan(math.sqrt(0.5))),
        description="angle of the pyramid's axes above the x-y plane, degrees; by default the set stores as "
        "much about each axis of the base",
    )

    def wheels(self) -> list[dict[str, Any]]:
        """The wheels one by one."""
        cosine, sine = (f(math.radians(self.elevation_deg)) for f in (math.cos, math.sin))
        axes = {
            "orthogonal": [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)],
            "pyramid": [(cosine, 0.0, sine), (0.0, cosine, sine), (-cosine, 0.0, sine), (0.0, -cosine, sine)],
        }
        shared = self.model_dump(exclude={"set", "elevation_deg"})
        return [{"axis": axis, **shared} for axis in axes[self.set]]


def _read_wheels(value: Any) -> Any:
    """Write a set as its wheels."""
    if isinstance(value, dict) and "set" in value:
        return WheelSet.model_validate(value).wheels()
    if not isinstance(value, list | tuple) or not value:
        raise problem("must be a list of wheels, or a set: {set: pyramid, inertia, torque, speed}")
    return value


Wheels = Annotated[tuple[Wheel, ...], BeforeValidator(_read_wheels)]


def wheel_problems(scene: Scene) -> Iterator[Problem]:
    """Find wheels that do not fit into the base, and that turn out of the plane of a planar one."""
    wheels = scene.actuators.wheels or ()
    # What the wheels leave of the base must have inertia about every axis: I* = I - sum J g g'.
    least = 1.0 - scene.spread.base_inertia
    left = least * np.array(scene.base.inertia)
    for index, wheel in enumerate(wheels):
        axis = np.array(wheel.unit_axis)
        left -= wheel.inertia * np.outer(axis, axis)
        here = ("actuators", "wheels", index)
        if np.linalg.eigvalsh(left)[0] <= 0.0:
            sentence = "the wheels have as much inertia as the base, which includes theirs: lower it"
            yield Problem((*here, "inertia"), wheel.inertia, sentence)
            return
        if scene.base.motion == "planar" and any(wheel.axis[:2]):
            yield Problem((*here, "axis"), wheel.axis, 'base.motion is "planar": the axis must be along z')
    given = scene.initial_state.wheel_speeds
    if given and len(given) != len(wheels):
        sentence = f"must be {numbers_of(len(wheels))} (one per wheel); it has {len(given)}"
        yield Problem(("initial_state", "wheel_speeds"), given, sentence)
    for index, wheel in enumerate(wheels):
        fastest = abs(given[index] if index < len(given) else 0.0) + scene.spread.wheel_speeds
        if fastest > wheel.speed:
            sentence = (
                f"wheel {index + 1} starts at up to {fastest:g} rad/s with its spread; it must be at most "
                f"its largest speed, {wheel.speed:g} rad/s"
            )
            yield Problem(("initial_state", "wheel_speeds"), given, sentence)
            return
    if scene.spread.wheel_speeds and not wheels:
        yield Problem(
            ("spread", "wheel_speeds"), scene.spread.wheel_speeds, "must be 0: the scene has no wheels"
        )
