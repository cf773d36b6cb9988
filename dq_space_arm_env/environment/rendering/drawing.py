"""From solids and a trail to colored faces in the picture, and from those to pixels.

Pictures are drawn with `OVERSAMPLING` subpixels per pixel and direction, and each pixel is their mean: that
smooths the edges. A subpixel's color is packed into one number, its bytes red, green, blue, 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.environment.rendering.camera import Camera
from dq_space_arm_env.environment.rendering.rasterizer import nearest_faces
from dq_space_arm_env.environment.rendering.solids import Mesh

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
PackedImage = NDArray[np.uint32]

OVERSAMPLING = 2

_BACKGROUND_TOP, _BACKGROUND_BOTTOM = np.array((0.975, 0.98, 0.985)), np.array((0.86, 0.875, 0.895))
_TRAIL_OLD, _TRAIL_NEW = np.array((0.95, 0.80, 0.70)), np.array((0.93, 0.36, 0.08))
_TRAIL_WIDTH = 2.5 / 480  # of the picture's height
_TRAIL_STEP = 1.5 / 480  # between the drawn points of the trail, of the picture's height

# Directions toward the lights in camera axes (right, down, forward), and their strengths.
_LIGHTS = ((np.array([-0.48, -0.70, -0.53]), 0.50), (np.array([0.80, 0.10, -0.59]), 0.18))
_AMBIENT = 0.50

_EVEN_BYTES = np.uint32(0x00FF00FF)


def mesh_faces(mesh: Mesh, rotations: Array, positions: Array, camera: Camera) -> tuple[Array, Array]:
    """Project and light the faces of closed solids that look toward the camera.

    Args:
        mesh: The solids.
        rotations: Rotation matrix of each frame, shape (frames, 3, 3).
        positions: Origin of each frame in the inertial frame, shape (frames, 3), m.
        camera: The camera.

    Returns:
        Corners as x, y [pixels] and inverse depth [1/m], shape (faces, 4, 3), and colors, 0 to 1, shape
        (faces, 3).
    """
    corners, normals = mesh.placed(rotations, positions)
    toward_camera = camera.position - corners[:, 0]
    # NaN, from a simulation that has blown up, faces nobody.
    facing = np.flatnonzero(np.einsum("fi,fi->f", normals, toward_camera) > 0.0)
    normals = normals[facing] @ camera.axes.T
    light = np.full(len(facing), _AMBIENT)
    for direction, strength in _LIGHTS:
        light += strength * np.maximum(normals @ direction, 0.0)
    return camera.project(corners[facing]), mesh.colors[facing] * light[:, None]


def trail_faces(trail: Array, camera: Camera) -> tuple[Array, Array]:
    """Make a ribbon of constant width in the picture along past positions, older ones fainter.

    Args:
        trail: Positions in the inertial frame, oldest first, shape (m, 3), m.
        camera: The camera.

    Returns:
        Corners as x, y [pixels] and inverse depth [1/m], shape (faces, 4, 3), and colors, 0 to 1, shape
        (faces, 3).
    """
    points = camera.project(trail)
    points = points[np.isfinite(points).all(axis=1)]
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0, prepend=points[:1, :2]), axis=1)
    marks = np.floor(steps.cumsum() / (_TRAIL_STEP * camera.height))
    points = points[np.diff(marks, prepend=-1.0) > 0.0]
    if len(points) < 2:
        return np.empty((0, 4, 3)), np.empty((0, 3))
    along = np.gradient(points[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = np.zeros_like(points)
    half[:, :2] = 0.5 * _TRAIL_WIDTH * camera.height * along[:, ::-1] * (-1.0, 1.0)
    one, other = points + half, points - half
    age = np.linspace(1.0, 0.0, len(points) - 1)[:, None]
    corners = np.stack([one[:-1], one[1:], other[1:], other[:-1]], axis=1)
    return corners, _TRAIL_NEW + age * (_TRAIL_OLD - _TRAIL_NEW)


def paint_background(width: int, height: int) -> PackedImage:
    """Make a vertical gradient.

    Args:
        width: Width, subpixels.
        height: Height, subpixels.

    Returns:
        Packed subpixels, shape (height, width).
    """
    down = np.linspace(0.0, 1.0, height)[:, None]
    rows = _packed(_BACKGROUND_TOP + down * (_BACKGROUND_BOTTOM - _BACKGROUND_TOP))
    return np.repeat(rows[:, None], width, axis=1)


def paint_faces(image: Image, background: PackedImage, corners: Array, colors: Array) -> None:
    """Draw faces in front of a background.

    Args:
        image: Picture of the background alone, shape (height, width, 3); the faces are drawn into it.
        background: Packed subpixels, shape (OVERSAMPLING * height, OVERSAMPLING * width).
        corners: Corners as x, y [subpixels] and inverse depth [1/m], shape (faces, 4, 3).
        colors: Colors, 0 to 1, shape (faces, 3).
    """
    # Only the part of the picture that the faces may touch is drawn anew.
    size = np.array(image.shape[1::-1])
    points = corners[..., :2].reshape(-1, 2) / OVERSAMPLING
    # fmin and fmax ignore the NaN of what is behind the camera.
    left, top = np.clip(np.floor(np.fmin.reduce(points, initial=np.inf)), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(np.fmax.reduce(points, initial=-np.inf)), 0, size).astype(int)
    if left >= right or top >= bottom:
        return
    origin = OVERSAMPLING * np.array([left, top, 0.0])
    part = background[OVERSAMPLING * top : OVERSAMPLING * bottom, OVERSAMPLING * left : OVERSAMPLING * right]
    nearest = nearest_faces(corners - origin, part.shape[1], part.shape[0])
    palette = np.concatenate([np.zeros(1, dtype=np.uint32), _packed(colors)])
    image[top:bottom, left:right] = mean_of_subpixels(np.where(nearest > 0, palette.take(nearest), part))


def mean_of_subpixels(packed: PackedImage) -> Image:
    """Average and unpack.

    Args:
        packed: Packed subpixels, shape (OVERSAMPLING * height, OVERSAMPLING * width).

    Returns:
        Picture, shape (height, width, 3).
    """
    height, width = packed.shape[0] // OVERSAMPLING, packed.shape[1] // OVERSAMPLING
    # Two of the four bytes at a time, so that each has 16 bits for its sum.
    even, odd = np.zeros((height, width), dtype=np.uint32), np.zeros((height, width), dtype=np.uint32)
    for row in range(OVERSAMPLING):
        for column in range(OVERSAMPLING):
            part = packed[row::OVERSAMPLING, column::OVERSAMPLING]
            even += part & _EVEN_BYTES
            odd += (part >> np.uint32(8)) & _EVEN_BYTES
    even //= np.uint32(OVERSAMPLING**2)
    odd //= np.uint32(OVERSAMPLING**2)
    mean = (even & _EVEN_BYTES) | ((odd & _EVEN_BYTES) << np.uint32(8))
    return mean.view(np.uint8).reshape(height, width, 4)[..., :3]


def _packed(colors: Array) -> PackedImage:
    """Colors, 0 to 1, shape (..., 3), as packed subpixels, shape (...)."""
    channels = np.zeros((*colors.shape[:-1], 4), dtype=np.uint8)
    channels[..., :3] = np.rint(255.0 * np.clip(colors, 0.0, 1.0))
    return channels.view(np.uint32)[..., 0]
