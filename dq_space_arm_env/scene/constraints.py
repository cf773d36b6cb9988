"""Constraints of a scene: what a maneuver must keep to besides the limits of its actuators.

Each becomes rows c(x, u, p) <= 0, or = 0 (`constraint_rows`). Frames are named: "inertial", "base" (e0), the
links (their joint frames), "tip" (G), "target" (the target's body) and "grasp" (D, where the tip is to be).
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, StrictBool

from dq_space_arm_env.scene.bodies import Link, freedoms
from dq_space_arm_env.validation.fields import (
    ANGLES,
    LENGTHS,
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
_PER_LINK = "one number for all links, or one per link"
_PER_AXIS = "one number for all three axes, or three; .inf or absent: any"
_ONE_BY_ONE = "one number for all, or one for each; .inf or absent: any"


def _read_bounds(value: Any) -> tuple[float, ...]:
    """Read one bound, or one per link; infinite ones bound nothing."""
    items = value if isinstance(value, list | tuple) else [value]
    if not items or any(isinstance(item, bool) or not isinstance(item, int | float) for item in items):
        raise problem(f"must be numbers, .inf for none: {_PER_LINK}")
    bounds = tuple(float(item) + 0.0 for item in items)
    if any(math.isnan(bound) for bound in bounds):
        raise problem(f"must be numbers, .inf for none: {_PER_LINK}")
    ANGLES.check(*bounds)
    return bounds


def _read_direction(value: Any) -> tuple[float, ...]:
    direction = read_numbers(value, 3, LENGTHS)
    if not math.hypot(*direction) > 0.0:
        raise problem("must not have zero length: it gives a direction")
    return direction


Bounds = Annotated[tuple[float, ...], BeforeValidator(_read_bounds)]
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

    default_tolerance: ClassVar[float] = 0.01

    name: Name = Field(description="name of the constraint, unique in the scene")
    margin: NonNegative = Field(
        default=0.0,
        description="how far inside the constraint the expert stays, in the unit of the residual; the "
        "environment charges without it",
    )
    tolerance: Positive = Field(
        default=default_tolerance,
        description="violation that costs 1 in the environment, in the unit of the residual",
    )
    terminates: StrictBool = Field(
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
    """Least and greatest joint angles, and greatest joint rates; residuals in rad and rad/s."""

    kind: Literal["joint_limits"] = Field(description="'joint_limits'")
    lower: Bounds = Field(
        default=(-math.inf,), description=f"least joint angle, rad, -.inf for none: {_PER_LINK}"
    )
    upper: Bounds = Field(
        default=(math.inf,), description=f"greatest joint angle, rad, .inf for none: {_PER_LINK}"
    )
    rate: Bounds = Field(
        default=(math.inf,), description=f"greatest joint rate, rad/s, .inf for none: {_PER_LINK}"
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
        default=None, description=f"greatest rate of joint torques, N m/s: {_PER_LINK}; .inf or absent: any"
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
        raise problem(f"must be a mapping whose kind is one of {', '.join(_KINDS)}")
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


def constraint_problems(scene: Scene) -> Iterator[Problem]:
    """Find constraints that do not fit the scene."""
    links = [link.name for link in scene.links]
    known = (*FRAMES[:2], *links, *(tip.name for tip in scene.other_tips), *FRAMES[2:])
    names_frames = any(True for constraint in scene.constraints for _ in constraint.frames())
    for name in links:
        if name in FRAMES and names_frames:
            place = ("links", links.index(name), "name")
            yield Problem(place, name, "is a frame of every scene, which constraints name: rename the link")
    names = [constraint.name for constraint in scene.constraints]
    for index, constraint in enumerate(scene.constraints):
        here: tuple[str | int, ...] = ("constraints", index)
        if constraint.name in names[:index]:
            yield Problem((*here, "name"), constraint.name, "another constraint has this name")
        for place, frame in constraint.frames():
            if frame not in known:
                yield Problem((*here, *place), frame, f"must be one of {', '.join(known)}")
        if isinstance(constraint, JointLimits):
            yield from _joint_limit_problems(scene, here, constraint)
        elif isinstance(constraint, Plume) and not _has_thrusters(scene):
            yield Problem((*here, "kind"), constraint.kind, "the scene has no thrusters: remove it")
        elif isinstance(constraint, WheelMomentum):
            yield from _wheel_problems(scene, (*here, "kind"))
        elif isinstance(constraint, WheelLimits) and not _has_wheel_limits(scene):
            sentence = "the scene's wheels have no largest speed or power: remove it"
            yield Problem((*here, "kind"), constraint.kind, sentence)
        elif isinstance(constraint, Propellant):
            yield from _propellant_problems(scene, here, constraint)
        elif isinstance(constraint, ControlRate):
            yield from _control_rate_problems(scene, here, constraint)
        elif isinstance(constraint, TorqueSpeed) and not limited_motors(scene):
            sentence = "no motor that drives a joint has a stall_torque: remove it"
            yield Problem((*here, "kind"), constraint.kind, sentence)
        if (
            isinstance(constraint, Plume | Propellant | ControlRate | TorqueSpeed | Terminal)
            and constraint.observed is not None
        ):
            sentence = "must be absent: a residual with the input, or of the end, is not observed"
            yield Problem((*here, "observed"), constraint.observed, sentence)
        if isinstance(constraint, Terminal) and constraint.terminates:
            yield Problem((*here, "terminates"), True, "must be false: it holds at the end only")


def _joint_limit_problems(
    scene: Scene, here: tuple[str | int, ...], limits: JointLimits
) -> Iterator[Problem]:
    count = len(scene.links)
    for field in ("lower", "upper", "rate"):
        given = getattr(limits, field)
        if len(given) not in (1, count):
            yield Problem((*here, field), given, f"must be {_PER_LINK}: the scene has {count} links")
            return
    for field in ("lower", "upper", "rate"):
        given = getattr(limits, field)
        for link, bound in zip(scene.links, given if len(given) == count else (), strict=False):
            if link.freedoms != 1 and count > 1 and math.isfinite(bound):
                sentence = f"link {link.name!r} must have none, its joint is {link.joint_type}: .inf"
                yield Problem((*here, field), given, sentence)
    lower, upper, rate = (per_link(getattr(limits, field), count) for field in ("lower", "upper", "rate"))
    if not any(math.isfinite(bound) for bound in (*lower, *upper, *rate)):
        yield Problem(
            here, limits, "must bound something: all its bounds are infinite, or there are no links"
        )
    for index in range(count):
        if not lower[index] < upper[index]:
            sentence = f"must be above the lower limit of link {index}, {lower[index]:g} rad"
            yield Problem((*here, "upper"), upper[index], sentence)
        if not rate[index] > 0.0:
            yield Problem((*here, "rate"), rate[index], "must be greater than 0")


def _propellant_problems(
    scene: Scene, here: tuple[str | int, ...], constraint: Propellant
) -> Iterator[Problem]:
    tank = scene.actuators.tank
    if tank is None:
        yield Problem((*here, "kind"), constraint.kind, "the scene has no actuators.tank: remove it")
    elif constraint.reserve >= tank.propellant:
        sentence = f"must be below the propellant at the start, {tank.propellant:g} kg"
        yield Problem((*here, "reserve"), constraint.reserve, sentence)


def _control_rate_problems(
    scene: Scene, here: tuple[str | int, ...], constraint: ControlRate
) -> Iterator[Problem]:
    actuators = scene.actuators
    counts = {
        "base_force": 3,
        "base_torque": 3,
        "joint_torque": len(scene.links),
        "wrist_rate": 3,
        "wheels": len(actuators.wheels or ()),
        "thrusters": len(actuators.thrusters or ()),
    }
    given = {field: getattr(constraint, field) for field in counts if getattr(constraint, field) is not None}
    if not any(math.isfinite(rate) for rates in given.values() for rate in rates):
        yield Problem(here, constraint, f"must limit at least one of {', '.join(counts)}")
    for field, rates in given.items():
        if getattr(actuators, field) is None:
            yield Problem((*here, field), rates, f"must be absent: the scene has no actuators.{field}")
        elif len(rates) not in (1, counts[field]):
            sentence = f"must be one number, or {counts[field]}: one for each"
            yield Problem((*here, field), rates, sentence)


def _has_thrusters(scene: Scene) -> bool:
    return scene.actuators.base_force is not None or scene.actuators.thrusters is not None


def _has_wheel_limits(scene: Scene) -> bool:
    return any(math.isfinite(min(wheel.speed, wheel.power)) for wheel in scene.actuators.wheels or ())


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


def _wheel_problems(scene: Scene, place: tuple[str | int, ...]) -> Iterator[Problem]:
    """Find what would change the total angular momentum, or have it differ from zero at the start."""
    if scene.actuators.wheels is not None:
        sentence = "is for the ideal actuators.base_torque: limit wheels by the kind wheel_limits"
        yield Problem(place, "wheel_momentum", sentence)
        return
    start, spread = scene.initial_state, scene.spread
    velocities = (*start.base_velocity, *start.joint_rates)
    velocities += (spread.base_angular_velocity, spread.base_linear_velocity, spread.joint_rates)
    catches = any(phase.catch is not None for phase in scene.phases)
    reasons = {
        "the scene has no wheels": scene.actuators.base_torque is None,
        "thrusters change the total momentum": _has_thrusters(scene),
        "a wrench at the tip changes the total momentum": scene.tip_wrench is not None,
        "a catch changes the total momentum": catches,
        "the start is not at rest": any(velocities),
    }
    for reason, holds in reasons.items():
        if holds:
            yield Problem(place, "wheel_momentum", f"what the wheels store is not known: {reason}")


def per_link(bounds: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Bounds of each link.

    Args:
        bounds: One number for all links, or one per link.
        count: Number of links.

    Returns:
        So many numbers.
    """
    return bounds * count if len(bounds) == 1 else bounds
