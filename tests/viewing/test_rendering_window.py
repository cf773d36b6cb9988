"""The window: what it shows, how it heeds its user, and what is said where there can be none."""

import contextlib
import time

import gymnasium
import numpy as np
import pytest
from start_frames import start_poses

from dq_space_arm_env.scene import load_scene
from dq_space_arm_env.viewing.picture_format import PictureFormat
from dq_space_arm_env.viewing.rendering import Renderer

NO_TRAIL = np.zeros((0, 3))
SMALL = PictureFormat(160, 120)


@pytest.fixture
def invisible_display(monkeypatch):
    pygame = pytest.importorskip("pygame")

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    yield pygame
    pygame.display.quit()


def opened(name="planar", picture=SMALL):
    """A renderer with its window, and the frames that it shows."""
    scene = load_scene(name)
    renderer, frames = Renderer(scene, picture), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    return renderer, frames


def close_as_its_user_does(renderer, pygame):
    window = renderer._window._window
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=window))


def picture_in(renderer, pygame):
    """What the window shows."""
    return pygame.surfarray.array3d(renderer._window._window.get_surface()).transpose(1, 0, 2)


@pytest.mark.render
def test_window_that_its_user_closes_stays_closed(invisible_display):
    (renderer, frames), (other, _) = opened(), opened()
    close_as_its_user_does(renderer, invisible_display)
    other.show(frames, NO_TRAIL, 1000)  # leaves the wish to whom it concerns
    renderer.show(frames, NO_TRAIL, 1000)
    assert not renderer._window.is_open
    other.show(frames, NO_TRAIL, 1000)
    assert other._window.is_open


@pytest.mark.render
def test_window_heeds_its_user_after_much_moving_of_the_mouse(invisible_display):
    """A queue of 65,535 events that nobody reads is full within minutes, and takes no further one."""
    renderer, frames = opened(picture=PictureFormat(16, 12))
    pygame = invisible_display
    moved = pygame.event.Event(pygame.MOUSEMOTION, pos=(1, 1), rel=(0, 0), buttons=(0, 0, 0))
    with contextlib.suppress(pygame.error):  # when it is full
        for _ in range(70_000):
            pygame.event.post(moved)
    renderer.show(frames, NO_TRAIL, 1000)
    close_as_its_user_does(renderer, invisible_display)
    renderer.show(frames, NO_TRAIL, 1000)
    assert not renderer._window.is_open


@pytest.mark.render
def test_window_opens_again_after_others_have_shut_pygame_down(invisible_display):
    """As Gymnasium's CartPole does when it closes."""
    renderer, frames = opened()
    invisible_display.quit()
    renderer.show(frames, NO_TRAIL, 1000)
    shown = picture_in(renderer, invisible_display)
    np.testing.assert_array_equal(shown, renderer.draw(frames, NO_TRAIL))
    invisible_display.quit()
    renderer.close()


@pytest.mark.render
def test_window_shows_the_picture_in_any_size(invisible_display):
    renderer, frames = opened("paper")
    renderer._window._window.size = (400, 120)
    renderer.show(frames, NO_TRAIL, 1000)
    shown = picture_in(renderer, invisible_display)
    assert shown.shape == (120, 400, 3)
    np.testing.assert_array_equal(shown[:, 120:280], renderer.draw(frames, NO_TRAIL))
    assert not shown[:, :120].any()
    assert not shown[:, 280:].any()


@pytest.mark.render
def test_window_waits_for_the_next_picture(invisible_display):
    renderer, frames = opened()
    begin = time.perf_counter()
    for _ in range(5):
        renderer.show(frames, NO_TRAIL, 50)
    assert time.perf_counter() - begin > 0.08


@pytest.mark.render
@pytest.mark.parametrize("driver", ["offscreen", "dummy", None])
def test_missing_display_is_one_sentence(monkeypatch, invisible_display, driver):
    """SDL falls back on a driver that shows nothing, or raises an error."""

    def init():
        if driver is None:
            raise invisible_display.error("No available video device")

    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(invisible_display.display, "init", init)
    monkeypatch.setattr(invisible_display.display, "get_driver", lambda: driver)
    scene = load_scene("paper")
    with pytest.raises(gymnasium.error.Error, match=r'use render_mode="rgb_array", or set DISPLAY'):
        Renderer(scene).show(start_poses(scene), NO_TRAIL, 60)
