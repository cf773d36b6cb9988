"""The rasterizer: edges, depth and color of faces as affine functions of x and y, filled by machine code.

A depth buffer decides visibility sample by sample, so bodies may intersect and overlap in any order; a pixel
is the mean of its samples, which smooths the edges.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.viewing.rendering.depth_buffer import FACE_COLUMNS, LANES, fill_kernel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_SMALLEST_AREA = 1e-6  # pixels^2; a face seen edge-on covers no sample
_FLATTEST = 1e-2  # pixels^2, added to a face's second moments: the colors of a sliver need no gradient across


class Faces(NamedTuple):
    """Convex planar quadrilaterals in the picture; one with a corner that is not finite is not drawn."""

    # x, y [pixels] and inverse depth [1/m] of corners in order, either way around; neighbors may be equal.
    corners: Array  # shape (faces, 4, 3)
    colors: Array  # red, green, blue at the corners, 0 to 1, shape (faces, 4, 3)
    # whether a face covers only every other sample and so looks transparent, shape (faces,)
    sieved: NDArray[np.bool_]


class Rasterizer:
    """Draws faces into pictures of one size.

    Attributes:
        width: Width of the pictures, pixels.
        height: Height of the pictures, pixels.
    """

    def __init__(self, width: int, height: int, samples: int = 3) -> None:
        """Compile the kernel for `samples` per pixel and direction, 1 to 15, or take it from the cache."""
        self.width, self.height, self._samples = width, height, samples
        self._kernel = fill_kernel(samples)
        stride = -(-samples * width // LANES) * LANES
        self._keys = np.zeros((samples, stride), dtype=np.uint64)

    def draw(self, faces: Faces, image: Image) -> None:
        """Draw faces over an image, C-contiguous, shape (height, width, 3), in place."""
        if image.shape != (self.height, self.width, 3) or not image.flags.c_contiguous:
            raise ValueError(
                f"image: shape {image.shape}, should be ({self.height}, {self.width}, 3), C-contiguous"
            )
        scale = np.array([self._samples, self._samples, 1.0])
        rows, numbers = _prepared(faces, scale, self._samples * self.height)
        arrays = rows, numbers, self._keys, image
        buffers = (ctypes.c_int64 * 7)(
            *(array.ctypes.data for array in arrays), len(rows), self._keys.shape[1], self.width
        )
        self._kernel.function(0, self.height, ctypes.addressof(buffers))


def _prepared(faces: Faces, scale: Array, height: int) -> tuple[NDArray[np.int32], Array]:
    """Rows of samples of each face, (m, 2), and its numbers as the kernel reads them, (m, FACE_COLUMNS)."""
    corners = faces.corners * scale
    # In a perspective picture the inverse depth of a plane is an affine function of x and y.
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    drawn = np.flatnonzero(np.isfinite(normal).all(axis=1) & (np.abs(normal[:, 2]) > _SMALLEST_AREA))
    corners, normal = corners[drawn], normal[drawn]
    x, y, inverse_depth = np.moveaxis(corners, 2, 0)
    rows = np.empty((len(drawn), 2), dtype=np.int32)
    rows[:, 0] = np.clip(np.ceil(y.min(axis=1) - 0.5), 0, height)
    rows[:, 1] = np.clip(np.ceil(y.max(axis=1) - 0.5), 0, height)

    numbers = np.empty((len(drawn), FACE_COLUMNS))
    numbers[:, 0:16] = _sides(x, y, normal[:, 2] > 0.0)
    gradient = -normal[:, :2] / normal[:, 2:]
    numbers[:, 16] = inverse_depth[:, 0] - gradient[:, 0] * x[:, 0] - gradient[:, 1] * y[:, 0]
    numbers[:, 17], numbers[:, 18] = gradient[:, 1], gradient[:, 0]
    numbers[:, 19:28] = _color_functions(x, y, 255.0 * faces.colors[drawn])
    numbers[:, 28] = faces.sieved[drawn]
    return rows, numbers


def _sides(x: Array, y: Array, turns_positive: NDArray[np.bool_]) -> Array:
    """Bounds of x from the left and from the right in a row: value at row 0 and slope per edge, (m, 16).

    Every edge bounds it from one side; on the other its value is infinite.
    """
    across, down = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    climbs = down != 0.0
    slope = np.divide(across, down, out=np.zeros_like(down), where=climbs)
    at_zero = x - slope * y
    is_left = (down < 0.0) == turns_positive[:, None]
    sides = np.zeros((len(x), 2, 4, 2))
    for side, is_bound, unbounded in ((0, is_left, -np.inf), (1, ~is_left, np.inf)):
        is_bound = is_bound & climbs
        sides[:, side, :, 0] = np.where(is_bound, at_zero, unbounded)
        sides[:, side, :, 1] = np.where(is_bound, slope, 0.0)
    return sides.reshape(-1, 16)


def _color_functions(x: Array, y: Array, colors: Array) -> Array:
    """The affine functions of x and y nearest to the corners' colors: value at 0, d/dy, d/dx, (m, 9)."""
    middle_x, middle_y = x.mean(axis=1), y.mean(axis=1)
    right, down = x - middle_x[:, None], y - middle_y[:, None]
    mean = colors.mean(axis=1)
    along_x = np.einsum("fc,fck->fk", right, colors)
    along_y = np.einsum("fc,fck->fk", down, colors)
    xx = np.einsum("fc,fc->f", right, right) + _FLATTEST
    yy = np.einsum("fc,fc->f", down, down) + _FLATTEST
    xy = np.einsum("fc,fc->f", right, down)
    determinant = (xx * yy - xy * xy)[:, None]
    d_dx = (yy[:, None] * along_x - xy[:, None] * along_y) / determinant
    d_dy = (xx[:, None] * along_y - xy[:, None] * along_x) / determinant
    at_zero = mean - d_dx * middle_x[:, None] - d_dy * middle_y[:, None]
    return np.stack([at_zero, d_dy, d_dx], axis=2).reshape(-1, 9)
