"""Constraints of a scene: what a maneuver must keep to besides the limits of its actuators.

Each becomes rows c(x, u, p) <= 0, or = 0 (`constraint_rows`). Frames are named: "inertial", "base" (e0), the
links (their joint frames), "tip" (G), "target" (the target's body) and "grasp" (D, where the tip is to be).
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.bodies import Link, freedoms
from dq_space_arm_env.validation.fields import (
    LENGTHS,
    Bounds,
    Flag,
    Limits,
    Limits3,
    Name,
    NonNegative,
    Position,
    Positive,
    Size,
    Three,
    read_numbers,
)
from dq_space_arm_env.validation.problems import Model, Problem, problem

Scene = Any  # `schema.Scene`, which has constraints

FRAMES = ("inertial", "base", "tip", "target", "grasp")
"""Frames of every scene; the others are the links."""

_FRAME = "inertial, base, a link, tip, target or grasp"
PER_LINK = "one number for all links, or one per link"
_PER_AXIS = "one number for all three axes, or three; .inf or absent: any"
_ONE_BY_ONE = "one number for all, or one for each; .inf or absent: any"


def _read_direction(value: Any) -> tuple[float, ...]:
    direction = read_numbers(value, 3, LENGTHS)
    if not math.hypot(*direction) > 0.0:
        raise problem("must not have zero length: it gives a direction")
    return direction


Direction = Annotated[Three, BeforeValidator(_read_direction)]


class Axis(Model):
    """A direction fixed in a frame."""

    frame: Name = Field(description=f"frame in which the direction is fixed: {_FRAME}")
    direction: Direction = Field(description="the direction in axes of the frame, of any length but zero")


class Point(Model):
    """A point fixed in a frame."""

    frame: Name = Field(description=f"frame in which the point is fixed: {_FRAME}")
    position: Position = Field(default=(0.0, 0.0, 0.0), description="the point in its frame, m")


class Volume(Model):
    """A sphere, or a capsule: all points within a radius of a segment."""

    frame: Name = Field(description=f"frame in which the volume is fixed: {_FRAME}")
    position: Position = Field(
        default=(0.0, 0.0, 0.0), description="center of the sphere, or one end of the segment, m"
    )
    to: Position | None = Field(
        default=None, description="the other end of the segment of a capsule, m; absent: a sphere"
    )
    radius: Size = Field(description="radius of the volume, m")

    @property
    def ends(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Both ends of the segment, m; equal for a sphere."""
        return self.position, self.position if self.to is None else self.to


class Constraint(Model):
    """What constraints of every kind have."""

    name: Name = Field(description="name of the constraint, unique in the scene")
    margin: NonNegative = Field(
        default=0.0,
        description="how far inside the constraint the expert stays, in the unit of the residual; the "
        "environment charges without it",
    )
    tolerance: Positive = Field(
        default=0.01,
        description="violation that costs 1 in the environment, in the unit of the residual",
    )
    terminates: Flag = Field(
        default=False, description="whether a violation beyond the tolerance ends the episode"
    )
    observed: Positive | None = Field(
        default=None,
        description="scale s of a further entry tanh(-c / s) of the observation per residual c, in its unit; "
        "absent: none",
    )

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """Names of the frames that it refers to, with their places."""
        yield from ()


class JointLimits(Constraint):
    """Least and greatest joint angles, and greatest joint rates; residuals in rad and rad/s (m and m/s).

    Joints of one coordinate have them: one number for all links passes over spherical and fixed ones.
    """

    kind: Literal["joint_limits"] = Field(description="'joint_limits'")
    lower: Bounds = Field(
        default=(-math.inf,), description=f"least joint angle, rad (m), -.inf for none: {PER_LINK}"
    )
    upper: Bounds = Field(
        default=(math.inf,), description=f"greatest joint angle, rad (m), .inf for none: {PER_LINK}"
    )
    rate: Bounds = Field(
        default=(math.inf,), description=f"greatest joint rate, rad/s (m/s), .inf for none: {PER_LINK}"
    )


class Distance(Constraint):
    """Volumes of bodies keep apart from obstacles; the residual is how deep they overlap, m."""

    kind: Literal["distance"] = Field(description="'distance'")
    bodies: tuple[Volume, ...] = Field(description="volumes that keep apart from each of the obstacles")
    obstacles: tuple[Volume, ...] = Field(description="volumes that each of the bodies keeps apart from")

    def _problems(self) -> Iterator[Problem]:
        for name in ("bodies", "obstacles"):
            if not getattr(self, name):
                yield Problem((name,), [], "must list at least one volume")

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """See `Constraint`."""
        for name in ("bodies", "obstacles"):
            for index, volume in enumerate(getattr(self, name)):
                yield (name, index, "frame"), volume.frame


class _Directions(Constraint):
    """An axis of a body against a direction."""

    axis: Axis = Field(description="axis of the instrument or panel")
    direction: Axis = Field(description="direction of the sun, the Earth, an antenna")
    angle_deg: Positive = Field(description="half angle of the cone about the direction, degrees, below 180")

    def _problems(self) -> Iterator[Problem]:
        yield from _angle_problems(self.angle_deg, 180.0)

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """See `Constraint`."""
        yield ("axis", "frame"), self.axis.frame
        yield ("direction", "frame"), self.direction.frame


class KeepOutDirection(_Directions):
    """An axis of a body stays out of a cone; the residual is a difference of cosines, dimensionless."""

    kind: Literal["keep_out_direction"] = Field(description="'keep_out_direction'")


class KeepInDirection(_Directions):
    """An axis of a body stays in a cone; the residual is a difference of cosines, dimensionless."""

    kind: Literal["keep_in_direction"] = Field(description="'keep_in_direction'")


class LineOfSight(Constraint):
    """A camera sees a point: it stays in the cone of the field of view; the residual is in m."""

    kind: Literal["line_of_sight"] = Field(description="'line_of_sight'")
    camera: Point = Field(description="center of the camera")
    boresight: Direction = Field(description="direction in which the camera looks, axes of its frame")
    angle_deg: Positive = Field(description="half angle of the field of view, degrees, below 90")
    point: Point = Field(description="what the camera sees")

    def _problems(self) -> Iterator[Problem]:
        yield from _angle_problems(self.angle_deg, 90.0)

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """See `Constraint`."""
        yield ("camera", "frame"), self.camera.frame
        yield ("point", "frame"), self.point.frame


class ApproachCorridor(Constraint):
    """A point stays in a cone that is fixed in a frame, the glide slope; the residual is in m."""

    kind: Literal["approach_corridor"] = Field(description="'approach_corridor'")
    apex: Point = Field(description="apex of the cone")
    direction: Direction = Field(description="axis of the cone from its apex outward, axes of its frame")
    angle_deg: Positive = Field(description="half angle of the cone, degrees, below 90")
    width: NonNegative = Field(
        default=0.0, description="radius of the corridor at the apex, where the cone is cut off, m"
    )
    point: Point = Field(default=Point(frame="tip"), description="what stays in the corridor")

    def _problems(self) -> Iterator[Problem]:
        yield from _angle_problems(self.angle_deg, 90.0)

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """See `Constraint`."""
        yield ("apex", "frame"), self.apex.frame
        yield ("point", "frame"), self.point.frame


class Plume(Constraint):
    """The gas of the thrusters, which leaves against their forces, misses a sphere; residual in N.

    The gas of `actuators.base_force` leaves against the net force at one place, that of each of
    `actuators.thrusters` at its own place and in its own direction.
    """

    kind: Literal["plume"] = Field(description="'plume'")
    thruster: Position = Field(
        default=(0.0, 0.0, 0.0), description="where the gas of base_force leaves, in the base frame, m"
    )
    angle_deg: Positive = Field(description="half angle of the plume, degrees, below 90")
    keeps_clear: Volume = Field(description="sphere that no gas may reach, outside of the thruster")

    def _problems(self) -> Iterator[Problem]:
        yield from _angle_problems(self.angle_deg, 90.0)
        if self.keeps_clear.to is not None:
            yield Problem(
                ("keeps_clear", "to"), self.keeps_clear.to, "must be absent: a sphere is kept clear"
            )

    def frames(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """See `Constraint`."""
        yield ("keeps_clear", "frame"), self.keeps_clear.frame


class Momentum(Constraint):
    """Greatest momentum and energy of robot and payload; residuals in N s, N m s, J."""

    kind: Literal["momentum"] = Field(description="'momentum'")
    linear: Positive | None = Field(default=None, description="greatest linear momentum, N s; absent: any")
    angular: Positive | None = Field(
        default=None, description="greatest angular momentum about the center of mass, N m s; absent: any"
    )
    energy: Positive | None = Field(
        default=None, description="greatest kinetic energy with that of joint springs, N m; absent: any"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.linear is None and self.angular is None and self.energy is None:
            yield Problem((), {}, "must bound at least one of linear, angular, energy")


class WheelMomentum(Constraint):
    """What the wheels of a robot without thrusters store, base axes, N m s.

    No external wrench acts, so the total angular momentum stays zero: the wheels, at rest at the start, store
    the negative of what the bodies have.
    """

    kind: Literal["wheel_momentum"] = Field(description="'wheel_momentum'")
    capacity: Positive = Field(description="greatest momentum about each axis of the base, N m s")


class WheelLimits(Constraint):
    """Wheels stay below their largest speeds and powers; residuals in rad/s and W."""

    kind: Literal["wheel_limits"] = Field(description="'wheel_limits'")


class Propellant(Constraint):
    """Something is left in the tank at the end of each step; residual in kg."""

    kind: Literal["propellant"] = Field(description="'propellant'")
    reserve: NonNegative = Field(default=0.0, description="least mass of the propellant that is left, kg")


class ControlRate(Constraint):
    """Greatest change of controls per second, from step to step; residuals in N, N m, rad/s.

    The first step counts against `initial_state.previous_controls`. Those controls become part of the state.
    """

    kind: Literal["control_rate"] = Field(description="'control_rate'")
    base_force: Limits3 | None = Field(
        default=None, description=f"greatest rate of the base force, N/s: {_PER_AXIS}"
    )
    base_torque: Limits3 | None = Field(
        default=None, description=f"greatest rate of the base torque, N m/s: {_PER_AXIS}"
    )
    joint_torque: Limits | None = Field(
        default=None, description=f"greatest rate of joint torques, N m/s: {PER_LINK}; .inf or absent: any"
    )
    wrist_rate: Limits3 | None = Field(
        default=None, description=f"greatest rate of the wrist's rates, rad/s^2: {_PER_AXIS}"
    )
    wheels: Limits | None = Field(
        default=None, description=f"greatest rate of the torques of wheels, N m/s: {_ONE_BY_ONE}"
    )
    thrusters: Limits | None = Field(
        default=None, description=f"greatest rate of the forces of thrusters, N/s: {_ONE_BY_ONE}"
    )


class TorqueSpeed(Constraint):
    """What full voltage leaves of the torque of motors with a `stall_torque`; residuals in N m (N).

    Environments clip torques to it, with or without this constraint, by which the expert knows it.
    """

    kind: Literal["torque_speed"] = Field(description="'torque_speed'")


class Terminal(Constraint):
    """Quantities that are exact at the end: equalities in rad, m, rad/s, m/s, N s, N m s."""

    kind: Literal["terminal"] = Field(description="'terminal'")
    exact: tuple[Literal["pose", "twist", "base_velocity", "linear_momentum", "angular_momentum"], ...] = (
        Field(
            description="pose: of the tip, relative to the grasp; twist: of the tip relative to the target "
            "with the wrist held; base_velocity: relative to target.base_velocity; linear_momentum and "
            "angular_momentum of robot and payload: zero"
        )
    )

    def _problems(self) -> Iterator[Problem]:
        if not self.exact or len(set(self.exact)) < len(self.exact):
            yield Problem(("exact",), self.exact, "must list at least one quantity, and each once")


_KINDS: dict[str, type[Constraint]] = {
    "joint_limits": JointLimits,
    "distance": Distance,
    "keep_out_direction": KeepOutDirection,
    "keep_in_direction": KeepInDirection,
    "line_of_sight": LineOfSight,
    "approach_corridor": ApproachCorridor,
    "plume": Plume,
    "momentum": Momentum,
    "wheel_momentum": WheelMomentum,
    "wheel_limits": WheelLimits,
    "propellant": Propellant,
    "control_rate": ControlRate,
    "torque_speed": TorqueSpeed,
    "terminal": Terminal,
}


def _read_constraint(value: Any) -> Any:
    """Read a constraint by its kind."""
    if isinstance(value, Constraint):
        return value
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        wanted = f"must be a mapping whose kind is one of {', '.join(_KINDS)}"
        raise problem(did_you_mean(str(kind), _KINDS, wanted))
    return _KINDS[kind].model_validate(value)


AnyConstraint = Annotated[
    JointLimits
    | Distance
    | KeepOutDirection
    | KeepInDirection
    | LineOfSight
    | ApproachCorridor
    | Plume
    | Momentum
    | WheelMomentum
    | WheelLimits
    | Propellant
    | ControlRate
    | TorqueSpeed
    | Terminal,
    BeforeValidator(_read_constraint),
]


def _angle_problems(angle: float, most: float) -> Iterator[Problem]:
    if angle >= most:
        yield Problem(("angle_deg",), angle, f"must be below {most:g} degrees")


def limited_motors(scene: Scene) -> list[tuple[int, Link]]:
    """The driven links whose motors have a torque that falls with their speed.

    Args:
        scene: The scene.

    Returns:
        Index among the driven degrees of freedom, and link.
    """
    moving = [scene.links[index] for index, _ in freedoms(scene.links)]
    driven = [link for link in moving if link.actuated] if scene.actuators.joint_torque else []
    return [(index, link) for index, link in enumerate(driven) if link.motor and link.motor.stall_torque]


def per_link(bounds: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Bounds of each link.

    Args:
        bounds: One number for all links, or one per link.
        count: Number of links.

    Returns:
        So many numbers.
    """
    return bounds * count if len(bounds) == 1 else bounds
