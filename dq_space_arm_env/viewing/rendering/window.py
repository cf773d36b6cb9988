"""A window that shows pictures."""

from __future__ import annotations

import os
from types import ModuleType
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

# SDL falls back on these without a display, and shows nothing.
_INVISIBLE_DRIVERS = ("dummy", "offscreen")
_NO_DISPLAY = (
    'render_mode="human" needs a display and there is none: use render_mode="rgb_array", or set DISPLAY '
    "(or WAYLAND_DISPLAY) to one"
)


def import_pygame() -> ModuleType:
    """Import pygame; raise Gymnasium's `DependencyNotInstalled` if it is missing."""
    try:
        import pygame
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled(
            'a window needs pygame-ce, which is not installed: pip install "dq-space-arm[render]"'
        ) from error
    return pygame


class Window:
    """A resizable window; once closed by its user it stays closed, and the simulation continues."""

    def __init__(self, title: str, width: int, height: int) -> None:
        self._pygame = import_pygame()
        self._title, self._size = title, (width, height)
        self._open()

    def _open(self) -> None:
        try:
            self._pygame.display.init()
        except self._pygame.error as error:
            raise gymnasium.error.Error(_NO_DISPLAY) from error
        driver = self._pygame.display.get_driver()
        if driver in _INVISIBLE_DRIVERS and os.environ.get("SDL_VIDEODRIVER") != driver:
            self._pygame.display.quit()
            raise gymnasium.error.Error(_NO_DISPLAY)
        self._window: pygame.Window | None = self._pygame.Window(self._title, self._size, resizable=True)
        self._clock = self._pygame.time.Clock()

    @property
    def is_open(self) -> bool:
        """Whether the user has left the window open."""
        return self._window is not None

    def show(self, image: NDArray[np.uint8], fps: float) -> None:
        """Show a picture as large as the window allows, and wait until the next is due, at `fps` 1/s."""
        if self._window is None:
            return
        if not self._pygame.display.get_init():
            self._open()  # closed by another of Gymnasium's environments, which close all windows
        height, width, _ = image.shape
        picture = self._pygame.image.frombuffer(image.tobytes(), (width, height), "RGB")
        surface = self._window.get_surface()
        scale = min(surface.get_width() / width, surface.get_height() / height)
        if scale != 1.0:
            size = max(1, round(scale * width)), max(1, round(scale * height))
            picture = self._pygame.transform.smoothscale(picture, size)
        surface.fill((0, 0, 0))
        surface.blit(picture, picture.get_rect(center=surface.get_rect().center))
        self._window.flip()
        self._clock.tick(fps)
        self._heed_closing()

    def _heed_closing(self) -> None:
        """Close if the user asks for it; leave other events to their owners."""
        for event in self._pygame.event.get([self._pygame.QUIT, self._pygame.WINDOWCLOSE]):
            if event.type == self._pygame.QUIT or event.window is self._window:
                self.close()
            elif event.window is not None:
                self._pygame.event.post(event)
        # Unread, these would fill the queue within minutes and leave no room for a request to close.
        self._pygame.event.clear([self._pygame.MOUSEMOTION, self._pygame.FINGERMOTION])

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._window is not None:
            self._window.destroy()
            self._window = None
