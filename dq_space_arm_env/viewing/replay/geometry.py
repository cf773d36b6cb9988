"""The robot as arrays for the graphics processor, and the side from which it is seen."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.constraint_rows import rows_of
from dq_space_arm_env.viewing.constraint_shapes import (
    GAS,
    REACH,
    constraint_shapes,
    gas_of,
    thruster_shapes,
)
from dq_space_arm_env.viewing.rendering.solids import Mesh
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.viewing.replay.flights import FloatArray, ShownFlight, poses_at

_CREASE = math.cos(math.radians(40.0))
_STEPS_PER_METER = 1e5  # resolution of corners; equal ones share a vertex
_INSTANTS = 9
_FLOWN_AWAY = 3.0  # times the size of robot, reach and target, and the way between them
_AZIMUTHS = tuple(math.radians(angle) for angle in range(0, 360, 15))
_ELEVATIONS = tuple(math.radians(angle) for angle in (12, 24, 36))
_PLANAR_VIEW = (math.radians(-90.0), math.radians(62.0))


class Triangles(NamedTuple):
    """T triangles, each part of a group, that share V vertices."""

    positions: NDArray[np.float32]  # shape (V, 3), m
    normals: NDArray[np.int8]  # units of 1/127, shape (V, 4); the last is 0
    colors: NDArray[np.uint8]  # red, green, blue in units of 1/255, shape (V, 4); the last is 255
    triangles: NDArray[np.uint16]  # vertices, counterclockwise seen from outside, shape (T, 3)
    counts: tuple[int, ...]  # of triangles in each group, group by group


class ConstraintDrawing(NamedTuple):
    """The shapes of a scene's constraints along the path."""

    names: tuple[str, ...]  # of the constraints
    triangles: Triangles  # each group is a shape, in its axes
    frames: tuple[tuple[int, int], ...]  # of each shape: of its origin, and of its axes
    nozzles: tuple[tuple[float, ...], ...]  # of each shape: its origin in its frame, m
    gas: tuple[FloatArray, ...]  # by flight: where it goes, base axes, shape (M + 1, 3); empty for none
    owners: tuple[int, ...]  # number of the constraint of each shape
    violated: tuple[NDArray[np.bool_], ...]  # by flight: whether a shape is violated, (shapes, M + 1)
    broken: tuple[NDArray[np.bool_], ...]  # by flight: whether a constraint is, (constraints, M + 1)


class View(NamedTuple):
    """Placement of the camera."""

    azimuth: float  # of the camera seen from the robot: angle about z from x, rad
    elevation: float  # above the x-y plane, rad
    points: FloatArray  # to keep in the picture, shape (n, 3), m
    pivot: FloatArray  # center of rotation, shape (3,), m


def solids_of(scene: Scene) -> Triangles:
    """Solids of the environment's pictures, with smooth shading where they are round.

    The groups are the frames, in the end those of target, target's body and payload, and the inertial one.
    """
    model = SpacecraftModel(scene)
    return _triangles_of(model.mesh, model.frame_count + 4, f"scene {scene.name!r}")


def constraints_of(scene: Scene, flights: Sequence[ShownFlight]) -> ConstraintDrawing | None:
    """Shapes of the constraints along the path, where flights violate them, and jets; None without any."""
    listed = [each for each in scene.constraints if rows_of(scene, each)]
    length = REACH * SpacecraftModel(scene).axis_length
    groups, jets = constraint_shapes(scene, length), thruster_shapes(scene, length)
    if not listed and not jets:
        return None
    along = [group for each, group in zip(scene.constraints, groups, strict=True) if each in listed]
    along += [jets] if jets else []
    shapes = [(number, shape) for number, group in enumerate(along) for shape in group]
    frames = [(shape.place, shape.axes) for _, shape in shapes]
    meshes = [shape.mesh.moved(index, np.eye(3), np.zeros(3)) for index, (_, shape) in enumerate(shapes)]
    triangles = _triangles_of(Mesh.joined(meshes), len(shapes), "constraints") if meshes else _NO_TRIANGLES
    parts = [rows_of(scene, each) for each in listed]
    ends = np.cumsum([len(rows) for rows in parts])
    violated, broken = [], []
    for flight in flights:
        rows = flight.violated
        violated.append(np.array([rows[list(shape.rows), :].any(axis=0) for _, shape in shapes]))
        spans = [rows[end - len(part) : end].any(axis=0) for part, end in zip(parts, ends, strict=True)]
        spans += [np.zeros_like(flight.distance, np.bool_)] if jets else []
        broken.append(np.array(spans))
    nozzles = tuple(shape.nozzle for _, shape in shapes)
    has_gas = any(shape.axes <= GAS for _, shape in shapes)
    gas = tuple(gas_of(scene, flight.acting) for flight in flights) if has_gas else ()
    names = (*(each.name for each in listed), *(["thrusters"] if jets else []))
    owners = tuple(number for number, _ in shapes)
    return ConstraintDrawing(
        names, triangles, tuple(frames), nozzles, gas, owners, tuple(violated), tuple(broken)
    )


def _triangles_of(mesh: Mesh, groups: int, what: str) -> Triangles:
    """Triangles of a mesh, whose frames are the groups; `what` it is, for errors."""
    corners = np.concatenate([mesh.corners[:, [0, 1, 2]], mesh.corners[:, [0, 2, 3]]])
    smooth = smooth_normals(mesh)
    normals = np.concatenate([smooth[:, [0, 1, 2]], smooth[:, [0, 2, 3]]])
    looks = np.tile(np.column_stack([mesh.frames, mesh.colors]), (2, 1))
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The page draws one side only, whatever the order of corners in the mesh.
    inward = np.einsum("ij,ij->i", across, np.tile(mesh.normals, (2, 1))) < 0.0
    corners[inward], normals[inward] = corners[inward, ::-1], normals[inward, ::-1]
    # By frame; a quadrilateral with two equal corners is one triangle.
    order = np.argsort(looks[:, 0], kind="stable")
    kept = order[np.linalg.norm(across, axis=1)[order] > 1e-12]
    vertices = np.column_stack(
        [
            np.repeat(looks[kept], 3, axis=0) * (1.0, 255.0, 255.0, 255.0),
            127.0 * normals[kept].reshape(-1, 3),
            _STEPS_PER_METER * corners[kept].reshape(-1, 3),
        ]
    )
    distinct, triangles = np.unique(np.rint(vertices), axis=0, return_inverse=True)
    if len(distinct) > 2**16:
        raise ValueError(f"{what} has {len(distinct)} corners to draw, should be at most 65536")
    count = len(distinct)
    return Triangles(
        (distinct[:, 7:] / _STEPS_PER_METER).astype(np.float32),
        np.column_stack([distinct[:, 4:7], np.zeros(count)]).astype(np.int8),
        np.column_stack([distinct[:, 1:4], np.full(count, 255)]).astype(np.uint8),
        triangles.reshape(-1, 3).astype(np.uint16),
        tuple(np.bincount(looks[kept, 0].astype(int), minlength=groups).tolist()),
    )


_NO_TRIANGLES = Triangles(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 4), np.int8),
    np.zeros((0, 4), np.uint8),
    np.zeros((0, 3), np.uint16),
    (),
)


def smooth_normals(mesh: Mesh) -> FloatArray:
    """Normals at corners, averaged over faces without a sharp edge between them, shape (faces, 4, 3)."""
    places = np.column_stack([np.repeat(mesh.frames, 4), np.rint(1e6 * mesh.corners.reshape(-1, 3))])
    _, group = np.unique(places, axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    own = np.repeat(mesh.normals, 4, axis=0)
    result = own.copy()
    for members in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        normals = own[members]
        near = normals @ normals.T > _CREASE
        result[members] = near @ normals
    result /= np.linalg.norm(result, axis=1, keepdims=True)
    return result.reshape(-1, 4, 3)


def view_of(flights: Sequence[ShownFlight], scene: Scene) -> View:
    """Choose the side from which arm and target are seen best."""
    model = SpacecraftModel(scene)
    frames = [_frames_at(flight) for flight in flights]
    origins = [np.moveaxis(np.array(poses.position(tuple(np.moveaxis(f, 2, 0)))), 0, 2) for f in frames]
    robots, goals = [origin[:, :-4] for origin in origins], np.stack([origin[:, -4] for origin in origins])
    if scene.base.motion == "planar":
        azimuth, elevation = _PLANAR_VIEW
    else:
        azimuth, elevation = _best_direction(robots, goals[:, 0], float(model.axis_length))
    cloud = [_corners(model, each) for each in frames]
    arm = np.concatenate([*(robot[:, 1:].reshape(-1, 3) for robot in robots), goals.reshape(-1, 3)])
    return View(azimuth, elevation, _outermost(np.concatenate(cloud)), 0.5 * (arm.min(0) + arm.max(0)))


def _frames_at(flight: ShownFlight) -> FloatArray:
    """All frames that `SpacecraftModel` numbers, at some instants, shape (instants, frames + 4, 8)."""
    instants = np.linspace(0, flight.steps, _INSTANTS).astype(int)
    body = flight.target if flight.target_body is None else flight.target_body
    payload = flight.frames[:, -1] if flight.payload is None else flight.payload
    others = [poses_at(each, instants)[:, None] for each in (flight.target, body, payload, np.eye(8)[0])]
    return np.concatenate([flight.frames[instants], *others], axis=1)


def direction(azimuth: float, elevation: float) -> FloatArray:
    """Unit vector toward the camera from its azimuth and elevation, rad."""
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])


def _best_direction(origins: Sequence[FloatArray], goals: FloatArray, size: float) -> tuple[float, float]:
    """Direction in which the arm looks large, and base and tip hide neither each other nor the target."""

    def score(view: tuple[float, float]) -> float:
        toward = direction(*view)
        right = np.array([-math.sin(view[0]), math.cos(view[0]), 0.0])
        screen = np.stack([right, np.cross(toward, right)])
        total = 0.0
        for chain, goal in zip(origins, goals, strict=True):
            flat, aim = chain @ screen.T, screen @ goal
            spread = flat - flat.mean(axis=1, keepdims=True)
            areas = np.linalg.det(np.einsum("tki,tkj->tij", spread, spread))
            total += float(np.mean(np.sqrt(np.maximum(areas, 0.0))))
            # Reward an arm that ends in front of the spacecraft, and a path to the target across the picture.
            total += 0.3 * size * float(np.mean((chain[:, -1] - chain[:, 0]) @ toward))
            total += size * float(np.linalg.norm(flat[0, -1] - aim))
        return total

    return max(itertools.product(_AZIMUTHS, _ELEVATIONS), key=score)


def _corners(model: SpacecraftModel, frames: FloatArray) -> FloatArray:
    """Corners of all solids at some instants, shape (n, 3), except of a robot that has flown away."""
    corners = np.column_stack([np.repeat(model.mesh.frames, 4), model.mesh.corners.reshape(-1, 3)])
    corners = np.unique(np.round(corners, 3), axis=0)
    numbers, places = corners[:, 0].astype(int), corners[:, 1:, None]
    points = []
    for instant in frames:
        matrices, positions = poses.to_matrix(instant.T)
        rotations = np.moveaxis(np.array(matrices), 2, 0)[numbers]
        points.append((rotations @ places)[..., 0] + np.array(positions).T[numbers])
    cloud = np.concatenate(points)
    offsets = np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1)
    centers, radii = model.region
    size = radii.sum() + np.linalg.norm(np.ptp(centers, axis=0))
    return np.asarray(cloud[offsets <= _FLOWN_AWAY * size])


def _outermost(points: FloatArray) -> FloatArray:
    """The points farthest out in any of many directions: with them in the picture, all are."""
    turns = np.arange(240)
    height = 1.0 - (2.0 * turns + 1.0) / len(turns)
    around = turns * math.pi * (3.0 - math.sqrt(5.0))
    level = np.sqrt(1.0 - height**2)
    directions = np.column_stack([level * np.cos(around), level * np.sin(around), height])
    return np.asarray(points[np.unique(np.argmax(directions @ points.T, axis=1))])
