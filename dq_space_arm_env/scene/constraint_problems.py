"""What a scene's constraints get wrong about the scene: frames, actuators, joints that it does not have."""

import math
from collections.abc import Iterator
from typing import Any

from dq_space_arm_env.scene.constraints import (
    FRAMES,
    PER_LINK,
    ControlRate,
    JointLimits,
    Plume,
    Propellant,
    Terminal,
    TorqueSpeed,
    WheelLimits,
    WheelMomentum,
    limited_motors,
    per_link,
)
from dq_space_arm_env.scene.phases import phases_change_masses
from dq_space_arm_env.validation.problems import Problem

Scene = Any  # `schema.Scene`, which has constraints


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
            yield Problem((*here, field), given, f"must be {PER_LINK}: the scene has {count} links")
            return
    for field in ("lower", "upper", "rate"):
        given = getattr(limits, field)
        for link, bound in zip(scene.links, given if len(given) == count else (), strict=False):
            if link.freedoms != 1 and count > 1 and math.isfinite(bound):
                sentence = f"link {link.name!r} must have none, its joint is {link.joint_type}: .inf"
                yield Problem((*here, field), given, sentence)
    lower, upper, rate = (per_link(getattr(limits, field), count) for field in ("lower", "upper", "rate"))
    bounds = zip(scene.links, lower, upper, rate, strict=True)
    if not any(math.isfinite(bound) for link, *own in bounds if link.freedoms == 1 for bound in own):
        sentence = "must bound something: all its bounds are infinite, or no joint has one coordinate"
        yield Problem(here, limits, sentence)
    if not count:
        return
    written = max(len(getattr(limits, field)) for field in ("lower", "upper", "rate"))
    for index in range(written):  # one number for all links is one mistake
        if not lower[index] < upper[index]:
            least = f"{lower[index]:g} {scene.links[index].unit}"
            sentence = f"must be above the lower limit of link {index}, {least}"
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
        "phases change masses": phases_change_masses(scene),
        "the start is not at rest": any(velocities),
    }
    for reason, holds in reasons.items():
        if holds:
            yield Problem(place, "wheel_momentum", f"what the wheels store is not known: {reason}")
