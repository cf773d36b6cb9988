"""Which face is seen in which pixel: coverage of pixel centers and a depth buffer, in array operations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_SMALLEST_AREA = 1e-6  # pixels^2; a face seen edge-on covers no pixel center
_FACE_BITS = 2**24 - 1  # room for 16 million faces, and for depths that differ by a part in 10^8


def nearest_faces(corners: Array, width: int, height: int) -> Integers:
    """Find the nearest face in every pixel.

    Faces may intersect, overlap in any order and reach out of the picture.

    Args:
        corners: x, y [pixels] and inverse depth [1/m] of the corners of convex planar faces, in order either
            way around, shape (faces, 4, 3); neighboring corners may be equal. A face with a NaN is not drawn.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.

    Returns:
        Number of the nearest face plus one where there is one, 0 elsewhere, shape (height, width).
    """
    # In a perspective picture the inverse depth of a plane is an affine function of x and y.
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    drawn = np.flatnonzero(np.abs(normal[:, 2]) > _SMALLEST_AREA)
    corners, normal = corners[drawn], normal[drawn]
    gradient = -normal[:, :2] / normal[:, 2:]
    at_origin = corners[:, 0, 2] - np.sum(gradient * corners[:, 0, :2], axis=1)

    face, row = _rows(corners, height)
    left, right = _spans(corners, normal[:, 2] > 0.0, face, row)
    first = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
    last = np.clip(np.ceil(right - 0.5), 0, width).astype(np.int64)
    span, column = _ranges(first, last)
    slope = gradient[face, 0]
    in_row = at_origin[face] + gradient[face, 1] * (row + 0.5) + 0.5 * slope
    inverse_depth = in_row[span] + slope[span] * column

    # Positive floats are ordered as their bits are. With the face in the lowest bits, one maximum finds both.
    nearness = (inverse_depth.view(np.int64) & ~_FACE_BITS) | (drawn[face] + 1)[span]
    buffer = np.zeros(height * width, dtype=np.int64)
    np.maximum.at(buffer, (row * width)[span] + column, nearness)
    return (buffer & _FACE_BITS).reshape(height, width)


def _rows(corners: Array, height: int) -> tuple[Integers, Integers]:
    """Pairs of a face and a row of the picture that it may cover."""
    first = np.clip(np.ceil(corners[..., 1].min(axis=1) - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.ceil(corners[..., 1].max(axis=1) - 0.5), 0, height).astype(np.int64)
    return _ranges(first, last)


def _ranges(first: Integers, last: Integers) -> tuple[Integers, Integers]:
    """All integers of the ranges first[i] .. last[i] - 1: the i of each, and the integer."""
    counts = np.maximum(last - first, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = first - (np.cumsum(counts) - counts)
    return owner, np.arange(len(owner)) + offset[owner]


def _spans(
    corners: Array, turns_positive: NDArray[np.bool_], face: Integers, row: Integers
) -> tuple[Array, Array]:
    """Where the middle of each row enters and leaves its face: every edge bounds x from one side."""
    start, end = corners[..., :2], np.roll(corners[..., :2], -1, axis=1)
    step = end - start
    climbs = step[..., 1] != 0.0
    slope = np.divide(step[..., 0], step[..., 1], out=np.zeros(climbs.shape), where=climbs)
    at_zero = start[..., 0] - slope * start[..., 1]
    is_left = (step[..., 1] < 0.0) == turns_positive[:, None]
    left = np.where(climbs & is_left, at_zero, -np.inf)
    right = np.where(climbs & ~is_left, at_zero, np.inf)
    crossing = slope[face] * (row[:, None] + 0.5)
    return (left[face] + crossing).max(axis=1), (right[face] + crossing).min(axis=1)
