"""The maneuver as a moving picture: which states are drawn, and what the file holds."""

import io
import math

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.viewing.picture_format import PictureFormat
from dq_space_arm_env.viewing.rendering import Renderer
from experts.figures import animation
from experts.figures.animation import check_gif, draw_maneuver, encode_gif, encode_strip, encode_webp
from experts.maneuver import Maneuver

SMALL = PictureFormat(64, 48)


@pytest.fixture(scope="module")
def maneuver():
    """The nominal start, drifting with some initial motion of the joints."""
    scene = load_scene("paper")
    kernels = compile_scene(scene)
    states = [kernels.layout.initial_state.copy()]
    states[0][-3:] = (0.5, -0.4, 0.6)
    for _ in range(100):
        states.append(kernels.step(states[-1], np.zeros(12)))
    return Maneuver(scene, np.array(states), np.zeros((100, 12)))


def test_pictures_are_those_of_the_states_at_their_times(maneuver):
    pictures = draw_maneuver(maneuver, SMALL, fps=10.0, seconds=9.0)
    assert len(pictures) == 16, "1.5 s, both ends included"
    renderer = Renderer(maneuver.scene, SMALL)
    kernels = compile_scene(maneuver.scene)
    for number, stage in ((0, 0), (3, 20), (15, 100)):
        trail = np.transpose(poses.position(maneuver.frames[: stage + 1, -1].T))
        expected = renderer.draw(kernels.frame_poses(maneuver.states[stage]), trail)
        np.testing.assert_array_equal(pictures[number], expected)


@pytest.mark.parametrize(
    ("fps", "hold", "colors", "sentence"),
    [
        (50.1, 0.0, 2, r"fps: 50\.1, should be positive and at most 50"),
        (math.nan, 0.0, 2, "fps: nan"),
        (10.0, math.inf, 2, "hold: inf, should be 0 to 600 s"),
        (10.0, 0.0, 256, "colors: 256, should be 2 to 255"),
    ],
)
def test_impossible_pictures_are_refused(maneuver, fps, hold, colors, sentence):
    with pytest.raises(ValueError, match=r"seconds: -1\.0, should be positive"):
        draw_maneuver(maneuver, SMALL, fps=10, seconds=-1.0)
    check_gif(50.0, 0.0, 255)
    with pytest.raises(ValueError, match=sentence):
        encode_gif([np.zeros((4, 4, 3), dtype=np.uint8)], fps, hold, colors)


def test_gif_keeps_real_time_though_it_counts_in_hundredths():
    """16 pictures per second stay for 0.0625 s each, which a GIF cannot say."""
    pillow = pytest.importorskip("PIL.Image")
    pictures = [np.zeros((8, 8, 3), dtype=np.uint8) for _ in range(33)]
    for number, picture in enumerate(pictures):
        picture[number // 8, number % 8] = 255
    file = pillow.open(io.BytesIO(encode_gif(pictures, fps=16.0, hold=1.0, colors=200)))
    durations = []
    for number in range(file.n_frames):
        file.seek(number)
        durations.append(file.info["duration"])
    assert set(durations[:-1]) == {60, 70}
    assert sum(durations[:-1]) == 2000
    assert durations[-1] == 1000


def test_gif_plays_what_was_drawn(maneuver):
    pillow = pytest.importorskip("PIL.Image")
    pictures = draw_maneuver(maneuver, SMALL, fps=10.0, seconds=1.0)
    file = pillow.open(io.BytesIO(encode_gif(pictures, fps=10.0, hold=2.0, colors=200)))
    assert file.n_frames == len(pictures) == 11
    assert file.info["loop"] == 0
    for number, picture in enumerate(pictures):
        file.seek(number)
        assert file.info["duration"] == (2000 if number == 10 else 100)
        shown = np.asarray(file.convert("RGB")).astype(int)
        assert np.abs(shown - picture).mean() < 4.0
        assert (np.abs(shown - picture).max(axis=2) > 60).mean() < 0.02


def test_webp_plays_what_was_drawn(maneuver):
    pillow = pytest.importorskip("PIL.Image")
    pictures = draw_maneuver(maneuver, SMALL, fps=10.0, seconds=1.0, whole=True)
    file = pillow.open(io.BytesIO(encode_webp(pictures, fps=10.0, hold=2.0, quality=90)))
    assert file.n_frames == len(pictures) == 11
    assert file.info["loop"] == 0
    for number, picture in enumerate(pictures):
        file.seek(number)
        file.load()
        assert file.info["duration"] == (2000 if number == 10 else 100)
        assert np.abs(np.asarray(file.convert("RGB")).astype(int) - picture).mean() < 6.0


@pytest.mark.parametrize("name", ["paper", "servicing", "planar"])
def test_a_whole_maneuver_stays_in_the_picture(name):
    """The robot flies off and turns; its shapes stay inside the border of the camera's picture."""
    scene = load_scene(name)
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (201, 1))
    states[:, layout.state.joint_angles] += np.linspace(0.0, 1.5, 201)[:, None]
    whole = Maneuver(scene, states, np.zeros((200, layout.n_u)))
    camera = animation._camera_of_all(animation._shown(whole), scene, SMALL)
    tips = np.transpose(poses.position(whole.frames.reshape(-1, 8).T))
    x, y, _ = camera.project(tips).T
    assert ((x > 0) & (x < SMALL.width) & (y > 0) & (y < SMALL.height)).all()
    moved, still = (
        draw_maneuver(whole, SMALL, fps=1.0, seconds=1.0, whole=every)[0] for every in (True, False)
    )
    assert (moved != still).any()


def test_constraints_of_a_whole_maneuver_are_drawn_in_green():
    scene = load_scene("pointing")
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (3, 1))
    maneuver = Maneuver(scene, states, np.zeros((2, layout.n_u)))
    shown = draw_maneuver(maneuver, SMALL, fps=50.0, seconds=0.01, whole=True)[0].astype(int)
    bare = scene.replace(constraints=[])
    plain = Maneuver(bare, states, np.zeros((2, layout.n_u)))
    hidden = draw_maneuver(plain, SMALL, fps=50.0, seconds=0.01, whole=True)[0].astype(int)
    changed = np.abs(shown - hidden).max(axis=2) > 20
    assert changed.mean() > 0.05
    greener = shown[changed] - hidden[changed]
    assert (greener[:, 1] > greener[:, 0]).mean() > 0.9


def test_a_strip_shows_moments_side_by_side(maneuver):
    pillow = pytest.importorskip("PIL.Image")
    pictures = draw_maneuver(maneuver, SMALL, fps=2.0 / 1.5, seconds=1.5)
    strip = np.asarray(pillow.open(io.BytesIO(encode_strip(pictures))).convert("RGB")).astype(int)
    assert strip.shape == (48, 3 * 64 + 2 * 4, 3)
    for number, picture in enumerate(pictures):
        assert np.abs(strip[:, 68 * number : 68 * number + 64] - picture).mean() < 4.0
    assert (strip[:, 64:68] > 250).all()


def test_a_payload_stays_where_it_was_let_go_and_the_target_is_that_of_the_phase():
    scene = load_scene("release")
    layout, start = StateLayout.of(scene), scene.staged.starts[-1]
    states = np.tile(layout.initial_state, (scene.simulation.steps + 1, 1))
    states[start + 1 :, layout.state.joint_angles] += 0.5
    turned = Maneuver(scene, states, np.zeros((len(states) - 1, layout.n_u)))
    last = draw_maneuver(turned, SMALL, fps=1.0 / 18.0, seconds=18.0)[-1]
    renderer = Renderer(scene, SMALL)
    renderer.aim_at(scene.staged.resting[-1], payload=turned.frames[0, -1])
    trail = np.transpose(poses.position(turned.frames[:, -1].T))
    np.testing.assert_array_equal(last, renderer.draw(turned.frames[-1], trail))
