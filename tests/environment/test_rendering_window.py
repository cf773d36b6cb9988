"""The window: what it shows, how it heeds its user, and what is said where there can be none."""

import contextlib

import gymnasium
import numpy as np
import pytest
from start_frames import start_poses

from dq_space_arm_env.environment.picture_format import PictureFormat
from dq_space_arm_env.environment.rendering import Renderer
from dq_space_arm_env.scene import load_scene

NO_TRAIL = np.zeros((0, 3))
SMALL = PictureFormat(160, 120)


@pytest.fixture
def invisible_display(monkeypatch):
    pygame = pytest.importorskip("pygame")

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    yield pygame
    pygame.display.quit()


@pytest.mark.render
def test_window_shows_the_picture(invisible_display):
    scene = load_scene("paper")
    renderer, frames = Renderer(scene, SMALL), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    surface = renderer._window._window.get_surface()
    shown = invisible_display.surfarray.array3d(surface).transpose(1, 0, 2)
    np.testing.assert_array_equal(shown, renderer.draw(frames, NO_TRAIL))
    renderer.close()
    renderer.close()
    renderer.show(frames, NO_TRAIL, 1000)
    renderer.close()


@pytest.mark.render
def test_window_that_its_user_closes_stays_closed(invisible_display):
    scene = load_scene("paper")
    renderer, other = Renderer(scene, SMALL), Renderer(scene, SMALL)
    frames = start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    other.show(frames, NO_TRAIL, 1000)
    window = renderer._window._window
    invisible_display.event.post(invisible_display.event.Event(invisible_display.WINDOWCLOSE, window=window))
    other.show(frames, NO_TRAIL, 1000)  # leaves the wish to whom it concerns
    renderer.show(frames, NO_TRAIL, 1000)
    assert not renderer._window.is_open
    other.show(frames, NO_TRAIL, 1000)
    assert other._window.is_open
    other.close()


@pytest.mark.render
def test_window_heeds_its_user_after_much_moving_of_the_mouse(invisible_display):
    """A queue of 65,535 events that nobody reads is full within minutes, and takes no further one."""
    scene = load_scene("planar")
    renderer, frames = Renderer(scene, PictureFormat(16, 12)), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    moved = invisible_display.event.Event(
        invisible_display.MOUSEMOTION, pos=(1, 1), rel=(0, 0), buttons=(0, 0, 0)
    )
    with contextlib.suppress(invisible_display.error):  # when it is full
        for _ in range(70_000):
            invisible_display.event.post(moved)
    renderer.show(frames, NO_TRAIL, 1000)
    window = renderer._window._window
    invisible_display.event.post(invisible_display.event.Event(invisible_display.WINDOWCLOSE, window=window))
    renderer.show(frames, NO_TRAIL, 1000)
    assert not renderer._window.is_open


@pytest.mark.render
def test_window_opens_again_after_others_have_shut_pygame_down(invisible_display):
    """As Gymnasium's CartPole does when it closes."""
    scene = load_scene("planar")
    renderer, frames = Renderer(scene, SMALL), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    invisible_display.quit()
    renderer.show(frames, NO_TRAIL, 1000)
    surface = renderer._window._window.get_surface()
    shown = invisible_display.surfarray.array3d(surface).transpose(1, 0, 2)
    np.testing.assert_array_equal(shown, renderer.draw(frames, NO_TRAIL))
    invisible_display.quit()
    renderer.close()


@pytest.mark.render
def test_window_shows_the_picture_in_any_size(invisible_display):
    scene = load_scene("paper")
    renderer, frames = Renderer(scene, SMALL), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 1000)
    renderer._window._window.size = (400, 120)
    renderer.show(frames, NO_TRAIL, 1000)
    surface = renderer._window._window.get_surface()
    shown = invisible_display.surfarray.array3d(surface).transpose(1, 0, 2)
    assert shown.shape == (120, 400, 3)
    np.testing.assert_array_equal(shown[:, 120:280], renderer.draw(frames, NO_TRAIL))
    assert not shown[:, :120].any()
    assert not shown[:, 280:].any()
    renderer.close()


@pytest.mark.render
def test_nothing_is_drawn_for_a_window_that_is_closed(invisible_display, monkeypatch):
    scene = load_scene("paper")
    renderer = Renderer(scene, SMALL)
    renderer.show(start_poses(scene), NO_TRAIL, 1000)
    renderer._window.close()
    monkeypatch.setattr(renderer, "draw", lambda *_: pytest.fail("drawn"))
    renderer.show(start_poses(scene), NO_TRAIL, 1000)


@pytest.mark.render
def test_window_waits_for_the_next_picture(invisible_display):
    import time

    scene = load_scene("planar")
    renderer, frames = Renderer(scene, PictureFormat(64, 48)), start_poses(scene)
    renderer.show(frames, NO_TRAIL, 50)
    begin = time.perf_counter()
    for _ in range(5):
        renderer.show(frames, NO_TRAIL, 50)
    assert time.perf_counter() - begin > 0.08
    renderer.close()


@pytest.mark.render
@pytest.mark.parametrize("driver", ["offscreen", "dummy"])
def test_missing_display_is_one_sentence(monkeypatch, invisible_display, driver):
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(invisible_display.display, "init", lambda: None)
    monkeypatch.setattr(invisible_display.display, "get_driver", lambda: driver)
    scene = load_scene("paper")
    with pytest.raises(gymnasium.error.Error, match=r'use render_mode="rgb_array", or set DISPLAY'):
        Renderer(scene).show(start_poses(scene), NO_TRAIL, 60)


@pytest.mark.render
def test_display_that_refuses_is_one_sentence(monkeypatch, invisible_display):
    def refuse():
        raise invisible_display.error("No available video device")

    monkeypatch.setattr(invisible_display.display, "init", refuse)
    scene = load_scene("paper")
    with pytest.raises(gymnasium.error.Error, match=r'use render_mode="rgb_array", or set DISPLAY'):
        Renderer(scene).show(start_poses(scene), NO_TRAIL, 60)
