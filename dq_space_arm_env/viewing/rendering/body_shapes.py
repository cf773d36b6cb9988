"""The shapes that a scene gives for its bodies, as solids."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.scene.shapes import COLORS, Shape, color_of
from dq_space_arm_env.viewing.rendering.solids import SHINE, Color, Mesh, box, crumpled_box, cylinder

Array = NDArray[np.float64]

_SIDES = 36  # of a cylinder, which may be as large as a spacecraft
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
        elif shape.box is not None and own == COLORS["foil"]:
            yield crumpled_box(frame, center, shape.box, own, axes)
        elif shape.box is not None:
            yield box(frame, center, shape.box, own, axes, _SHINE.get(own, SHINE))


def extent_of(shapes: Sequence[Shape]) -> tuple[Array, Array]:
    """Find the box around shapes along the axes of their body.

    Args:
        shapes: One or more.

    Returns:
        Its smallest and its largest coordinates in the frame of the body, shape (3,) each, m.
    """
    lows, highs = [], []
    for shape in shapes:
        axes, center = np.array(shape.pose.rotation_matrix), np.array(shape.pose.position)
        if shape.cylinder is not None:
            along = axes[:, 2]
            # A disk across a unit vector a reaches sqrt(1 - a_i^2) of its radius along axis i.
            disk = shape.cylinder.radius * np.sqrt(np.maximum(1.0 - along**2, 0.0))
            reach = disk + 0.5 * shape.cylinder.length * np.abs(along)
        else:
            reach = 0.5 * np.abs(axes) @ np.array(shape.box)
        lows.append(center - reach)
        highs.append(center + reach)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def reach_of(shapes: Sequence[Shape]) -> float:
    """Bound the distance of shapes from the origin of their body's frame, m; 0 without shapes."""
    if not shapes:
        return 0.0
    low, high = extent_of(shapes)
    return float(np.linalg.norm(np.maximum(-low, high)))
