"""Constraints, and thrusters, as shapes in frames for pictures; and where flights violate any."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.constraint_rows import pairs_that_may_touch, rows_of
from dq_space_arm_env.scene.constraints import (
    ApproachCorridor,
    Constraint,
    Distance,
    KeepInDirection,
    KeepOutDirection,
    LineOfSight,
    Plume,
    Volume,
)
from dq_space_arm_env.scene.parameters import target_entries, target_numbers
from dq_space_arm_env.viewing.rendering.solids import Color, Mesh, ball, lathe

FloatArray = NDArray[np.float64]

VISIBLE = 0.01
"""Share of its tolerance by which a row must be violated to be shown as violated."""
INERTIAL = -1
"""Number of the inertial frame; the others are numbered as in `SpacecraftModel`."""
GAS = -2
"""Number of the axes of which z is where the gas of the net force goes; of thruster i it is GAS - 1 - i."""

REACH = 4.0
"""Length of cones and directions over that of the axes at the tip."""

_COLOR: Color = (1.0, 1.0, 1.0)  # the page tints them
_KEPT: Color = (0.24, 0.81, 0.60)
_SIDES = 32
# Of a thruster that misses nothing in particular: share of the length, half angle in degrees.
_JET = (0.3, 15.0)
_NEEDLE = 0.012  # radius of a direction over its length
_POINT = 0.02  # radius of what a camera sees over the length of its cone


class ConstraintShape(NamedTuple):
    """A shape that stands for a constraint, or for a part of one."""

    mesh: Mesh  # in a frame's axes, about its origin
    place: int  # frame that carries the origin
    axes: int  # frame that gives the axes
    rows: tuple[int, ...]  # rows of `path_rows` whose violation it shows
    nozzle: tuple[float, ...] = (0.0, 0.0, 0.0)  # origin in the frame that carries it, m


def constraint_shapes(scene: Scene, length: float) -> list[list[ConstraintShape]]:
    """Find the shapes of a scene's constraints.

    Args:
        scene: The scene.
        length: How far cones and directions are drawn, m.

    Returns:
        The shapes of each constraint; none of what has no place in space, such as limits of joints.
    """
    numbers = _frame_numbers(scene)
    found, first = [], 0
    for each in scene.constraints:
        rows = tuple(range(first, first + len(rows_of(scene, each))))
        first += len(rows)
        make = _SHAPES.get(type(each))
        found.append([] if make is None else list(make(scene, each, rows, numbers, length)))
    return found


def thruster_shapes(scene: Scene, length: float) -> list[ConstraintShape]:
    """The gas of single thrusters where no constraint draws it: a cone each, which grows with the force.

    Args:
        scene: The scene.
        length: How far cones of constraints are drawn, m.

    Returns:
        One shape per thruster, or none.
    """
    if any(isinstance(each, Plume) for each in scene.constraints):
        return []
    share, angle = _JET
    return [*_jets(scene, angle, share * length, [()] * len(scene.actuators.thrusters or ()))]


def gas_of(scene: Scene, controls: FloatArray) -> FloatArray:
    """Find where the gas of the thrusters goes.

    Args:
        scene: The scene.
        controls: Shape (M, n_u), N, N m, rad/s; none acts in the last state.

    Returns:
        Vectors along -f in base axes, shape (M + 1, 1 + thrusters, 3), of the net force and of each thruster;
        of length 1 for the largest force, along an axis or of the thruster.
    """
    layout, thrusters = StateLayout.of(scene), scene.actuators.thrusters or ()
    gas = np.zeros((len(controls) + 1, 1 + len(thrusters), 3))
    given = controls[:, layout.control.base_force]
    gas[:-1, 0, : given.shape[1]] = -given / _largest(scene.actuators.base_force, given)  # planar: x and y
    for index, each in enumerate(thrusters):
        force = np.maximum(controls[:, layout.control.thruster_force.start + index, None], 0.0)
        largest = each.force if math.isfinite(each.force) else max(float(force.max(initial=0.0)), 1.0)
        gas[:-1, 1 + index] = -force / largest * np.array(each.unit_direction)
    return gas


def shapes_in_space(shapes: Sequence[ConstraintShape], frames: FloatArray, gas: FloatArray) -> Iterator[Mesh]:
    """Place shapes at an instant, transparent, in green.

    Args:
        shapes: The shapes.
        frames: Poses of the robot's frames, the target and the target's body, shape (frames + 2, 8), m.
        gas: A row of `gas_of`, shape (1 + thrusters, 3).

    Yields:
        Meshes in the inertial frame.
    """
    matrices, places = poses.to_matrix(np.vstack([frames, np.eye(8)[0]]).T)  # INERTIAL is the last
    turns: FloatArray = np.moveaxis(np.array(matrices), 2, 0)
    origins = np.array(places).T
    for shape in shapes:
        mesh, turn = shape.mesh.likeness(_KEPT), turns[shape.place]
        if shape.axes <= GAS:
            blown = gas[GAS - shape.axes]
            size = float(np.linalg.norm(blown))
            if size == 0.0:
                continue
            mesh, axes = replace(mesh, corners=math.sqrt(size) * mesh.corners), turn @ _along(blown / size)
        else:
            axes = turns[shape.axes]
        yield mesh.moved(0, axes, origins[shape.place] + turn @ shape.nozzle)


def _along(z: FloatArray) -> FloatArray:
    """Some axes of which z is given, as columns."""
    across = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    y = across / np.linalg.norm(across)
    return np.column_stack([np.cross(y, z), y, z])


def _largest(actuator: Any, given: FloatArray) -> float:
    """The largest limit of an actuator's axes; where none is finite, the largest force that is given."""
    limits = [limit for limit in actuator.limit if math.isfinite(limit) and limit > 0.0] if actuator else []
    return float(max(limits, default=max(float(np.abs(given).max(initial=0.0)), 1.0)))


def violations(
    scene: Scene, states: FloatArray, controls: FloatArray, body: FloatArray, target: FloatArray
) -> NDArray[np.bool_]:
    """Find where the rows of a scene's constraints are violated.

    Args:
        scene: The scene.
        states: Shape (M + 1, n_x).
        controls: Shape (M, n_u), N, N m, rad/s; none acts in the last state.
        body: Pose of the target's body, shape (8,) or (M + 1, 8), dimensionless and m.
        target: Pose that the tip should have, of its grasp frame, likewise.

    Returns:
        Whether a row is violated by more than `VISIBLE` of its tolerance, shape (rows, M + 1).
    """
    # CasADi, which these import, is needed here only.
    from dq_space_arm_env.task.constraint_residuals import path_residuals
    from dq_space_arm_env.task.equations import SceneEquations

    equations = SceneEquations.of(scene, _numbers_during(scene, len(states)))
    entries, grasp = (np.moveaxis(np.broadcast_to(each, (len(states), 8)), 1, 0) for each in (body, target))
    places = {n.name: entries[i] for n, i in zip(target_numbers(scene), target_entries(scene), strict=True)}
    equations = replace(equations, given={**equations.given, **places}, target=list(grasp))
    layout, last = StateLayout.of(scene), np.zeros_like(controls[:1])
    last[0, list(layout.previous_controls)] = states[-1, layout.state.actuators]  # they change no more
    x, u = list(states.T), list(np.vstack([controls, last]).T)
    residuals = path_residuals(equations, equations.base_pose(x), equations.y(x), u)
    rows = [row for each in scene.constraints for row in rows_of(scene, each)]
    limits = [VISIBLE * row.tolerance for row in rows]
    shape = (len(states),)
    return np.array(
        [np.broadcast_to(c > limit, shape) for c, limit in zip(residuals, limits, strict=True)],
        dtype=np.bool_,
    ).reshape(len(rows), *shape)


def _numbers_during(scene: Scene, count: int) -> list[Any]:
    """Nominal parameters: numbers, or arrays (M + 1,) of those that phases change."""
    parameters, staged = StateLayout.of(scene).parameters, scene.staged
    found: list[Any] = parameters.nominal.tolist()
    phases = np.searchsorted(staged.starts, np.arange(count), side="right") - 1
    for name, values in staged.values.items():
        if name in parameters.names:
            found[parameters.names.index(name)] = np.array(values)[phases]
    return found


def _frame_numbers(scene: Scene) -> dict[str, int]:
    """Numbers of the frames by their names in constraints."""
    names = ["base", *(link.name for link in scene.links), *(tip.name for tip in scene.other_tips)]
    tip = len(names) + (scene.wrist is not None)
    numbers = {name: number for number, name in enumerate(names)}
    return {**numbers, "tip": tip, "grasp": tip + 1, "target": tip + 2, "inertial": INERTIAL}


Rows = tuple[int, ...]
Numbers = dict[str, int]


def _distance(
    scene: Scene, each: Distance, rows: Rows, numbers: Numbers, length: float
) -> Iterator[ConstraintShape]:
    pairs = pairs_that_may_touch(scene, each)
    for volumes, place in ((each.bodies, 0), (each.obstacles, 2)):
        for index, volume in enumerate(volumes):
            own = tuple(row for row, pair in zip(rows, pairs, strict=True) if pair[place] == index)
            frame = numbers[volume.frame]
            yield ConstraintShape(_capsule(volume), frame, frame, own)


def _directions(
    scene: Scene, each: KeepInDirection | KeepOutDirection, rows: Rows, numbers: Numbers, length: float
) -> Iterator[ConstraintShape]:
    """The cone about the body's axis, and the direction that stays in, or out of, it."""
    frame, axis = numbers[each.axis.frame], each.axis.direction
    yield ConstraintShape(_cone((0.0, 0.0, 0.0), axis, each.angle_deg, length), frame, frame, rows)
    needle = [(0.0, 0.0), (0.0, _NEEDLE * length), (1.2 * length, _NEEDLE * length), (1.2 * length, 0.0)]
    mesh = lathe(0, (0.0, 0.0, 0.0), each.direction.direction, needle, _COLOR, _SIDES)
    yield ConstraintShape(mesh, frame, numbers[each.direction.frame], rows)


def _line_of_sight(
    scene: Scene, each: LineOfSight, rows: Rows, numbers: Numbers, length: float
) -> Iterator[ConstraintShape]:
    frame = numbers[each.camera.frame]
    yield ConstraintShape(
        _cone(each.camera.position, each.boresight, each.angle_deg, length), frame, frame, rows
    )
    seen = numbers[each.point.frame]
    yield ConstraintShape(ball(0, each.point.position, _POINT * length, _COLOR), seen, seen, rows)


def _approach_corridor(
    scene: Scene, each: ApproachCorridor, rows: Rows, numbers: Numbers, length: float
) -> Iterator[ConstraintShape]:
    frame = numbers[each.apex.frame]
    mesh = _cone(each.apex.position, each.direction, each.angle_deg, length, each.width)
    yield ConstraintShape(mesh, frame, frame, rows)


def _plume(
    scene: Scene, each: Plume, rows: Rows, numbers: Numbers, length: float
) -> Iterator[ConstraintShape]:
    """The sphere, and the gas: a cone along -f, of the net force and of each thruster."""
    frame = numbers[each.keeps_clear.frame]
    yield ConstraintShape(_capsule(each.keeps_clear), frame, frame, rows)
    if scene.actuators.base_force is not None:
        gas = _cone((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), each.angle_deg, length)
        yield ConstraintShape(gas, numbers["base"], GAS, rows[:1], each.thruster)
    own = rows[len(rows) - len(scene.actuators.thrusters or ()) :]
    yield from _jets(scene, each.angle_deg, length, [(row,) for row in own])


def _jets(scene: Scene, angle_deg: float, length: float, rows: Sequence[Rows]) -> Iterator[ConstraintShape]:
    """Cones of the gas of single thrusters, with the rows that each shows."""
    gas = _cone((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), angle_deg, length)
    for index, (thruster, own) in enumerate(zip(scene.actuators.thrusters or (), rows, strict=True)):
        yield ConstraintShape(gas, 0, GAS - 1 - index, own, thruster.position)


_SHAPES: dict[type[Constraint], Callable[..., Iterator[ConstraintShape]]] = {
    Distance: _distance,
    KeepInDirection: _directions,
    KeepOutDirection: _directions,
    LineOfSight: _line_of_sight,
    ApproachCorridor: _approach_corridor,
    Plume: _plume,
}


def _cone(apex: Any, axis: Any, angle_deg: float, length: float, width: float = 0.0) -> Mesh:
    """Cone with its half angle, open at its wide end; beyond 90 degrees it opens backward."""
    angle = math.radians(angle_deg)
    narrow = abs(math.sin(angle)) > 1.0 - 1e-3
    height = (1e-3 if narrow else math.cos(angle)) * length
    radius = width + math.sin(angle) * length
    if height < 0.0:
        axis, height = [-entry for entry in axis], -height
    return lathe(0, apex, axis, [(0.0, width), (height, radius)], _COLOR, _SIDES)


def _capsule(volume: Volume) -> Mesh:
    """Sphere or capsule."""
    start, end = (np.array(point) for point in volume.ends)
    extent = float(np.linalg.norm(end - start))
    if extent == 0.0:
        return ball(0, start, volume.radius, _COLOR, _SIDES)
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SIDES // 2)
    offsets = np.where(angles < 0.0, 0.0, extent)
    heights, radii = offsets + volume.radius * np.sin(angles), volume.radius * np.cos(angles)
    profile = list(zip(heights.tolist(), radii.tolist(), strict=True))
    return lathe(0, start, end - start, profile, _COLOR, _SIDES, smooth=True)
