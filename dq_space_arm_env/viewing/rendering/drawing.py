"""Lit faces in the picture from solids and a trail, and the sky behind them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.viewing.rendering.camera import SUN, Camera
from dq_space_arm_env.viewing.rendering.rasterizer import Faces
from dq_space_arm_env.viewing.rendering.solids import Mesh

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Directions toward the lights in camera axes (right, down, forward), and their strengths: the sun over the
# left shoulder, and the light of the Earth below on the right. They move with the camera.
_SUN_STRENGTH = 0.70
_EARTH, _EARTH_STRENGTH = np.array([0.74, 0.52, -0.42]), 0.22
_AMBIENT = 0.38
_SHARPNESS = 5  # of a reflection: number of times the cosine is squared
_NEAREST = 1e-3  # m; nearer to the camera's plane nothing is seen

_TRAIL_OLD, _TRAIL_NEW = np.array((0.22, 0.20, 0.24)), np.array((1.0, 0.66, 0.22))
_TRAIL_WIDTH = 2.6 / 480  # of the picture's height
_TRAIL_STEP = 1.5 / 480  # between the drawn points of the trail, of the picture's height

_SKY_TOP, _SKY_BOTTOM = np.array((7.0, 9.0, 19.0)), np.array((14.0, 19.0, 36.0))
# Center of the Earth's disk, of the picture's width and height; its radius and the height of the air over it,
# of the picture's height; the colors of air and sea in full light.
_EARTH_CENTER, _EARTH_RADIUS, _AIR_HEIGHT = (0.62, 3.02), 2.16, 0.020
_AIR, _SEA = np.array((70.0, 128.0, 205.0)), np.array((9.0, 26.0, 58.0))
_STARS_PER_PIXEL = 6e-4
_STARS_SEED = 2018
_BAND = 1 << 16  # pixels of the sky that are painted at a time


def mesh_faces(mesh: Mesh, rotations: Array, positions: Array, camera: Camera) -> Faces:
    """Project and light the faces toward the camera, given rotation and position (m) of each frame."""
    halfway = SUN + np.array([0.0, 0.0, -1.0])
    directions = np.array([SUN, _EARTH, halfway / np.linalg.norm(halfway)]) @ camera.axes
    parts: list[Array] = []
    cosines: list[Array] = []
    shown: list[NDArray[np.intp]] = []
    # Frame by frame, in axes of the frame: light and camera are turned instead of all faces.
    for frame, faces in mesh.ranges:
        rotation, position = rotations[frame], positions[frame]
        toward_camera = (camera.position - position) @ rotation - mesh.corners[faces, 0]
        # False for NaN, from a diverged simulation.
        facing = np.flatnonzero(np.einsum("fi,fi->f", mesh.normals[faces], toward_camera) > 0.0)
        facing += faces.start
        shown.append(facing)
        parts.append(mesh.corners[facing] @ rotation.T + position)
        cosines.append(mesh.corner_normals[facing] @ (directions @ rotation).T)
    indices = np.concatenate(shown)
    sun, earth, reflected = np.moveaxis(np.maximum(np.concatenate(cosines), 0.0), 2, 0)
    light = _AMBIENT + _SUN_STRENGTH * sun + _EARTH_STRENGTH * earth
    for _ in range(_SHARPNESS):
        reflected = reflected * reflected
    glint = mesh.shine[indices, None] * reflected
    colors = mesh.colors[indices, None] * light[..., None] + glint[..., None]
    return _seen(np.concatenate(parts), colors, mesh.sieved[indices], camera)


def _seen(corners: Array, colors: Array, sieved: NDArray[np.bool_], camera: Camera) -> Faces:
    """Project faces, clipped at the plane of the camera."""
    projected = camera.project(corners)
    lost = ~(projected[..., 2] < 1.0 / _NEAREST)  # true for NaN
    cut = np.flatnonzero(lost.any(axis=1) & ~lost.all(axis=1))
    if not len(cut):
        return Faces(projected, colors, sieved)
    whole = np.flatnonzero(~lost.any(axis=1))
    outlines: list[Array] = []
    origins: list[int] = []
    for face in cut:
        for triangle in ([0, 1, 2], [0, 2, 3]):
            outlines.append(_in_front(corners[face, triangle], colors[face, triangle], camera))
            origins.append(int(face))
    parts = np.array(outlines)
    return Faces(
        np.concatenate([projected[whole], camera.project(parts[..., :3])]),
        np.concatenate([colors[whole], parts[..., 3:]]),
        np.concatenate([sieved[whole], sieved[origins]]),
    )


def _in_front(corners: Array, colors: Array, camera: Camera) -> Array:
    """Clip a triangle at the plane of the camera: positions and colors of 4 corners, (4, 6), or NaN."""
    heights = (corners - camera.position) @ camera.axes[2] - _NEAREST
    points = np.hstack([corners, colors])
    outline: list[Array] = []
    for here, there in ((0, 1), (1, 2), (2, 0)):
        if heights[here] >= 0.0:
            outline.append(points[here])
        if heights[here] * heights[there] < 0.0:
            share = heights[here] / (heights[here] - heights[there])
            outline.append(points[here] + share * (points[there] - points[here]))
    # A clipped triangle has 3 or 4 corners; neighbors may be equal.
    return np.array([*outline, *outline[-1:] * (4 - len(outline))] or np.full((4, 6), np.nan))


def trail_faces(trail: Array, camera: Camera) -> Faces:
    """Ribbon of constant width in the picture along past positions (m, 3), m, older ones fainter."""
    points = camera.project(trail)
    points = points[np.isfinite(points).all(axis=1)]
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0, prepend=points[:1, :2]), axis=1)
    marks = np.floor(steps.cumsum() / (_TRAIL_STEP * camera.height))
    points = points[np.diff(marks, prepend=-1.0) > 0.0]
    if len(points) < 2:
        return Faces(np.empty((0, 4, 3)), np.empty((0, 4, 3)), np.empty(0, dtype=np.bool_))
    along = np.gradient(points[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = np.zeros_like(points)
    half[:, :2] = 0.5 * _TRAIL_WIDTH * camera.height * along[:, ::-1] * (-1.0, 1.0)
    one, other = points + half, points - half
    corners = np.stack([one[:-1], one[1:], other[1:], other[:-1]], axis=1)
    youth = np.linspace(0.0, 1.0, len(points) - 1)[:, None, None]
    colors = np.repeat(_TRAIL_OLD + youth * (_TRAIL_NEW - _TRAIL_OLD), 4, axis=1)
    return Faces(corners, colors, np.zeros(len(corners), dtype=np.bool_))


def paint_sky(width: int, height: int) -> Image:
    """Stars, and the Earth's limb below: the same for every picture of a size."""
    rng = np.random.default_rng(_STARS_SEED)
    count = round(_STARS_PER_PIXEL * width * height)
    rows, columns = rng.integers(height, size=count), rng.integers(width, size=count)
    brightness = 25.0 + 200.0 * rng.random(count) ** 5
    tint = 1.0 + rng.uniform(-0.12, 0.12, (count, 1)) * np.array((1.0, 0.0, -1.0))
    stars = brightness[:, None] * tint
    down = np.linspace(0.0, 1.0, height)[:, None, None]
    x = np.arange(width) / height
    day = np.clip(1.15 - 0.85 * x[:, None] * height / width, 0.0, 1.0)
    picture: Image = np.empty((height, width, 3), dtype=np.uint8)
    # In bands, as its numbers take fifty times the memory of the picture.
    step = max(1, _BAND // width)
    for top in range(0, height, step):
        band = slice(top, min(top + step, height))
        sky = np.repeat(_SKY_TOP + down[band] * (_SKY_BOTTOM - _SKY_TOP), width, axis=1)
        own = (rows >= band.start) & (rows < band.stop)
        sky[rows[own] - top, columns[own]] += stars[own]
        # Distance from the Earth's limb, of the picture's height, positive outside.
        y = np.arange(band.start, band.stop)[:, None] / height
        above = np.hypot(x - _EARTH_CENTER[0] * width / height, y - _EARTH_CENTER[1]) - _EARTH_RADIUS
        above = above[..., None]
        inside = np.maximum(-above, 0.0)
        earth = day * (_AIR * 0.62 * np.exp(-inside / 0.05) + _SEA)
        air = day * _AIR * np.exp(-np.maximum(above, 0.0) / _AIR_HEIGHT)
        cover = np.clip(0.5 - above * height, 0.0, 1.0)
        sky = (1.0 - cover) * (sky + air) + cover * earth
        # Noise of half a step hides the banding of so slow a gradient.
        noisy = np.floor(sky + rng.random((len(sky), width, 1)))
        picture[band] = np.clip(noisy, 0.0, 255.0)
    return picture
