"""Solids with flat faces: boxes and surfaces of revolution, each fixed in one frame of the robot.

A `Mesh` is a list of convex planar quadrilaterals. A triangle is one with two equal corners, so that one
array holds them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Color = tuple[float, float, float]  # red, green, blue, 0 to 1

_AXES = np.eye(3)


@dataclass(frozen=True)
class Mesh:
    """Faces, each fixed in a frame.

    Attributes:
        corners: Corners in the face's frame, in order around the face, shape (faces, 4, 3), m.
        normals: Outward unit normals in the face's frame, shape (faces, 3).
        colors: Red, green, blue, 0 to 1, shape (faces, 3).
        frames: Number of the frame that carries the face, shape (faces,).
    """

    corners: Array
    normals: Array
    colors: Array
    frames: NDArray[np.intp]

    @classmethod
    def joined(cls, meshes: Iterable[Mesh]) -> Mesh:
        """Put meshes together.

        Args:
            meshes: At least one mesh.

        Returns:
            One mesh with all faces, in the order given.
        """
        parts = list(meshes)
        return cls(
            np.concatenate([part.corners for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.colors for part in parts]),
            np.concatenate([part.frames for part in parts]),
        )

    def placed(self, rotations: Array, positions: Array) -> tuple[Array, Array]:
        """Take all faces to inertial axes.

        Args:
            rotations: Rotation matrix of each frame, shape (frames, 3, 3).
            positions: Origin of each frame in the inertial frame, shape (frames, 3), m.

        Returns:
            Corners, shape (faces, 4, 3), m, and normals, shape (faces, 3), in the inertial frame.
        """
        rotation = rotations[self.frames]
        corners = self.corners @ rotation.transpose(0, 2, 1) + positions[self.frames][:, None]
        return corners, np.einsum("fij,fj->fi", rotation, self.normals)


def box(frame: int, center: ArrayLike, size: ArrayLike, color: Color, axes: ArrayLike = _AXES) -> Mesh:
    """Make a box.

    Args:
        frame: Number of the frame that carries it.
        center: Center in that frame, shape (3,), m.
        size: Edge lengths along the box's axes, shape (3,), m.
        color: Its color.
        axes: The box's axes as orthonormal columns in that frame, shape (3, 3).

    Returns:
        Mesh of 6 faces.
    """
    square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    corners, normals = np.empty((6, 4, 3)), np.zeros((6, 3))
    for face in range(6):
        axis, side = face % 3, 1.0 - 2.0 * (face // 3)
        corners[face] = np.insert(square, axis, side, axis=1)
        normals[face, axis] = side
    columns = np.asarray(axes, dtype=np.float64)
    corners = 0.5 * corners * np.asarray(size) @ columns.T + np.asarray(center)
    return Mesh(corners, normals @ columns.T, np.tile(color, (6, 1)), np.full(6, frame))


def lathe(
    frame: int,
    start: ArrayLike,
    axis: ArrayLike,
    profile: Sequence[tuple[float, float]],
    colors: Color | Sequence[Color],
    sides: int = 24,
) -> Mesh:
    """Turn a profile around an axis: cylinders, cones, disks and balls.

    Args:
        frame: Number of the frame that carries the solid.
        start: Point on the axis from which heights are measured, shape (3,), m.
        axis: Direction of the axis, any nonzero length, shape (3,).
        profile: Height along the axis and radius of each ring, m; 0 at both ends of a closed solid.
        colors: One color, or one for each of the bands between the rings.
        sides: Number of faces around the axis.

    Returns:
        Mesh of (rings - 1) * sides faces.
    """
    along = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    across = np.cross(along, _AXES[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    angles = np.arange(sides + 1) * (2.0 * np.pi / sides)
    around = np.outer(np.cos(angles), across) + np.outer(np.sin(angles), np.cross(along, across))
    heights, radii = np.array(profile).T
    rings = np.asarray(start) + heights[:, None, None] * along + radii[:, None, None] * around
    corners = np.stack([rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]], axis=2).reshape(
        -1, 4, 3
    )
    # With the rings counterclockwise about the axis, the diagonals turn outward.
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bands = len(profile) - 1
    per_band = np.broadcast_to(np.array(colors), (bands, 3))
    return Mesh(corners, normals, np.repeat(per_band, sides, axis=0), np.full(bands * sides, frame))


def cylinder(
    frame: int, start: ArrayLike, end: ArrayLike, radius: float, color: Color, sides: int = 24
) -> Mesh:
    """Make a cylinder between two points.

    Args:
        frame: Number of the frame that carries it.
        start: Center of one end in that frame, shape (3,), m.
        end: Center of the other end, not the same point, shape (3,), m.
        radius: Radius, m.
        color: Its color.
        sides: Number of faces around the axis.

    Returns:
        Closed mesh.
    """
    axis = np.asarray(end, dtype=np.float64) - np.asarray(start)
    length = float(np.linalg.norm(axis))
    return lathe(
        frame, start, axis, [(0.0, 0.0), (0.0, radius), (length, radius), (length, 0.0)], color, sides
    )


def ball(frame: int, center: ArrayLike, radius: float, color: Color, sides: int = 24) -> Mesh:
    """Make a ball.

    Args:
        frame: Number of the frame that carries it.
        center: Center in that frame, shape (3,), m.
        radius: Radius, m.
        color: Its color.
        sides: Number of faces around the equator; half as many from pole to pole.

    Returns:
        Closed mesh.
    """
    latitudes = np.linspace(-0.5 * np.pi, 0.5 * np.pi, sides // 2 + 1)
    profile = [(radius * float(np.sin(angle)), radius * float(np.cos(angle))) for angle in latitudes]
    return lathe(frame, center, _AXES[2], profile, color, sides)
