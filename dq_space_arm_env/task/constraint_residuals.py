"""Residuals of a scene's constraints along the path, in the order of `scene.constraint_rows`.

A residual holds where it is at most zero; it is smooth but for distances between segments, whose closest
points may jump where the segments are parallel. In cones |v| is sqrt(v . v + e^2) - e, with
e = `SMALLEST_LENGTH`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import casadi

from dq_space_arm_env.algebra.scalars import select, sqrt
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    dot,
    matrix_vector,
    scale,
    subtract,
)
from dq_space_arm_env.dynamics import reaction_wheels
from dq_space_arm_env.scene.constraint_rows import (
    directions,
    pairs_that_may_touch,
    path_rows,
    rate_limits,
    sides,
)
from dq_space_arm_env.scene.constraints import (
    ApproachCorridor,
    Constraint,
    ControlRate,
    Distance,
    JointLimits,
    KeepInDirection,
    KeepOutDirection,
    LineOfSight,
    Momentum,
    Plume,
    Propellant,
    TorqueSpeed,
    Volume,
    WheelLimits,
    WheelMomentum,
)
from dq_space_arm_env.task.equations import SceneEquations, torque_ranges
from dq_space_arm_env.task.situation import Situation

Scalar = Any
Scalars = Sequence[Scalar]

SMALLEST_LENGTH = 1e-3
"""Length, m, by which a cone is wider at its apex, where its residual is rounded off."""
_ROUNDING = {"float64": 1e-12, "float32": 1e-6}
"""More than what rounding takes off 1 - sin^2, or leaves of it, where that is 0."""
MEETING = 1e-4
"""Distance, m, that stands for none between centers or axes of volumes."""


def path_residuals(equations: SceneEquations, base: Scalars, y: Scalars, u: Scalars) -> list[Scalar]:
    """Residuals of the path's rows.

    Args:
        equations: The scene's, with the parameters of the stage.
        base: Pose of the base q_{e0/I}, 8 scalars.
        y: The state without the pose.
        u: Input, n_u scalars.

    Returns:
        One scalar per row of `path_rows`.
    """
    situation = Situation(equations, base, y, u)
    return [
        residual
        for constraint in equations.scene.constraints
        if type(constraint) in _RESIDUALS
        for residual in _RESIDUALS[type(constraint)](situation, constraint)
    ]


def penalized_residuals(equations: SceneEquations, base: Scalars, y: Scalars, u: Scalars) -> list[Scalar]:
    """Those of `path_residuals` that the expert penalizes."""
    residuals = path_residuals(equations, base, y, u)
    rows = path_rows(equations.scene)
    return [residual for residual, row in zip(residuals, rows, strict=True) if not row.is_rate]


def state_residuals(equations: SceneEquations, base: Scalars, y: Scalars) -> list[Scalar]:
    """Those of `path_residuals` that have no input."""
    residuals = path_residuals(equations, base, y, [0.0] * equations.field.n_u)
    rows = path_rows(equations.scene)
    return [residual for residual, row in zip(residuals, rows, strict=True) if not row.has_input]


def observed_besides(equations: SceneEquations, base: Scalars, y: Scalars) -> list[Scalar]:
    """What is observed besides state and target: errors of other tips, and margins tanh(-c / scale).

    The error poses have a positive scalar: q and -q are the same.

    Args:
        equations: The scene's, with the parameters of the stage.
        base: Pose of the base q_{e0/I}, 8 scalars.
        y: The state without the pose.

    Returns:
        The stored numbers of a pose per other tip, and one per row of `path_rows` that is observed.
    """
    found: list[Scalar] = []
    for error in equations.other_errors(base, y):
        sign = select(error[0] < 0.0, -1.0, 1.0)
        found += [sign * entry for entry in equations.field.pose.reduced(error)]
    rows = [row for row in path_rows(equations.scene) if not row.has_input]
    if all(row.observed is None for row in rows):
        return found
    residuals = zip(state_residuals(equations, base, y), rows, strict=True)
    return found + [casadi.tanh(-c / row.observed) for c, row in residuals if row.observed is not None]


def _joint_limits(situation: Situation, limits: JointLimits) -> Iterator[Scalar]:
    for side in sides(situation.scene, limits):
        values = situation.motion.joint_rates if side.is_rate else situation.motion.joint_angles
        yield side.sign * values[side.joint] - side.bound


def _distance(situation: Situation, constraint: Distance) -> Iterator[Scalar]:
    rounding = _ROUNDING[situation.scene.simulation.precision]
    for _, body, _, obstacle in pairs_that_may_touch(situation.scene, constraint):
        apart = _segment_distance(_segment(situation, body), _segment(situation, obstacle), rounding)
        yield body.radius + obstacle.radius - apart


class _Segment(NamedTuple):
    start: Scalars
    along: Scalars | None  # from start to end; None for a point


def _segment(situation: Situation, volume: Volume) -> _Segment:
    start, end = volume.ends
    place = situation.point(volume.frame, start)
    if start == end:
        return _Segment(place, None)
    return _Segment(
        place,
        matrix_vector(situation.placement(volume.frame)[0], [b - a for a, b in zip(start, end, strict=True)]),
    )


def _clamped(share: Scalar) -> Scalar:
    share = select(share > 0.0, share, 0.0)
    return select(share < 1.0, share, 1.0)


def _segment_distance(first: _Segment, second: _Segment, rounding: float) -> Scalar:
    """Distance of two segments (Ericson, Real-Time Collision Detection, 2005, 5.1.9).

    They count as parallel where the squared sine between them may be all rounding.
    """
    between = subtract(first.start, second.start)
    if first.along is None and second.along is None:
        return _distance_of(between)
    if first.along is None:
        first, second, between = second, first, scale(-1.0, between)
    assert first.along is not None
    a, c = dot(first.along, first.along), dot(first.along, between)
    if second.along is None:
        return _distance_of(add(between, scale(_clamped(-c / a), first.along)))
    e, f, b = dot(second.along, second.along), dot(second.along, between), dot(first.along, second.along)
    denominator = a * e - b * b
    parallel = denominator <= rounding * a * e
    share = _clamped((b * f - c * e) / select(parallel, 1.0, denominator))
    share = select(parallel, 0.0, share)
    other = (b * share + f) / e
    share = select(other < 0.0, _clamped(-c / a), select(other > 1.0, _clamped((b - c) / a), share))
    nearest = subtract(scale(share, first.along), scale(_clamped(other), second.along))
    return _distance_of(add(between, nearest))


def _distance_of(vector: Scalars) -> Scalar:
    """Length of a vector between centers or axes; its derivative is finite where they meet."""
    return sqrt(dot(vector, vector) + MEETING**2)


def _length(vector: Scalars) -> Scalar:
    """Length of a vector, rounded off at zero."""
    return sqrt(dot(vector, vector) + SMALLEST_LENGTH**2) - SMALLEST_LENGTH


def _cosine(situation: Situation, constraint: KeepInDirection | KeepOutDirection) -> Scalar:
    axis, direction = constraint.axis, constraint.direction
    return dot(
        situation.direction(axis.frame, axis.direction),
        situation.direction(direction.frame, direction.direction),
    ) - math.cos(math.radians(constraint.angle_deg))


def _keep_out_direction(situation: Situation, constraint: KeepOutDirection) -> Iterator[Scalar]:
    yield _cosine(situation, constraint)


def _keep_in_direction(situation: Situation, constraint: KeepInDirection) -> Iterator[Scalar]:
    yield -_cosine(situation, constraint)


def _line_of_sight(situation: Situation, constraint: LineOfSight) -> Iterator[Scalar]:
    """cos(angle) |d| - boresight . d, with d from camera to point (Lee & Mesbahi, JGCD 2017)."""
    camera = constraint.camera
    d = subtract(situation.place_of(constraint.point), situation.place_of(camera))
    boresight = situation.direction(camera.frame, constraint.boresight)
    yield math.cos(math.radians(constraint.angle_deg)) * _length(d) - dot(boresight, d)


def _approach_corridor(situation: Situation, constraint: ApproachCorridor) -> Iterator[Scalar]:
    """Distance from the axis less the corridor's radius there."""
    apex = constraint.apex
    r = subtract(situation.place_of(constraint.point), situation.place_of(apex))
    axis = situation.direction(apex.frame, constraint.direction)
    height = dot(axis, r)
    aside = subtract(r, scale(height, axis))
    yield _length(aside) - constraint.width - height * math.tan(math.radians(constraint.angle_deg))


def _plume(situation: Situation, constraint: Plume) -> Iterator[Scalar]:
    """How deep -f is in the cone in which gas meets the sphere; half angle al = plume + asin(R / |d|).

    Its distance from the surface is sin(al) (-f . n) - cos(al) |f x n| with n = d / |d| toward the sphere:
    linear in f but for the turn about n. A thruster only turns on: it is linear in its force.
    """
    scene, control = situation.scene, situation.equations.layout.control
    given = scene.actuators.base_force
    if given is not None:
        strongest = max(given.limit)
        rounded_off = 1e-3 * (strongest if math.isfinite(strongest) else 1.0)
        sine, cosine, n = _cone_of_gas(situation, constraint, constraint.thruster)
        part = situation.u[control.base_force]
        force = [*part, 0.0] if situation.equations.tree.planar else part
        aside = cross(force, n)
        yield -sine * dot(force, n) - cosine * sqrt(dot(aside, aside) + rounded_off**2)
    for thruster, size in zip(
        scene.actuators.thrusters or (), situation.u[control.thruster_force], strict=True
    ):
        sine, cosine, n = _cone_of_gas(situation, constraint, thruster.position)
        aside = cross(thruster.unit_direction, n)
        along = dot(thruster.unit_direction, n)
        yield size * (-sine * along - cosine * sqrt(dot(aside, aside) + 1e-12))


def _cone_of_gas(situation: Situation, constraint: Plume, place: Scalars) -> tuple[Scalar, Scalar, Scalars]:
    """Sine and cosine of the half angle al, and direction n to the sphere, of gas that leaves at a place."""
    sphere = constraint.keeps_clear
    d = subtract(situation.point(sphere.frame, sphere.position), place)
    # Within the sphere its half angle stays that at the surface, 90 deg.
    square = dot(d, d) + SMALLEST_LENGTH**2
    nearest = select(square > sphere.radius**2, square, sphere.radius**2)
    sine, half = sphere.radius / sqrt(nearest), math.radians(constraint.angle_deg)
    cosine = sqrt(1.0 - sine * sine + _ROUNDING[situation.scene.simulation.precision])
    sine_of_both = math.sin(half) * cosine + math.cos(half) * sine
    cosine_of_both = math.cos(half) * cosine - math.sin(half) * sine
    return sine_of_both, cosine_of_both, scale(1.0 / sqrt(square), d)


def _momentum(situation: Situation, constraint: Momentum) -> Iterator[Scalar]:
    """(|h|^2 - bound^2) / (2 bound), smooth at zero; likewise of the energy, which is quadratic itself."""
    linear, angular, energy = situation.momentum()
    for vector, bound in ((linear, constraint.linear), (angular, constraint.angular)):
        if bound is not None:
            yield (dot(vector, vector) - bound * bound) / (2.0 * bound)
    if constraint.energy is not None:
        yield energy - constraint.energy


def _wheel_momentum(situation: Situation, constraint: WheelMomentum) -> Iterator[Scalar]:
    _, angular, _ = situation.momentum()
    for axis in directions(situation.scene, "angular_momentum"):
        yield -angular[axis] - constraint.capacity
        yield angular[axis] - constraint.capacity


def _wheel_limits(situation: Situation, constraint: WheelLimits) -> Iterator[Scalar]:
    """Speeds within +-Omega_max, torques within +-P / |Omega|.

    The latter are seen at the corner P / u_max, the speed where the power takes over from the torque: nearly
    linear in u and Omega, where u Omega is as curved as a saddle.
    """
    motion, tree = situation.motion, situation.equations.tree
    found = reaction_wheels.speeds(tree.wheels, motion.wheel_momenta, motion.angular)
    given, equations = situation.scene.actuators.wheels or (), situation.equations
    limits = equations.control_limits[equations.layout.control.wheel_torque]
    torques = situation.inputs.wheel_torques
    for wheel, speed, torque, most_torque in zip(given, found, torques, limits, strict=True):
        if math.isfinite(wheel.speed):
            yield -speed - wheel.speed
            yield speed - wheel.speed
        if math.isfinite(wheel.power):
            # Where a phase has no wheels, the largest torque is 0 and there is no corner.
            largest = select(most_torque > 0.0, most_torque, wheel.torque)
            corner = wheel.power / largest if math.isfinite(wheel.torque) else 1.0
            size = select(speed > 0.0, speed, -speed)
            most = wheel.power / select(size > 0.5 * corner, size, 0.5 * corner)
            yield corner * (-torque - most)
            yield corner * (torque - most)


def _propellant(situation: Situation, constraint: Propellant) -> Iterator[Scalar]:
    (left,), (rate,) = situation.motion.propellant, situation.inputs.propellant_rates
    yield constraint.reserve - (left + rate * situation.scene.simulation.dt)


def _control_rate(situation: Situation, constraint: ControlRate) -> Iterator[Scalar]:
    scene, layout = situation.scene, situation.equations.layout
    before = dict(zip(layout.previous_controls, situation.motion.previous_controls, strict=True))
    for limit in rate_limits(scene, constraint):
        change, most = situation.u[limit.control] - before[limit.control], limit.rate * scene.simulation.dt
        yield -change - most
        yield change - most


def _torque_speed(situation: Situation, constraint: TorqueSpeed) -> Iterator[Scalar]:
    for torque, least, greatest in torque_ranges(situation.equations, situation.motion, situation.u):
        yield least - torque
        yield torque - greatest


_RESIDUALS: dict[type[Constraint], Callable[..., Iterator[Scalar]]] = {
    JointLimits: _joint_limits,
    Distance: _distance,
    KeepOutDirection: _keep_out_direction,
    KeepInDirection: _keep_in_direction,
    LineOfSight: _line_of_sight,
    ApproachCorridor: _approach_corridor,
    Plume: _plume,
    Momentum: _momentum,
    WheelMomentum: _wheel_momentum,
    WheelLimits: _wheel_limits,
    Propellant: _propellant,
    ControlRate: _control_rate,
    TorqueSpeed: _torque_speed,
}
