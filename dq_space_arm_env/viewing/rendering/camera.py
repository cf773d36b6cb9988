"""A perspective camera, and its placement such that given balls are in view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.viewing.picture_format import PictureFormat, View

Array = NDArray[np.float64]

SUN = np.array([-0.50, -0.66, -0.56])
"""Direction toward the sun in camera axes (right, down, forward): over the left shoulder."""

_DEFAULT_VIEW = View(azimuth=190.0, elevation=-22.0)
# A planar scene is seen from straight above, x to the right and y up.
_PLANAR_VIEW = View(azimuth=90.0, elevation=-90.0)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; in the picture x points right and y down from the upper left corner."""

    position: Array  # in the inertial frame, shape (3,), m
    axes: Array  # right, down, forward as rows in inertial axes, shape (3, 3)
    focal_length: float  # pixels
    width: int  # pixels
    height: int  # pixels

    def project(self, points: Array) -> Array:
        """Project points (..., 3), m, to x, y [pixels] and inverse depth [1/m]; NaN behind the camera."""
        seen = (points - self.position) @ self.axes.T
        depth = seen[..., 2:]
        inverse_depth = 1.0 / np.where(depth > 0.0, depth, np.nan)
        plane = self.focal_length * seen[..., :2] * inverse_depth
        return np.concatenate([plane + 0.5 * np.array([self.width, self.height]), inverse_depth], axis=-1)


def camera_of(region: tuple[Array, Array], is_planar: bool, picture: PictureFormat) -> Camera:
    """Place a scene's camera by the region of its `SpacecraftModel`; a picture's own view comes first."""
    given = {key: value for key, value in picture.view._asdict().items() if value is not None}
    view = (_PLANAR_VIEW if is_planar else _DEFAULT_VIEW)._replace(**given)
    return camera_around(*region, view, picture.width, picture.height)


def camera_around(
    centers: ArrayLike,
    radii: ArrayLike,
    view: View,
    width: int,
    height: int,
    field_of_view: float = math.radians(30.0),
) -> Camera:
    """Place a camera that looks in a given direction as close as possible with all balls in view.

    Balls have centers (balls, 3) and radii (balls,), m, in the inertial frame. The view has an azimuth and an
    elevation; its point and distance, where given, take precedence over the balls: a camera aimed at a point
    moves back until all are in view. `field_of_view` is the angle between the lower and the upper edge of the
    picture, rad.
    """
    if view.azimuth is None or view.elevation is None:
        raise ValueError(f"view: {view}, should have azimuth and elevation, deg")
    azimuth, elevation = math.radians(view.azimuth), math.radians(view.elevation)
    sine, cosine = math.sin(azimuth), math.cos(azimuth)
    right = np.array([sine, -cosine, 0.0])
    forward = np.array([math.cos(elevation) * cosine, math.cos(elevation) * sine, math.sin(elevation)])
    axes = np.array([right, np.cross(forward, right), forward])
    balls = np.asarray(centers, dtype=np.float64) @ axes.T
    focal_length = 0.5 * height / math.tan(0.5 * field_of_view)
    sizes = np.asarray(radii, dtype=np.float64)
    if view.lookat is None:
        position = _closest(balls, sizes, width, height, focal_length)
        depth = balls[:, 2].mean()
    else:
        point = axes @ np.array(view.lookat)
        depth = point[2]
        # A ball about the point itself, which the camera must not pass.
        balls, sizes = np.vstack([balls, point]), np.append(sizes, sizes.min())
        position = _closest(balls, sizes, width, height, focal_length, point)
    if view.distance is not None:
        position[2] = depth - view.distance
    return Camera(position @ axes, axes, focal_length, width, height)


def _closest(
    balls: Array, radii: Array, width: int, height: int, focal_length: float, aim: Array | None = None
) -> Array:
    """Closest position, in the camera's own axes, with all balls in view, and a given point in the center."""
    position = np.empty(3)
    depths = []
    for axis, half_size in ((0, 0.5 * width), (1, 0.5 * height)):
        # The planes through the camera and two opposite edges of the picture keep a ball between them if
        # tangent * (its depth - the camera's) +- (its center - the camera's) >= radius / cos(half angle).
        tangent = half_size / focal_length
        reach = radii * math.hypot(1.0, tangent)
        low = np.min(tangent * balls[:, 2] + balls[:, axis] - reach)
        high = np.min(tangent * balls[:, 2] - balls[:, axis] - reach)
        position[axis] = 0.5 * (low - high) if aim is None else aim[axis]
        depths.append(min(low - position[axis], high + position[axis]) / tangent)
    position[2] = min(depths)
    return position
