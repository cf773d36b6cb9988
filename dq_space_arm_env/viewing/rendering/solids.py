"""Solids with flat faces: boxes and surfaces of revolution, each fixed in one frame of the robot.

A `Mesh` is a list of convex planar quadrilaterals; a triangle is one with two equal corners.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Color = tuple[float, float, float]  # red, green, blue, 0 to 1

SHINE = 0.25  # strength of the reflection by default

_FOLDS, _CRUMPLE, _FOIL_SHINE, _FOIL_SEED = 7, 0.13, 0.45, 3

_AXES = np.eye(3)


@dataclass(frozen=True)
class Mesh:
    """Faces, each fixed in a frame."""

    corners: Array  # in order around the face, in its frame, shape (faces, 4, 3), m
    normals: Array  # outward unit normals, shape (faces, 3)
    # Outward unit normals of the surface that the faces approximate: lit by them, a prism looks round.
    corner_normals: Array  # shape (faces, 4, 3)
    colors: Array  # red, green, blue, 0 to 1, shape (faces, 3)
    shine: Array  # strength of the reflection, 0 to 1, shape (faces,)
    sieved: NDArray[np.bool_]  # whether a face looks transparent, shape (faces,)
    frames: NDArray[np.intp]  # frame that carries each face, ascending, shape (faces,)

    @classmethod
    def joined(cls, meshes: Iterable[Mesh]) -> Mesh:
        """Join meshes, ordered by frame, and within a frame as given."""
        parts = list(meshes)
        order = np.argsort(np.concatenate([part.frames for part in parts]), kind="stable")
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts])[order] for name in names))

    @cached_property
    def ranges(self) -> list[tuple[int, slice]]:
        """Frames that carry faces, with the rows of these."""
        starts = np.flatnonzero(np.diff(self.frames, prepend=-1))
        ends = np.append(starts[1:], len(self.frames))
        return [
            (int(self.frames[start]), slice(int(start), int(end)))
            for start, end in zip(starts, ends, strict=True)
        ]

    def moved(self, frame: int, rotation: ArrayLike, position: ArrayLike) -> Mesh:
        """Fix the faces in another frame, by rotation matrix and position (m) of the present frame in it."""
        matrix = np.asarray(rotation, dtype=np.float64).T
        return replace(
            self,
            corners=self.corners @ matrix + np.asarray(position),
            normals=self.normals @ matrix,
            corner_normals=self.corner_normals @ matrix,
            frames=np.full_like(self.frames, frame),
        )

    def likeness(self, color: Color) -> Mesh:
        """The mesh as a ghost: transparent, all of one color."""
        return replace(self, colors=np.tile(color, (len(self.frames), 1)), sieved=np.ones_like(self.sieved))


def _uniform(
    frame: int, corners: Array, normals: Array, corner_normals: Array, colors: ArrayLike, shine: float
) -> Mesh:
    """A mesh in one frame, of one shine."""
    count = len(corners)
    return Mesh(
        corners,
        normals,
        corner_normals,
        np.broadcast_to(np.asarray(colors, dtype=np.float64), (count, 3)).copy(),
        np.full(count, shine),
        np.zeros(count, dtype=np.bool_),
        np.full(count, frame),
    )


def box(
    frame: int,
    center: ArrayLike,
    size: ArrayLike,
    color: Color,
    axes: ArrayLike = _AXES,
    shine: float = SHINE,
) -> Mesh:
    """Box of 6 faces with edge lengths `size`, m; the columns of `axes` are its axes in the frame."""
    square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    corners, normals = np.empty((6, 4, 3)), np.zeros((6, 3))
    for face in range(6):
        axis, side = face % 3, 1.0 - 2.0 * (face // 3)
        corners[face] = np.insert(square, axis, side, axis=1)
        normals[face, axis] = side
    columns = np.asarray(axes, dtype=np.float64)
    corners = 0.5 * corners * np.asarray(size) @ columns.T + np.asarray(center)
    normals = normals @ columns.T
    return _uniform(frame, corners, normals, np.repeat(normals[:, None], 4, axis=1), color, shine)


def crumpled_box(
    frame: int, center: ArrayLike, size: ArrayLike, color: Color, axes: ArrayLike = _AXES
) -> Mesh:
    """Box in foil: its faces are flat but reflect light as if crumpled; equal arguments give equal folds."""
    rng = np.random.default_rng(_FOIL_SEED)
    plain = box(frame, center, size, color, axes)
    steps = np.linspace(0.0, 1.0, _FOLDS + 1)
    corners: list[Array] = []
    normals: list[Array] = []
    for (first, second, third, fourth), normal in zip(plain.corners, plain.normals, strict=True):
        grid = (
            first
            + steps[:, None, None] * (second - first)
            + steps[:, None]
            * ((1 - steps)[:, None, None] * (fourth - first) + steps[:, None, None] * (third - second))
        )
        bent = normal + _CRUMPLE * rng.normal(size=grid.shape)
        bent /= np.linalg.norm(bent, axis=2, keepdims=True)
        for vectors, target in ((grid, corners), (bent, normals)):
            tiles = [vectors[:-1, :-1], vectors[1:, :-1], vectors[1:, 1:], vectors[:-1, 1:]]
            target.append(np.stack(tiles, axis=2).reshape(-1, 4, 3))
    flat = np.repeat(plain.normals, _FOLDS**2, axis=0)
    return _uniform(frame, np.concatenate(corners), flat, np.concatenate(normals), color, _FOIL_SHINE)


def lathe(
    frame: int,
    start: ArrayLike,
    axis: ArrayLike,
    profile: Sequence[tuple[float, float]],
    colors: Color | Sequence[Color],
    sides: int = 24,
    smooth: bool = False,
) -> Mesh:
    """Surface of revolution: cylinders, cones, disks and balls.

    The profile has the height along the axis from `start` and the radius of each ring, m; the radius is 0 at
    both ends of a closed solid. Colors are one for all, or one for each band between rings. `smooth` profiles
    are curves, without edges between their bands.
    """
    along = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    across = np.cross(along, _AXES[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    angles = np.arange(sides + 1) * (2.0 * np.pi / sides)
    around = np.outer(np.cos(angles), across) + np.outer(np.sin(angles), np.cross(along, across))
    heights, radii = np.array(profile).T
    rings = np.asarray(start) + heights[:, None, None] * along + radii[:, None, None] * around
    # Components of each band's normal away from the axis and along it, at its lower and at its upper ring.
    tilt = np.stack([np.diff(heights), -np.diff(radii)], axis=1)
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    tilts = np.stack([tilt, tilt])
    if smooth:
        at_rings = np.vstack([tilt[:1], tilt[:-1] + tilt[1:], tilt[-1:]])
        at_rings[radii < 1e-9 * radii.max(), 0] = 0.0  # at a pole, where the bands meet in one direction
        at_rings /= np.linalg.norm(at_rings, axis=1, keepdims=True)
        tilts = np.stack([at_rings[:-1], at_rings[1:]])
    lower, upper = tilts[..., 0, None, None] * around + tilts[..., 1, None, None] * along
    corners = _quadrilaterals(rings[:-1], rings[1:])
    # With the rings counterclockwise about the axis, the diagonals turn outward.
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bands = len(profile) - 1
    per_band = np.repeat(np.broadcast_to(np.array(colors), (bands, 3)), sides, axis=0)
    return _uniform(frame, corners, normals, _quadrilaterals(lower, upper), per_band, SHINE)


def _quadrilaterals(lower: Array, upper: Array) -> Array:
    """Vectors at lower and upper ring of each band, (bands, sides + 1, 3), by face, (bands * sides, 4, 3)."""
    corners = [lower[:, :-1], lower[:, 1:], upper[:, 1:], upper[:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def cylinder(
    frame: int, start: ArrayLike, end: ArrayLike, radius: float, color: Color, sides: int = 24
) -> Mesh:
    """Cylinder between two points, m."""
    axis = np.asarray(end, dtype=np.float64) - np.asarray(start)
    length = float(np.linalg.norm(axis))
    return lathe(
        frame, start, axis, [(0.0, 0.0), (0.0, radius), (length, radius), (length, 0.0)], color, sides
    )


def ball(frame: int, center: ArrayLike, radius: float, color: Color, sides: int = 24) -> Mesh:
    """Ball around a center, m."""
    latitudes = np.linspace(-0.5 * np.pi, 0.5 * np.pi, sides // 2 + 1)
    profile = [(radius * float(np.sin(angle)), radius * float(np.cos(angle))) for angle in latitudes]
    return lathe(frame, center, _AXES[2], profile, color, sides, smooth=True)
