"""Spacecraft, path of its tip and target as shaded faces, plain enough for print."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.viewing.rendering.body_shapes import shape_meshes
from dq_space_arm_env.viewing.rendering.solids import Color, Mesh, ball, box, lathe
from dq_space_arm_env.viewing.rendering.spacecraft import equivalent_box, frames_before
from experts.figures.style import BLUE, GREEN, PURPLE, VERMILION
from experts.problems.shooting_problem import FloatArray

AXIS_COLORS = (to_rgb(VERMILION), to_rgb(GREEN), to_rgb(BLUE))
BASE_COLOR, LINK_COLOR, JOINT_COLOR, PAYLOAD_COLOR, TARGET_COLOR = (
    (0.88, 0.78, 0.56),
    (0.72, 0.76, 0.82),
    (0.34, 0.38, 0.46),
    (0.62, 0.74, 0.72),
    (0.80, 0.80, 0.80),
)
PATH_COLOR = to_rgb(PURPLE)

_SIDES = 16
_TARGET_AXES, _TIP_AXES = 0.27, 0.15  # of the reach


class Faces(NamedTuple):
    """Quadrilaterals in the inertial frame."""

    corners: FloatArray  # Shape (faces, 4, 3), m
    normals: FloatArray  # Outward unit normals, shape (faces, 3)
    colors: FloatArray  # Red, green, blue with the light on them, 0 to 1, shape (faces, 3)

    @classmethod
    def joined(cls, parts: Iterable[Faces]) -> Faces:
        """All faces of the parts."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class _Solids(NamedTuple):
    """The parts of a `Mesh` that are drawn here; each face in the frame that carries it."""

    corners: FloatArray
    normals: FloatArray
    colors: FloatArray
    frames: NDArray[np.intp]

    @classmethod
    def of(cls, mesh: Mesh) -> _Solids:
        return cls(mesh.corners, mesh.normals, mesh.colors, mesh.frames)

    @classmethod
    def joined(cls, parts: Iterable[_Solids]) -> _Solids:
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class Schematic:
    """The solids of a scene in their frames, lit from a direction, shape (3,)."""

    def __init__(self, scene: Scene, light: FloatArray) -> None:
        before, offsets = frames_before(scene)
        size, _ = equivalent_box(scene.base.mass, scene.base.inertia)
        self.reach = max(float(np.linalg.norm(offsets, axis=1).sum()), float(size.max()))
        self._scene = scene
        self._light = light / np.linalg.norm(light)
        self._radius = 0.02 * self.reach
        first = 1 + len(scene.links)
        self._tips = [*range(first, first + len(scene.other_tips)), len(before)]  # the main one last
        self._spacecraft = _divided(
            Mesh.joined([*self._bodies(), *self._arm(before, offsets)]), 0.06 * self.reach
        )
        target, target_body = shown_target(scene)
        self._target_paths = [
            np.atleast_2d(target if each is None else each) for each in (target, target_body)
        ]
        short, long = _TIP_AXES * self.reach, _TARGET_AXES * self.reach
        self._tip_axes = _divided(_axes(short, 0.006 * self.reach), 0.25 * short)
        axes = _axes(long, 0.004 * self.reach)
        goals = [axes]
        for tip in scene.other_tips:  # in the frame of the target's body, or in space
            rotation, place = np.array(tip.goal.rotation_matrix), np.array(tip.goal.position)
            goals.append(axes.moved(1 if tip.relative_to == "target" else 2, rotation, place))
        self._target = _divided(Mesh.joined(goals), 0.25 * long)
        if scene.target.geometry:
            body = Mesh.joined(shape_meshes(1, scene.target.geometry, TARGET_COLOR))
            self._target = _Solids.joined([self._target, _divided(body, 0.06 * self.reach)])

    def spacecraft(self, frames: FloatArray, payload: FloatArray | None = None) -> Faces:
        """Place base, arm, payloads and the axes of the tips.

        Given are the poses of all frames, shape (frames, 8), m, and the payload's, (8,); None: at the tip.
        """
        all_frames = np.vstack([frames, frames[-1] if payload is None else payload])
        matrices, origins = poses.to_matrix(tuple(all_frames.T))
        rotations: FloatArray = np.moveaxis(np.array(matrices), 2, 0)
        positions: FloatArray = np.array(origins).T
        axes = (self._lit(self._tip_axes, rotations[[tip]], positions[[tip]]) for tip in self._tips)
        return Faces.joined([self._lit(self._spacecraft, rotations, positions), *axes])

    def target(self, stage: int) -> Faces:
        """Place the goals' axes at a stage, longer and thinner than the tips', and the target's shapes."""
        matrices, origins = poses.to_matrix(tuple(self._target_frames(stage).T))
        rotations: FloatArray = np.moveaxis(np.array(matrices), 2, 0)
        return self._lit(self._target, rotations, np.array(origins).T)

    def path(self, points: FloatArray, radius: float) -> Faces:
        """A path through points, shape (n, 3), m, as a thin tube; no faces if it has no length."""
        lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
        if lengths[-1] < radius:
            return Faces(np.zeros((0, 4, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
        stations = np.linspace(0.0, lengths[-1], max(2, round(lengths[-1] / (3.0 * radius))))
        centers = np.column_stack([np.interp(stations, lengths, column) for column in points.T])
        parts = [
            _rod(0, end - start, float(np.linalg.norm(end - start)), radius, PATH_COLOR, 6, start)
            for start, end in pairwise(centers)
            if np.linalg.norm(end - start) > 0.0
        ]
        return self._lit(_Solids.of(Mesh.joined(parts)), np.eye(3)[None], np.zeros((1, 3)))

    def _target_frames(self, stage: int) -> FloatArray:
        """Poses of target and target's body at a stage, and that of space, shape (3, 8), m."""
        return np.array([*(path[min(stage, len(path) - 1)] for path in self._target_paths), np.eye(8)[0]])

    def target_points(self, stage: int) -> FloatArray:
        """Origin of the target's axes at a stage and the ends of x, y and z, shape (4, 3), m."""
        rotation, position = poses.to_matrix(tuple(self._target_frames(stage)[0].tolist()))
        origin = np.array(position)
        return np.vstack([origin, origin + _TARGET_AXES * self.reach * np.array(rotation).T])

    def tip_points(self, frames: FloatArray) -> FloatArray:
        """Origin of the tip's axes and the ends of x, y and z, shape (4, 3), m."""
        rotation, position = poses.to_matrix(tuple(frames[-1].tolist()))
        return np.vstack([position, np.array(position) + _TIP_AXES * self.reach * np.array(rotation).T])

    def _bodies(self) -> Iterable[Mesh]:
        base = self._scene.base
        size, axes = equivalent_box(base.mass, base.inertia)
        if base.geometry:
            yield from shape_meshes(0, base.geometry, BASE_COLOR)
        else:
            yield box(0, np.zeros(3), size, BASE_COLOR, axes)
        # What the main tip holds has the frame after its own; a payload excludes a wrist.
        held = [(self._tips[-1] + 1, self._scene.payload)]
        held += [(tip, each.payload) for tip, each in zip(self._tips, self._scene.other_tips, strict=False)]
        for own, payload in held:
            if payload is not None and payload.geometry:
                yield from shape_meshes(own, payload.geometry, PAYLOAD_COLOR)
            elif payload is not None:
                size, axes = equivalent_box(payload.mass, payload.inertia)
                yield box(own, payload.center_of_mass, size, PAYLOAD_COLOR, axes)

    def _arm(self, before: list[int], offsets: FloatArray) -> Iterable[Mesh]:
        """Links from each frame to the next, joints along their axes, a ball for the wrist."""
        joints, radius = len(self._scene.links), self._radius
        shapes = {0: self._scene.base.geometry}
        shapes |= {frame: link.geometry for frame, link in enumerate(self._scene.links, 1)}
        for frame, offset in zip(before, offsets, strict=True):
            length = float(np.linalg.norm(offset))
            if length > 0.0 and not shapes.get(frame):
                yield _rod(frame, offset, length, radius if frame else 1.5 * radius, LINK_COLOR)
        for frame in range(1, joints + 1):
            if shapes[frame]:
                yield from shape_meshes(frame, shapes[frame], LINK_COLOR)
                continue
            if frame not in before:  # the end of a branch
                link = self._scene.links[frame - 1]
                size, axes = equivalent_box(link.mass, link.inertia)
                yield box(frame, link.center_of_mass, size, LINK_COLOR, axes)
            profile = [(-1.7, 0.0), (-1.7, 1.6), (1.7, 1.6), (1.7, 0.0)]
            scaled = [(radius * height, radius * ring) for height, ring in profile]
            yield lathe(frame, np.zeros(3), (0.0, 0.0, 1.0), scaled, JOINT_COLOR, _SIDES)
        if self._scene.wrist is not None:
            yield ball(len(before) - 1, np.zeros(3), 1.6 * radius, JOINT_COLOR, _SIDES)

    def _lit(self, solids: _Solids, rotations: FloatArray, positions: FloatArray) -> Faces:
        """Place and light solids, given rotation matrices and origins of the frames."""
        rotation = rotations[solids.frames]
        corners = solids.corners @ rotation.transpose(0, 2, 1) + positions[solids.frames][:, None]
        normals = np.einsum("fij,fj->fi", rotation, solids.normals)
        brightness = 0.74 + 0.26 * (normals @ self._light)
        return Faces(corners, normals, np.clip(solids.colors * brightness[:, None], 0.0, 1.0))


def _rod(
    frame: int,
    direction: FloatArray | tuple[float, float, float],
    length: float,
    radius: float,
    color: Color,
    sides: int = _SIDES,
    start: FloatArray | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Mesh:
    profile = [(0.0, 0.0), (0.0, radius), (length, radius), (length, 0.0)]
    return lathe(frame, start, direction, profile, color, sides)


def _axes(length: float, radius: float) -> Mesh:
    """Arrows along x, y and z."""
    neck = length - 6.0 * radius
    profile = [(0.0, 0.0), (0.0, radius), (neck, radius), (neck, 2.5 * radius), (length, 0.0)]
    arrows = [
        lathe(0, np.zeros(3), direction, profile, color, 12)
        for direction, color in zip(np.eye(3), AXIS_COLORS, strict=True)
    ]
    return Mesh.joined(arrows)


def _divided(mesh: Mesh, longest: float) -> _Solids:
    """Cut faces until no edge is longer than given: only small faces can be sorted by depth."""
    corners = mesh.corners
    across = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    along = np.linalg.norm(corners[:, 3] - corners[:, 0], axis=1)
    # Of the faces that meet in the axis of a surface of revolution, one edge has no length.
    across = np.maximum(across, np.linalg.norm(corners[:, 2] - corners[:, 3], axis=1))
    cuts = np.ceil(np.column_stack([across, along]) / longest).astype(int).clip(1)
    parts = []
    for columns, rows in np.unique(cuts, axis=0):
        chosen = (cuts == (columns, rows)).all(axis=1)
        count = columns * rows
        parts.append(
            _Solids(
                _cut(corners[chosen], columns, rows),
                np.repeat(mesh.normals[chosen], count, axis=0),
                np.repeat(mesh.colors[chosen], count, axis=0),
                np.repeat(mesh.frames[chosen], count, axis=0),
            )
        )
    return _Solids.joined(parts)


def _cut(corners: FloatArray, columns: int, rows: int) -> FloatArray:
    """Cut quadrilaterals, shape (faces, 4, 3), into columns x rows each."""
    u = np.linspace(0.0, 1.0, columns + 1)[:, None, None]
    v = np.linspace(0.0, 1.0, rows + 1)[None, :, None]
    a, b, c, d = (corners[:, index, None, None] for index in range(4))
    grid = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
    pieces = [grid[:, :-1, :-1], grid[:, 1:, :-1], grid[:, 1:, 1:], grid[:, :-1, 1:]]
    return np.stack(pieces, axis=3).reshape(-1, 4, 3)
