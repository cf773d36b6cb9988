"""Pictures of scenes: what they show, that near hides far, and what is said when they are impossible."""

import itertools
import sys
import tracemalloc

import gymnasium
import numpy as np
import pytest
from start_frames import start_poses

from dq_space_arm_env import DQSpaceArmEnv, compile_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.scene import Scene, list_scenes, load_scene
from dq_space_arm_env.viewing.picture_format import PictureFormat, View
from dq_space_arm_env.viewing.rendering import Renderer
from dq_space_arm_env.viewing.rendering.drawing import paint_sky
from dq_space_arm_env.viewing.rendering.spacecraft import LINK

NO_TRAIL = np.zeros((0, 3))


def empty_picture(renderer):
    """What the renderer draws where nothing is: the sky."""
    frames = np.full((renderer._model.frame_count, 8), np.nan)
    target = renderer._target
    renderer.aim_at(np.full(8, np.nan))
    picture = renderer.draw(frames, NO_TRAIL)
    renderer.aim_at(target)
    return picture


def drawn_by(renderer, frames):
    """Which pixels show something else than the sky."""
    return (renderer.draw(frames, NO_TRAIL) != empty_picture(renderer)).any(axis=2)


def reaches_border(drawn):
    return drawn[[0, -1]].any() or drawn[:, [0, -1]].any()


def scene_with(**fields):
    base = {"mass": 50, "inertia": [[4, 0.8, 0], [0.8, 6, 0.3], [0, 0.3, 5]]}
    data = {"name": "test", "base": base, "target": {"pose": {"position": [1.5, 1, 0]}}}
    return Scene.model_validate({**data, **fields})


LINKLESS = [
    scene_with(),
    scene_with(tip={"position": [0.9, 0.2, 0.3]}, actuators={"base_force": {"limit": 1}}),
    scene_with(wrist={"frame": {"position": [0, 0, 0.8]}}, tip={"position": [0.3, 0, 0]}),
]


@pytest.mark.sampled
@pytest.mark.parametrize("scene", [*list_scenes(), *LINKLESS], ids=str)
@pytest.mark.parametrize(("width", "height"), [(320, 240), (97, 301), (1, 1)])
def test_scenes_are_drawn_in_view_and_in_any_size(scene, width, height):
    scene = load_scene(scene)
    renderer = Renderer(scene, PictureFormat(width, height))
    picture = renderer.draw(start_poses(scene), NO_TRAIL)
    assert picture.shape == (height, width, 3)
    assert picture.dtype == np.uint8
    if (width, height) != (320, 240):
        return
    drawn = drawn_by(renderer, start_poses(scene))
    assert 0.03 < drawn.mean() < 0.5
    assert not reaches_border(drawn)


def test_same_state_gives_same_bytes(paper):
    frames, trail = start_poses(paper), np.linspace((0.0, -3.0, 4.0), (0.5, -3.5, 5.0), 50)
    first = Renderer(paper)
    pictures = [first.draw(frames, trail), first.draw(frames, trail), Renderer(paper).draw(frames, trail)]
    assert pictures[0].tobytes() == pictures[1].tobytes() == pictures[2].tobytes()
    pictures[0][:] = 0  # not the renderer's own memory
    assert first.draw(frames, trail).tobytes() == pictures[1].tobytes()


def test_picture_does_not_know_the_sign_of_a_dual_quaternion(paper):
    renderer, frames = Renderer(paper), start_poses(paper)
    assert np.array_equal(renderer.draw(frames, NO_TRAIL), renderer.draw(-frames, NO_TRAIL))


@pytest.mark.parametrize("moved", [False, True])
def test_target_is_seen_in_its_place_with_three_axes(moved):
    scene = load_scene("no-wrist")
    renderer = Renderer(scene)
    pose = scene.target.pose
    if moved:
        elsewhere = {"rotation": {"axis": [0, 0, 1], "angle": -40}, "position": [0.5, 0.9, 1.2]}
        pose = scene.replace(target={"pose": elsewhere}).target.pose
        renderer.aim_at(pose.dual_quaternion)
    empty = empty_picture(renderer).astype(int)
    away = start_poses(scene)
    away[:, 4:] = np.nan  # the robot alone is not drawn
    picture = renderer.draw(away, NO_TRAIL).astype(int)
    axes = np.array(pose.rotation_matrix).T * 0.5 * renderer._model.axis_length
    columns, rows = renderer.camera.project(np.array(pose.position) + axes)[:, :2].astype(int).T
    for axis, (column, row) in enumerate(zip(columns, rows, strict=True)):
        color = picture[row, column]
        assert (color != empty[row, column]).any()
        assert color.argmax() == axis, f"axis {axis} has color {color}"


def test_wherever_a_scene_draws_its_target_it_is_in_view():
    scene = load_scene("random-target")
    scene = scene.replace(spread={"target_position": 2.0})
    renderer, nominal = Renderer(scene), scene.target.pose
    frames = start_poses(scene)
    for corner in itertools.product((-2.0, 2.0), repeat=3):
        target = poses.from_rotation_and_position(nominal.rotation, np.add(nominal.position, corner))
        renderer.aim_at(target)
        assert not reaches_border(drawn_by(renderer, frames))


def test_link_is_seen_where_it_is(paper):
    renderer, frames = Renderer(paper), start_poses(paper)
    middle = 0.5 * np.add(poses.position(frames[2]), poses.position(frames[3]))
    column, row = renderer.camera.project(middle)[:2].astype(int)
    color = renderer.draw(frames, NO_TRAIL)[row, column] / 255.0
    np.testing.assert_allclose(color / color.max(), np.array(LINK) / max(LINK), rtol=0, atol=0.02)


@pytest.mark.parametrize("name", ["paper", "payload", "six-joint", "planar", "random-target"])
def test_drawn_starts_are_in_view(name):
    scene = load_scene(name)
    renderer, rng = Renderer(scene), np.random.default_rng(4)
    size = np.array([renderer.camera.width, renderer.camera.height])
    for _ in range(200):
        spread = scene.spread.joint_angles
        angles = scene.initial_state.joint_angles + rng.uniform(
            -spread, spread, len(scene.initial_state.joint_angles)
        )
        seen = renderer.camera.project(np.array(poses.position(start_poses(scene, angles).T)).T)[:, :2]
        assert ((seen > 0) & (seen < size)).all()


@pytest.mark.parametrize("name", ["paper", "far"])
def test_starts_of_episodes_are_in_view(name):
    """Base and arm; `far` has its base anywhere within 0.4 m and 0.5 rad."""
    scene, env = load_scene(name), DQSpaceArmEnv(name)
    renderer, size = Renderer(scene), (640, 480)
    for seed in range(50):
        env.reset(seed=seed)
        frames = env.kernels.frame_poses(env.state)
        seen = renderer.camera.project(np.array(poses.position(frames.T)).T)[:, :2]
        assert ((seen > 0) & (seen < size)).all()


@pytest.mark.parametrize("name", ["paper", "planar"])
def test_tip_is_projected_to_where_the_kernels_have_it(name):
    """The origin of the tip's axes, drawn alone in front of everything, is seen at the kernels' tip pose."""
    scene = load_scene(name)
    kernels, renderer = compile_scene(scene), Renderer(scene)
    x = kernels.layout.initial_state
    rotation, position = poses.to_matrix(kernels.tip_pose(x))
    # Nothing but the tip's axes: the other frames are not drawn.
    frames = np.full((renderer._model.frame_count, 8), np.nan)
    frames[-1] = kernels.frame_poses(x)[-1]
    renderer.aim_at(np.full(8, np.nan))
    drawn = drawn_by(renderer, frames)
    ends = np.array(position) + renderer._model.axis_length * np.array(rotation).T
    corners = renderer.camera.project(np.vstack([position, ends]))[:, :2]
    found = np.argwhere(drawn)[:, ::-1]
    np.testing.assert_allclose(found.min(axis=0), corners.min(axis=0), rtol=0, atol=8.0)
    np.testing.assert_allclose(found.max(axis=0), corners.max(axis=0), rtol=0, atol=8.0)
    column, row = corners[0].astype(int)
    assert drawn[row, column]


def test_camera_is_placed_by_the_scene_or_by_all_or_part_of_a_view(paper):
    own = Renderer(paper).camera
    assert own.axes[0, 2] == pytest.approx(0.0), "the horizon is level"
    assert own.axes[1, 2] < 0.0, "up is up"
    planar = Renderer(load_scene("planar")).camera
    np.testing.assert_allclose(planar.axes, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], rtol=0, atol=1e-15)
    turned = Renderer(paper, PictureFormat(view=View(azimuth=30.0))).camera
    assert turned.axes[2, 2] == pytest.approx(own.axes[2, 2]), "the elevation is the scene's"
    near = Renderer(paper, PictureFormat(view=View(distance=3.0))).camera
    np.testing.assert_allclose(near.axes, own.axes)
    moved = near.position - own.position
    assert moved @ own.axes[2] == pytest.approx(np.linalg.norm(moved)), "it has gone straight ahead"
    point = (1.0, -3.0, 4.0)
    aimed = Renderer(paper, PictureFormat(view=View(lookat=point))).camera
    np.testing.assert_allclose(aimed.project(np.array(point))[:2], (320.0, 240.0))
    view = View(azimuth=90.0, elevation=-30.0, distance=7.0, lookat=point)
    placed = Renderer(paper, PictureFormat(view=view)).camera
    expected = np.array(point) - 7.0 * np.array((0.0, np.cos(np.pi / 6), -0.5))
    np.testing.assert_allclose(placed.position, expected, rtol=0, atol=1e-12)


def test_trail_is_drawn_where_the_tip_was(paper):
    renderer, frames = Renderer(paper), start_poses(paper)
    trail = np.linspace((0.3, -4.0, 6.0), (0.3, -2.0, 6.0), 300)
    before, after = renderer.draw(frames, NO_TRAIL), renderer.draw(frames, trail)
    columns, rows = renderer.camera.project(trail[5:-5])[:, :2].astype(int).T
    assert (before[rows, columns] != after[rows, columns]).any(axis=1).all()
    old, new = after[rows, columns].astype(int)[[0, -1]]
    assert new[0] > old[0] + 100, "older parts are fainter"
    np.testing.assert_array_equal(after, renderer.draw(frames, trail.tolist()))
    resting = np.tile((0.3, -4.0, 6.0), (500, 1))
    np.testing.assert_array_equal(renderer.draw(frames, resting), before)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200, -1e300])
def test_simulation_that_has_blown_up_is_drawn_without_warning(paper, value):
    renderer, good = Renderer(paper), start_poses(paper)
    for part in itertools.product((slice(None), slice(2, None)), (slice(None), slice(4, None))):
        frames = good.copy()
        frames[part] = value
        picture = renderer.draw(frames, np.array([(0.3, -4.0, 6.0), (value, value, 0.0), (0.3, -2.0, 6.0)]))
        assert picture.shape == (480, 640, 3)


def test_robot_may_pass_the_camera(paper):
    renderer, good = Renderer(paper), start_poses(paper)
    toward = renderer.camera.position - np.array(paper.initial_state.base_pose.position)
    counts = []
    for distance in (0.0, 0.5, 0.9, 1.0, 1.1, 2.0):
        move = poses.from_rotation_and_position((1.0, 0.0, 0.0, 0.0), distance * toward)
        frames = np.array([dual_quaternion.multiply(move, frame) for frame in good])
        counts.append(drawn_by(renderer, frames).sum())
    assert counts[0] < counts[1], "nearer is larger"
    assert counts[-1] < 0.2 * counts[0], "what is behind the camera is not seen"


def test_wrong_shapes_are_refused(paper):
    renderer, frames = Renderer(paper), start_poses(paper)
    with pytest.raises(ValueError, match=r"frame_poses: shape \(5, 8\), should be \(6, 8\)"):
        renderer.draw(frames[1:], NO_TRAIL)
    with pytest.raises(ValueError, match=r"trail: shape \(3,\), should be \(m, 3\)"):
        renderer.draw(frames, np.zeros(3))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"width": 0}, "width: 0 is not a positive number of pixels"),
        ({"height": True}, "height: True is not a positive number of pixels"),
        ({"width": 8193}, "width: 8193 pixels, should be at most 8192"),
        ({"default_camera_config": "azimuth"}, "default_camera_config: 'azimuth', should be a mapping"),
        ({"default_camera_config": {"azimut": 3}}, "'azimut' is unknown; choose from azimuth, elevation"),
        ({"default_camera_config": {"elevation": np.inf}}, "elevation inf, should be a finite number"),
        ({"default_camera_config": {"azimuth": "90"}}, "azimuth '90', should be a finite number"),
        ({"default_camera_config": {"distance": 0}}, "distance 0, should be positive, m"),
        ({"default_camera_config": {"distance": 1e308}}, r"distance 1e\+308, should be at most 1e\+06 m"),
        ({"default_camera_config": {"lookat": (0, -2e6, 0)}}, r"-2000000.0, 0\), should be at most"),
        ({"default_camera_config": {"lookat": (1, 2)}}, r"lookat \(1, 2\), should be 3 finite numbers, m"),
    ],
)
def test_impossible_pictures_are_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        DQSpaceArmEnv(**arguments)


def test_sky_takes_little_more_memory_than_its_picture():
    tracemalloc.start()
    picture = paint_sky(1024, 1024)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * picture.nbytes, "painted at once, it takes sixty times the memory"


def test_pictures_need_no_pygame_and_a_window_says_what_it_needs(paper, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    renderer = Renderer(paper)
    renderer.draw(start_poses(paper), NO_TRAIL)
    with pytest.raises(gymnasium.error.DependencyNotInstalled) as caught:
        renderer.show(start_poses(paper), NO_TRAIL, 60)
    assert 'pip install "dq-space-arm[render]"' in str(caught.value)
