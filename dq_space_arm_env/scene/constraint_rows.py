"""Names of the rows c(x, u, p) <= 0 or = 0 of a scene's constraints; environments read them without CasADi.

The residuals are in `task.constraint_residuals` and `task.terminal_residuals`, in the same order. Path rows
hold at every stage, those without the input at the end too. Terminal rows hold at the end: those, success,
and what is exact.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraints import (
    Constraint,
    ControlRate,
    Distance,
    JointLimits,
    Momentum,
    Plume,
    Propellant,
    Terminal,
    TorqueSpeed,
    Volume,
    WheelLimits,
    WheelMomentum,
    limited_motors,
    per_link,
)
from dq_space_arm_env.scene.parameters import control_numbers, thruster_names, wheel_names
from dq_space_arm_env.scene.pose import PLANAR_TWIST

Scene = Any  # `schema.Scene`
AXES = ("x", "y", "z")


class Row(NamedTuple):
    """A row of a constraint."""

    name: str  # of the constraint, and what it is about
    unit: str  # of the residual, "1" for dimensionless
    tolerance: float  # violation that costs 1
    margin: float = 0.0  # that the expert adds to the residual
    terminates: bool = False  # whether a violation beyond the tolerance ends an episode
    observed: float | None = None  # scale of its entry in the observation, in its unit
    is_equality: bool = False
    has_input: bool = False
    is_rate: bool = False  # of a control: the expert keeps to it by the bounds of its inputs


class RateLimit(NamedTuple):
    """A limit of a control's rate."""

    control: int  # its index
    name: str  # of the control
    unit: str  # of the control
    rate: float  # its unit per second


class Side(NamedTuple):
    """A bound of a joint's angle or rate: sign * value - bound <= 0."""

    link: int
    joint: int  # among the degrees of freedom
    is_rate: bool
    sign: float
    bound: float


def path_rows(scene: Scene) -> tuple[Row, ...]:
    """The rows that hold along the path.

    Args:
        scene: The scene.

    Returns:
        One row per residual of `task.constraint_residuals.path_residuals`.
    """
    return tuple(row for each in scene.constraints for row in rows_of(scene, each))


def penalized_rows(scene: Scene) -> tuple[Row, ...]:
    """The rows of `path_rows` that the expert keeps to by penalties, not by the bounds of its inputs."""
    return tuple(row for row in path_rows(scene) if not row.is_rate)


def rows_of(scene: Scene, each: Constraint) -> list[Row]:
    """The rows of `path_rows` that one constraint has."""
    common = each.tolerance, each.margin, each.terminates, each.observed
    rows: list[Row] = []
    if isinstance(each, JointLimits):
        for side in sides(scene, each):
            words = ("rate " if side.is_rate else "") + ("upper" if side.sign > 0 else "lower")
            link = scene.links[side.link]
            unit = f"{link.unit}/s" if side.is_rate else link.unit
            rows.append(Row(f"{each.name}: {link.name} {words}", unit, *common))
    elif isinstance(each, Distance):
        pairs = pairs_that_may_touch(scene, each)
        found = [f"{each.name}: {a.frame} {i} to {b.frame} {j}" for i, a, j, b in pairs]
        rows += [Row(name, "m", *common) for name in found]
    elif isinstance(each, Momentum):
        bounded = {"linear": "N s", "angular": "N m s", "energy": "J"}
        found = [name for name in bounded if getattr(each, name) is not None]
        rows += [Row(f"{each.name}: {name}", bounded[name], *common) for name in found]
    elif isinstance(each, WheelMomentum):
        axes = AXES[2:] if scene.base.motion == "planar" else AXES
        names = [f"{each.name}: {sign}{axis}" for axis in axes for sign in "+-"]
        rows += [Row(name, "N m s", *common) for name in names]
    elif isinstance(each, WheelLimits):
        for which, wheel in zip(wheel_names(scene), scene.actuators.wheels, strict=True):
            start = f"{each.name}: {which}"
            if math.isfinite(wheel.speed):
                rows += [Row(f"{start} speed {sign}", "rad/s", *common) for sign in "-+"]
            if math.isfinite(wheel.power):
                unseen = *common[:3], None
                rows += [Row(f"{start} power {sign}", "W", *unseen, has_input=True) for sign in "-+"]
    elif isinstance(each, Propellant):
        rows.append(Row(each.name, "kg", *common, has_input=True))
    elif isinstance(each, ControlRate):
        for limit in rate_limits(scene, each):
            names = [f"{each.name}: {limit.name} {word}" for word in ("falls", "rises")]
            rows += [Row(name, limit.unit, *common, has_input=True, is_rate=True) for name in names]
    elif isinstance(each, TorqueSpeed):
        for _, link in limited_motors(scene):
            for words in ("backward", "forward"):
                rows.append(
                    Row(f"{each.name}: {link.name} {words}", link.effort_unit, *common, has_input=True)
                )
    elif isinstance(each, Plume):
        names = [f"{each.name}: {thruster}" for thruster in thruster_names(scene)]
        names = [each.name, *names] if scene.actuators.base_force is not None else names
        rows += [Row(name, "N", *common, has_input=True) for name in names]
    elif not isinstance(each, Terminal):
        is_length = hasattr(each, "point")  # line of sight and corridor; the others compare cosines
        rows.append(Row(each.name, "m" if is_length else "1", *common))
    return rows


def success_tolerances(scene: Scene) -> list[tuple[str, str, float]]:
    """What success asks of each tip at the end.

    Args:
        scene: The scene.

    Returns:
        Names of the errors, their units, and their tolerances, rad, m, rad/s, m/s.
    """
    success = scene.success
    turning = success.angular_velocity_error_deg
    tolerances = (
        ("attitude error", "rad", math.radians(success.attitude_error_deg)),
        ("position error", "m", success.position_error),
        ("angular velocity error", "rad/s", None if turning is None else math.radians(turning)),
        ("velocity error", "m/s", success.velocity_error),
    )
    return [(name, unit, tolerance) for name, unit, tolerance in tolerances if tolerance is not None]


EXACT = {
    "pose": (("rad", "m"), "tip"),
    "twist": (("rad/s", "m/s"), "tip twist"),
    "base_velocity": (("rad/s", "m/s"), "base velocity"),
    "linear_momentum": (("N s",), "linear momentum"),
    "angular_momentum": (("N m s",), "angular momentum"),
}
"""Units and names of what may be exact at the end; by field of `Terminal.exact`."""


def directions(scene: Scene, quantity: str) -> tuple[int, ...]:
    """Entries of a quantity of `Terminal.exact` that a scene does not keep at zero anyway."""
    whole = range(3 * len(EXACT[quantity][0]))
    if scene.base.motion != "planar":
        return tuple(whole)
    if len(whole) == 6:
        return PLANAR_TWIST
    return (2,) if quantity == "angular_momentum" else (0, 1)


def exact_rows(scene: Scene) -> tuple[Row, ...]:
    """The rows of what is exact at the end.

    Args:
        scene: The scene.

    Returns:
        The last rows of `terminal_rows`.
    """
    return tuple(row for row in terminal_rows(scene) if row.is_equality)


def _final_rows(scene: Scene) -> tuple[Row, ...]:
    """The rows that hold at the end besides those of the path."""
    rows = [
        Row(f"success: {tip}{name}", unit, tolerance, margin=1e-3 * tolerance)
        for tip in ("", *(f"{tip.name} " for tip in scene.other_tips))
        for name, unit, tolerance in success_tolerances(scene)
    ]
    for each in scene.constraints:
        for quantity in each.exact if isinstance(each, Terminal) else ():
            units, words = EXACT[quantity]
            for index in directions(scene, quantity):
                name = f"{each.name}: {words} {AXES[index % 3]}"
                unit = units[index // 3]
                if len(units) > 1:
                    name = f"{each.name}: {words} {'angular' if index < 3 else 'linear'} {AXES[index % 3]}"
                rows.append(Row(name, unit, each.tolerance, is_equality=True))
    return tuple(rows)


def terminal_rows(scene: Scene) -> tuple[Row, ...]:
    """The rows that hold at the end: those of the path without the input, success, what is exact.

    Args:
        scene: The scene.

    Returns:
        One row per residual of `task.terminal_residuals.terminal_residuals`.
    """
    return (*(row for row in path_rows(scene) if not row.has_input), *_final_rows(scene))


def n_multipliers(scene: Scene) -> int:
    """Multipliers of a stage: as many as the path, or the end, has rows.

    Args:
        scene: The scene.

    Returns:
        The number.
    """
    return max(len(penalized_rows(scene)), len(terminal_rows(scene)))


def sides(scene: Scene, limits: JointLimits) -> Iterator[Side]:
    """The finite bounds of joints."""
    count = len(scene.links)
    lower, upper, rate = (per_link(each, count) for each in (limits.lower, limits.upper, limits.rate))
    for joint, (link, _) in enumerate(freedoms(scene.links)):
        if scene.links[link].is_spherical:
            continue
        for is_rate, sign, bound in (
            (False, -1.0, -lower[link]),
            (False, 1.0, upper[link]),
            (True, -1.0, rate[link]),
            (True, 1.0, rate[link]),
        ):
            if math.isfinite(bound):
                yield Side(link, joint, is_rate, sign, bound)


def rate_limits(scene: Scene, each: ControlRate) -> list[RateLimit]:
    """The controls whose rates a constraint limits, in their order."""
    found, index = [], 0
    for field, numbers in control_numbers(scene).items():
        for number, rate in zip(numbers, _rates(scene, each, field, len(numbers)), strict=True):
            if math.isfinite(rate):
                found.append(RateLimit(index, number.name, number.limit.unit, rate))
            index += 1
    return found


def _rates(scene: Scene, each: ControlRate, field: str, count: int) -> list[float]:
    """Greatest rates of the controls of an actuator."""
    given = getattr(each, {"wheel_torque": "wheels", "thruster_force": "thrusters"}.get(field, field))
    if given is None:
        return [math.inf] * count
    if field == "joint_torque":
        rates = per_link(given, len(scene.links))
        return [rates[index] for index, _ in freedoms(scene.links) if scene.links[index].actuated]
    if scene.base.motion == "planar" and field in ("base_force", "base_torque"):
        given = given[:2] if field == "base_force" else given[2:]
    return list(per_link(given, count))


def slew_limits(scene: Scene) -> list[RateLimit]:
    """How fast actuators follow at most, which environments see to.

    Args:
        scene: The scene.

    Returns:
        The controls with a limit, in their order.
    """
    found, index = [], 0
    for field, numbers in control_numbers(scene).items():
        for number in numbers:
            rate = getattr(getattr(scene.actuators, field, None), "slew_limit", None)
            if rate is not None:
                found.append(RateLimit(index, number.name, number.limit.unit, rate))
            index += 1
    return found


def previous_controls(scene: Scene) -> tuple[int, ...]:
    """Indices of the controls that the state keeps for a step: those whose rates are limited.

    Args:
        scene: The scene.

    Returns:
        One index per entry `StateEntries.previous_controls`, in their order.
    """
    return tuple(limit.control for limit in rates_of(scene))


def rates_of(scene: Scene) -> tuple[RateLimit, ...]:
    """What limits the controls of `previous_controls`, each less its margin per step.

    Args:
        scene: The scene.

    Returns:
        The strictest limit of each.
    """
    found = {limit.control: limit for limit in slew_limits(scene)}
    for each in scene.constraints:
        for limit in rate_limits(scene, each) if isinstance(each, ControlRate) else ():
            kept = limit._replace(rate=max(limit.rate - each.margin / scene.simulation.dt, 0.0))
            found[limit.control] = min(found.get(limit.control, kept), kept, key=lambda known: known.rate)
    return tuple(found[control] for control in sorted(found))


def pairs_that_may_touch(scene: Scene, constraint: Distance) -> list[tuple[int, Volume, int, Volume]]:
    """Bodies and obstacles, with their numbers, that the joints may bring together.

    Others need no row: volumes fixed to each other, and volumes of the robot out of each other's reach.
    """
    return [
        (i, body, j, obstacle)
        for i, body in enumerate(constraint.bodies)
        for j, obstacle in enumerate(constraint.obstacles)
        if _may_touch(scene, body, obstacle)
    ]


_MOVES_WITH_TARGET = ("target", "grasp")


def _may_touch(scene: Scene, a: Volume, b: Volume) -> bool:
    if a.frame == b.frame or (a.frame in _MOVES_WITH_TARGET and b.frame in _MOVES_WITH_TARGET):
        return False
    names = ["base", *(link.name for link in scene.links), "tip"]
    if a.frame not in names or b.frame not in names:
        return True
    near, far = sorted((a, b), key=lambda volume: names.index(volume.frame))
    up, down = (_path_to(scene, names.index(volume.frame)) for volume in (near, far))
    shared = sum(1 for one, other in zip(up, down, strict=False) if one == other)
    up, down = up[shared:], down[shared:]  # frames below the body that carries both
    moving = [scene.links[frame - 1] for frame in (*up, *down) if frame <= len(scene.links)]
    if all(link.is_fixed for link in moving) and (scene.wrist is None or far.frame != "tip"):
        return False  # one is fixed in the other's body
    if not all(link.joint_type in ("revolute", "spherical", "fixed") for link in moving):
        return True  # one slides as far as it may
    # In the frame of the near volume, the far one is within its reach of the origin of the next frame.
    lengths = [math.hypot(*_origin(scene, frame)) for frame in (*up[1:], *down[1:])]
    first = _origin(scene, down[0])
    if up:  # the next frame is the near one's own, at whose origin it turns
        lengths.append(math.dist(_origin(scene, up[0]), first))
        first = (0.0, 0.0, 0.0)
    reach = sum(lengths) + (math.hypot(*scene.tip.position) if scene.wrist and far.frame == "tip" else 0.0)
    reach += max(math.hypot(*end) for end in far.ends) + near.radius + far.radius
    return _distance_to_segment(first, *near.ends) <= reach


def _path_to(scene: Scene, frame: int) -> list[int]:
    """Frames from the base, 0, to one of a link, i + 1, or of the tip, the last; without the base."""
    path: list[int] = []
    while frame:
        path.insert(0, frame)
        frame = scene.tip_body if frame > len(scene.links) else scene.parent_bodies[frame - 1]
    return path


def _origin(scene: Scene, frame: int) -> tuple[float, ...]:
    """Origin of such a frame in the one before it; of the tip's that of the wrist, where there is one."""
    if frame <= len(scene.links):
        return tuple(scene.links[frame - 1].joint.position)
    return tuple(scene.tip.position if scene.wrist is None else scene.wrist.frame.position)


def _distance_to_segment(point: tuple[float, ...], start: tuple[float, ...], end: tuple[float, ...]) -> float:
    along = [b - a for a, b in zip(start, end, strict=True)]
    offset = [p - a for p, a in zip(point, start, strict=True)]
    length = sum(entry * entry for entry in along)
    share = sum(a * b for a, b in zip(along, offset, strict=True)) / length if length else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.hypot(*(o - share * a for o, a in zip(offset, along, strict=True)))
