"""Size and camera placement of pictures.

The environments check these when they are created; the renderer is imported with the first picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env.common.real_arrays import real_array

LARGEST = 8192
"""Largest width and height, pixels: guards against typos that would fill the memory."""
FARTHEST = 1e6
"""Largest distance and coordinate of a camera, m: farther away no state of an episode is valid."""


class View(NamedTuple):
    """Placement of the camera; None leaves the choice to the scene."""

    azimuth: float | None = None  # of the viewing direction: angle about z from x, deg
    elevation: float | None = None  # of the viewing direction above the x-y plane, negative looking down, deg
    distance: float | None = None  # from the camera to `lookat`, m
    lookat: tuple[float, float, float] | None = None  # in the inertial frame, m

    @classmethod
    def from_config(cls, config: Mapping[str, Any] | None) -> View:
        """Check a camera configuration, some of the fields by name; ValueError if it is wrong."""
        if config is not None and not isinstance(config, Mapping):
            raise ValueError(
                f"default_camera_config: {config!r}, should be a mapping, e.g. {{'azimuth': 90}}"
            )
        values = dict(config or {})
        unknown = [key for key in values if key not in cls._fields]
        if unknown:
            raise ValueError(
                f"default_camera_config: {unknown[0]!r} is unknown; choose from {', '.join(cls._fields)}"
            )
        for key, value in values.items():
            shape = (3,) if key == "lookat" else ()
            kind = "3 finite numbers, m" if key == "lookat" else "a finite number"
            try:
                array = real_array(key, value, np.float64)
            except (TypeError, ValueError):
                array = np.full(shape, np.nan)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"default_camera_config: {key} {value!r}, should be {kind}")
            if key == "distance" and not array > 0.0:
                raise ValueError(f"default_camera_config: distance {value!r}, should be positive, m")
            if key in ("distance", "lookat") and np.abs(array).max() > FARTHEST:
                raise ValueError(f"default_camera_config: {key} {value!r}, should be at most {FARTHEST:g} m")
            values[key] = tuple(array.tolist()) if shape else float(array)
        return cls(**values)


class PictureFormat(NamedTuple):
    """Size and view of pictures."""

    width: int = 640  # width, pixels
    height: int = 480  # height, pixels
    view: View = View()  # from where to look

    @classmethod
    def checked(
        cls, width: int, height: int, default_camera_config: Mapping[str, Any] | None
    ) -> PictureFormat:
        """Check the arguments of an environment; ValueError if one is wrong."""
        for name, value in (("width", width), ("height", height)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name}: {value!r} is not a positive number of pixels")
            if value > LARGEST:
                raise ValueError(f"{name}: {value!r} pixels, should be at most {LARGEST}")
        return cls(int(width), int(height), View.from_config(default_camera_config))
