"""How pictures of an environment are asked for: their size, and from where the scene is looked at.

The environments check this when they are made; what draws is imported with the first picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

LARGEST = 8192
"""Width and height have to stay within, pixels: what a slip of the pen asks for would fill the memory."""


class View(NamedTuple):
    """From where a scene is looked at; None stands for the scene's own choice.

    Attributes:
        azimuth: Direction in which the camera looks: angle about z from x, deg.
        elevation: Its angle above the x-y plane, negative for looking down, deg; z points up in the picture.
        distance: Distance from the camera to the point that it looks at, m.
        lookat: That point in the inertial frame, shape (3,), m.
    """

    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    lookat: tuple[float, float, float] | None = None

    @classmethod
    def from_config(cls, config: Mapping[str, Any] | None) -> View:
        """Check a camera configuration like those of Gymnasium's MuJoCo environments.

        Args:
            config: Some of the attributes by name, or None.

        Returns:
            The view.

        Raises:
            ValueError: If it is no mapping, a key is unknown, a value is not a finite number, or a distance
                not positive.
        """
        if config is not None and not isinstance(config, Mapping):
            raise ValueError(
                f"default_camera_config: {config!r}, should be a mapping, e.g. {{'azimuth': 90}}"
            )
        values = dict(config or {})
        unknown = [key for key in values if key not in cls._fields]
        if unknown:
            raise ValueError(
                f"default_camera_config: {unknown[0]!r} is unknown; there are {', '.join(cls._fields)}"
            )
        for key, value in values.items():
            shape = (3,) if key == "lookat" else ()
            kind = "3 finite numbers, m" if key == "lookat" else "a finite number"
            try:
                array = np.asarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                array = np.full(shape, np.nan)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"default_camera_config: {key} {value!r}, should be {kind}")
            if key == "distance" and not array > 0.0:
                raise ValueError(f"default_camera_config: distance {value!r}, should be positive, m")
            values[key] = tuple(array.tolist()) if shape else float(array)
        return cls(**values)


class PictureFormat(NamedTuple):
    """Size and view of pictures.

    Attributes:
        width: Width, pixels.
        height: Height, pixels.
        view: From where to look.
    """

    width: int = 640
    height: int = 480
    view: View = View()

    @classmethod
    def checked(
        cls, width: int, height: int, default_camera_config: Mapping[str, Any] | None
    ) -> PictureFormat:
        """Check what the maker of an environment asks for.

        Args:
            width: Width, pixels.
            height: Height, pixels.
            default_camera_config: Entries of `View` by name, in deg and m.

        Returns:
            The format.

        Raises:
            ValueError: If width or height is not an integer from 1 to `LARGEST`, or the configuration of the
                camera is wrong.
        """
        for name, value in (("width", width), ("height", height)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name}: {value!r} is no number of pixels, it must be a positive integer")
            if value > LARGEST:
                raise ValueError(f"{name}: {value!r} pixels, should be at most {LARGEST}")
        return cls(int(width), int(height), View.from_config(default_camera_config))
