"""A word in the picture, next to a set of axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.environment.rendering.camera import Camera
from dq_space_arm_env.environment.rendering.window import import_pygame

Array = NDArray[np.float64]

_COLOR, _HALO_COLOR = np.array([60.0, 66.0, 78.0]), np.array([255.0, 255.0, 255.0])
_HALO_STRENGTH = 0.8
_GAP = 0.02  # between the axes' origin and the word, of the picture's height


class Label:
    """A word that stays where it is."""

    def __init__(self, text: str, camera: Camera, origin: Array, ends: Array) -> None:
        """Write the word on the side of the axes that they leave free.

        Args:
            text: The word.
            camera: Camera of the picture.
            origin: Origin of the axes in the inertial frame, shape (3,), m.
            ends: Ends of the axes, one per row, in the inertial frame, shape (3, 3), m.

        Raises:
            DependencyNotInstalled: If pygame is not installed.
        """
        pygame = import_pygame()
        pygame.font.init()
        font = pygame.font.Font(None, max(12, round(camera.height / 22)))
        opacity = np.pad(pygame.surfarray.array_alpha(font.render(text, True, (0, 0, 0))).T / 255.0, 1)
        size = np.array(opacity.shape[::-1])
        start = camera.project(origin)[:2]
        away = start - camera.project(ends)[:, :2].mean(axis=0)
        away /= max(float(np.linalg.norm(away)), 1e-9)
        # As far out that the word's box does not touch a circle around the origin.
        center = start + away * _GAP * camera.height + np.sign(away) * 0.5 * size
        room = np.maximum(np.array([camera.width, camera.height]) - size, 0)
        column, row = np.clip(np.rint(center - 0.5 * size), 0, room).astype(int)
        self._place = slice(row, row + size[1]), slice(column, column + size[0])
        # A light rim of one pixel keeps the word readable on dark parts.
        shifts = [np.roll(opacity, (down, right), axis=(0, 1)) for down in (-1, 0, 1) for right in (-1, 0, 1)]
        inside = np.s_[: camera.height, : camera.width, None]
        self._layers = (
            (_HALO_STRENGTH * np.max(shifts, axis=0)[inside], _HALO_COLOR),
            (opacity[inside], _COLOR),
        )

    def draw(self, image: NDArray[np.uint8]) -> None:
        """Write the word into a picture.

        Args:
            image: Picture of the camera's size, shape (height, width, 3), changed in place.
        """
        patch = image[self._place]
        for opacity, color in self._layers:
            patch[:] = np.rint(patch + opacity * (color - patch))
