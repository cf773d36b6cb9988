"""A perspective camera, and where it has to stand so that given balls are in view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.environment.picture_format import View

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; x of the picture goes right, y down, the origin is the upper left corner.

    Attributes:
        position: Where it stands in the inertial frame, shape (3,), m.
        axes: Its right, down and forward directions as rows in inertial axes, shape (3, 3).
        focal_length: Focal length, pixels.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
    """

    position: Array
    axes: Array
    focal_length: float
    width: int
    height: int

    def project(self, points: Array) -> Array:
        """Find where points appear.

        Args:
            points: Points in the inertial frame, shape (..., 3), m.

        Returns:
            x, y [pixels] and inverse depth [1/m], shape (..., 3); NaN for what is not in front of the camera.
        """
        seen = (points - self.position) @ self.axes.T
        depth = seen[..., 2:]
        inverse_depth = 1.0 / np.where(depth > 0.0, depth, np.nan)
        plane = self.focal_length * seen[..., :2] * inverse_depth
        return np.concatenate([plane + 0.5 * np.array([self.width, self.height]), inverse_depth], axis=-1)


def camera_around(
    centers: ArrayLike,
    radii: ArrayLike,
    view: View,
    width: int,
    height: int,
    field_of_view: float = math.radians(30.0),
) -> Camera:
    """Place a camera that looks in a given direction as close as it can with all of the given balls in view.

    Args:
        centers: Centers of the balls in the inertial frame, shape (balls, 3), m.
        radii: Their radii, shape (balls,), m.
        view: Direction in which it looks, azimuth and elevation not None; and, where they are not None, the
            point that it looks at and the distance from there, whatever is in view then.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        field_of_view: Angle between the lower and the upper edge of the picture, rad.

    Returns:
        The camera.

    Raises:
        ValueError: If the view has no direction.
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
    position = _closest(balls, np.asarray(radii, dtype=np.float64), width, height, focal_length)
    distance = view.distance
    if distance is None:
        distance = float(balls[:, 2].mean() - position[2])
    if view.lookat is not None:
        position = axes @ np.array(view.lookat) - (0.0, 0.0, distance)
    elif view.distance is not None:
        position[2] = balls[:, 2].mean() - distance
    return Camera(position @ axes, axes, focal_length, width, height)


def _closest(balls: Array, radii: Array, width: int, height: int, focal_length: float) -> Array:
    """Where, in its own axes, a camera has all balls in view and is as close as it can be."""
    position = np.empty(3)
    depths = []
    for axis, half_size in ((0, 0.5 * width), (1, 0.5 * height)):
        # The planes through the camera and two opposite edges of the picture keep a ball between them if
        # tangent * (its depth - the camera's) +- (its center - the camera's) >= radius / cos(half angle).
        tangent = half_size / focal_length
        reach = radii * math.hypot(1.0, tangent)
        low = np.min(tangent * balls[:, 2] + balls[:, axis] - reach)
        high = np.min(tangent * balls[:, 2] - balls[:, axis] - reach)
        position[axis] = 0.5 * (low - high)
        depths.append(0.5 * (low + high) / tangent)
    position[2] = min(depths)
    return position
