"""The shapes that a scene gives for its bodies, as solids."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene.shapes import COLORS, Shape, color_of
from dq_space_arm_env.viewing.rendering.solids import SHINE, Color, Mesh, box, crumpled_box, cylinder

Array = NDArray[np.float64]

_SIDES = 36  # of a cylinder, which may be as large as a spacecraft
_MARGIN = 0.05  # of the size of shapes, between them and the border of the picture
_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_SHINE = {COLORS["cells"]: 0.7}


def shape_meshes(frame: int, shapes: Sequence[Shape], color: Color) -> Iterator[Mesh]:
    """Turn shapes into solids; boxes in foil are crumpled.

    Args:
        frame: Number of the frame that carries them.
        shapes: The shapes.
        color: Color of those that name none, red, green, blue, 0 to 1.

    Yields:
        A solid for each shape.
    """
    for shape in shapes:
        own = color_of(shape, color)
        axes, center = np.array(shape.pose.rotation_matrix), np.array(shape.pose.position)
        if shape.cylinder is not None:
            half = 0.5 * shape.cylinder.length * axes[:, 2]
            yield cylinder(frame, center - half, center + half, shape.cylinder.radius, own, _SIDES)
        elif own == COLORS["foil"]:
            yield crumpled_box(frame, center, shape.edges, own, axes)
        else:
            yield box(frame, center, shape.edges, own, axes, _SHINE.get(own, SHINE))


def corners_of(shapes: Sequence[Shape]) -> Array:
    """Find the corners of shapes, of cylinders those of the boxes around them.

    Args:
        shapes: The shapes.

    Returns:
        Corners in the frame of the body, shape (8 * shapes, 3), m.
    """
    corners = [np.empty((0, 3))]
    for shape in shapes:
        inner = 0.5 * _SIGNS * np.array(shape.edges)
        corners.append(inner @ np.array(shape.pose.rotation_matrix).T + np.array(shape.pose.position))
    return np.concatenate(corners)


def balls_around(
    shapes: Sequence[Shape], pose: Sequence[float], turn: float = 0.0, shift: float = 0.0
) -> Iterator[tuple[Array, float]]:
    """Find balls around the corners of shapes, which keep the shapes in view.

    Args:
        shapes: The shapes.
        pose: Pose of their body in the inertial frame, shape (8,), real part dimensionless, dual part m.
        turn: Largest angle by which the body may be turned from there, rad.
        shift: Largest distance by which it may be moved, m.

    Yields:
        Center, shape (3,), m, and radius, m, of each ball.
    """
    matrix, origin = poses.to_matrix(tuple(pose))
    corners = corners_of(shapes)
    chord = 2.0 * math.sin(0.5 * min(turn, math.pi))
    for corner in corners:
        radius = (
            shift + chord * float(np.linalg.norm(corner)) + _MARGIN * float(np.ptp(corners, axis=0).max())
        )
        yield np.array(origin) + np.array(matrix) @ corner, radius
