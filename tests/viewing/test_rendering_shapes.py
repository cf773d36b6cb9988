"""Given shapes in pictures: where their poses say, in their colors, and instead of what is derived."""

import numpy as np
import pytest
from start_frames import start_poses

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.scene import Scene, list_scenes, load_scene
from dq_space_arm_env.scene.shapes import COLORS, Shape, color_of
from dq_space_arm_env.viewing.rendering import Renderer
from dq_space_arm_env.viewing.rendering.body_shapes import corners_of, shape_meshes
from dq_space_arm_env.viewing.rendering.solids import Mesh
from dq_space_arm_env.viewing.rendering.spacecraft import LIKENESS, SpacecraftModel
from dq_space_arm_env.viewing.replay.geometry import solids_of

NO_TRAIL = np.zeros((0, 3))
MAGENTA = "#ff00ff"
POSE = {"position": [0.4, -0.3, 0.7], "rotation": {"axis": [1, 2, 3], "angle": 40}}
BOX = {"box": [0.5, 0.3, 0.2], "pose": POSE, "color": MAGENTA}
CYLINDER = {"cylinder": {"radius": 0.2, "length": 0.6}, "pose": POSE, "color": MAGENTA}
BODIES = {"base": 0, "links.0": 1, "links.1": 2, "payload": -1}  # and their frames


def lone(renderer, frame, pose):
    """Poses of which only one is finite: nothing else is drawn."""
    frames = np.full((renderer._model.frame_count, 8), np.nan)
    frames[frame] = pose
    return frames


def magenta_pixels(picture):
    """Rows and columns of what is magenta, as nothing else is, (n, 2)."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    least = np.minimum(red, blue)
    return np.argwhere((least > 60) & (green < 0.6 * least))


def bounds(camera, corners):
    """Smallest and largest row and column of points in the picture."""
    seen = camera.project(corners)[:, 1::-1]
    return seen.min(axis=0), seen.max(axis=0)


def gives_shapes(scene):
    return '"geometry"' in scene.model_dump_json(exclude_defaults=True)


@pytest.mark.sampled
@pytest.mark.parametrize("name", [name for name in list_scenes() if not gives_shapes(load_scene(name))])
def test_scenes_without_shapes_look_as_before(name):
    """No shapes, or an empty list of them, leave base, arm, payload and target as they are, to the pixel."""
    scene = load_scene(name)
    if scene.target.geometry or (scene.payload is not None and scene.payload.geometry):
        pytest.skip("the scene gives shapes")
    bodies = ["base", "target", *(f"links.{index}" for index in range(len(scene.links)))]
    bodies += ["payload"] if scene.payload else []
    empty = scene.replace({f"{body}.geometry": [] for body in bodies})
    frames = start_poses(scene)
    picture = Renderer(scene).draw(frames, NO_TRAIL)
    np.testing.assert_array_equal(Renderer(empty).draw(frames, NO_TRAIL), picture)
    model = SpacecraftModel(scene)
    assert model.frame_count + 1 not in model.mesh.frames  # the target's body has no faces
    # An invisibly far body leaves the picture as it is, so the target's body is drawn from its own pose.
    renderer = Renderer(scene)
    renderer.aim_at(scene.target.pose.dual_quaternion, np.full(8, np.nan))
    np.testing.assert_array_equal(renderer.draw(frames, NO_TRAIL), picture)


@pytest.mark.parametrize("shape", [BOX, CYLINDER], ids=["box", "cylinder"])
@pytest.mark.parametrize(("body", "frame"), BODIES.items(), ids=BODIES)
def test_a_shape_is_seen_where_its_pose_says(body, frame, shape):
    """By the corners of the box, or the rims of the cylinder, projected one by one."""
    scene = load_scene("payload").replace({f"{body}.geometry": [shape]})
    renderer, pose = Renderer(scene), start_poses(scene)[frame]
    found = magenta_pixels(renderer.draw(lone(renderer, frame, pose), NO_TRAIL))
    low, high = bounds(renderer.camera, placed(outline(shape), pose, scene))
    assert len(found) > 50
    np.testing.assert_allclose(found.min(axis=0), low, rtol=0, atol=2.5)
    np.testing.assert_allclose(found.max(axis=0) + 1, high, rtol=0, atol=2.5)


def outline(shape):
    """Corners of a box, or points on the rims of a cylinder, in its own frame, (n, 3)."""
    if "box" in shape:
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)
        return signs * shape["box"]
    radius, length = shape["cylinder"]["radius"], shape["cylinder"]["length"]
    angles = np.linspace(0.0, 2.0 * np.pi, 90)
    rim = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(90, 0.5 * length)])
    return np.vstack([rim, rim * (1.0, 1.0, -1.0)])


def placed(points, body, scene):
    """Points of the shape's frame in the inertial frame."""
    own = scene.replace({"target.pose": POSE}).target.pose.dual_quaternion
    rotation, position = poses.to_matrix(dual_quaternion.multiply(tuple(body), own))
    return points @ np.array(rotation).T + np.array(position)


def test_the_body_of_the_target_is_seen_at_the_target_or_where_it_is_told():
    scene = load_scene("paper").replace({"target.geometry": [BOX]})
    renderer, away = Renderer(scene), np.full((6, 8), np.nan)
    nominal = scene.target.pose.dual_quaternion
    turned = dual_quaternion.multiply(nominal, poses.from_axis_angle((0.0, 1.0, 0.0), 0.7, (0.1, 0.0, 0.2)))
    for target, body in ((nominal, None), (turned, None), (nominal, turned), (turned, nominal)):
        renderer.aim_at(target, body)
        found = magenta_pixels(renderer.draw(away, NO_TRAIL))
        low, high = bounds(renderer.camera, placed(outline(BOX), target if body is None else body, scene))
        np.testing.assert_allclose(found.min(axis=0), low, rtol=0, atol=2.5)
        np.testing.assert_allclose(found.max(axis=0) + 1, high, rtol=0, atol=2.5)
    renderer.aim_at(turned)  # the body goes with the target again
    one = renderer.draw(away, NO_TRAIL)
    renderer.aim_at(turned, turned)
    np.testing.assert_array_equal(renderer.draw(away, NO_TRAIL), one)


def test_shapes_replace_what_is_derived_from_masses():
    scene = load_scene("payload")
    plain = SpacecraftModel(scene).mesh
    for body, frame in (("base", 0), ("links.1", 2)):
        mesh = SpacecraftModel(scene.replace({f"{body}.geometry": [BOX]})).mesh
        assert (mesh.frames == frame).sum() == 6
        for other in set(plain.frames) - {frame}:  # sizes of the rest follow the base
            assert (mesh.frames == other).sum() == (plain.frames == other).sum()
    held = SpacecraftModel(scene.replace({"payload.geometry": [BOX, CYLINDER]})).mesh
    own = SpacecraftModel(scene).frame_count + 2
    assert ((held.frames == own).sum(), (plain.frames == own).sum()) == (6 + 3 * 36, 6)


def test_a_last_link_with_shapes_has_no_hand_and_no_ghost_of_one():
    scene = load_scene("no-wrist")
    assert (SpacecraftModel(scene).mesh.colors == LIKENESS).all(axis=1).any()
    last = len(scene.links) - 1
    mesh = SpacecraftModel(scene.replace({f"links.{last}.geometry": [BOX]})).mesh
    assert not (mesh.colors == LIKENESS).all(axis=1).any()
    assert (mesh.frames == last + 1).sum() == 6


@pytest.mark.parametrize("name", ["paper", "payload", "planar"])
def test_large_shapes_are_in_view(name):
    scene = load_scene(name)
    wide = {"box": [6, 0.2, 0.2]}
    scene = scene.replace({"base.geometry": [wide], "target.geometry": [wide], "links.0.geometry": [wide]})
    renderer, frames = Renderer(scene), start_poses(scene)
    size = np.array([renderer.camera.width, renderer.camera.height])
    for pose in (frames[0], frames[1], scene.target.pose.dual_quaternion):
        rotation, position = poses.to_matrix(tuple(pose))
        corners = corners_of(scene.base.geometry) @ np.array(rotation).T + np.array(position)
        seen = renderer.camera.project(corners)[:, :2]
        assert ((seen > 0) & (seen < size)).all()


def test_drawn_targets_keep_their_shapes_in_view():
    scene = load_scene("random-target").replace(
        {"target.geometry": [{"box": [0.2, 0.2, 3.0], "pose": {"position": [0, 0, 1.5]}}]}
    )
    renderer, rng = Renderer(scene), np.random.default_rng(7)
    nominal, spread = scene.target.pose, scene.spread
    size = np.array([renderer.camera.width, renderer.camera.height])
    for _ in range(100):
        vector = rng.uniform(-spread.target_rotation, spread.target_rotation, 3)
        angle = float(np.linalg.norm(vector))
        moved = np.add(nominal.position, rng.uniform(-spread.target_position, spread.target_position, 3))
        start = poses.from_rotation_and_position(nominal.rotation, tuple(moved))
        turn = poses.from_axis_angle(tuple(vector / angle), angle, (0.0, 0.0, 0.0))
        rotation, position = poses.to_matrix(dual_quaternion.multiply(start, turn))
        corners = corners_of(scene.target.geometry) @ np.array(rotation).T + np.array(position)
        seen = renderer.camera.project(corners)[:, :2]
        assert ((seen > 0) & (seen < size)).all()


def test_shapes_enclose_their_volumes_and_have_their_colors():
    shapes = [Shape.model_validate(shape) for shape in (BOX, CYLINDER)]
    for shape, volume in zip(shapes, (0.03, 0.6 * 36 * 0.5 * 0.04 * np.sin(np.pi / 18)), strict=True):
        mesh = Mesh.joined(shape_meshes(0, [shape], COLORS["white"]))
        area = 0.5 * np.cross(
            mesh.corners[:, 2] - mesh.corners[:, 0], mesh.corners[:, 3] - mesh.corners[:, 1]
        )
        outward = np.sign(np.einsum("fi,fi->f", area, mesh.normals))[:, None] * area
        assert np.einsum("fi,fi->", outward, mesh.corners.mean(axis=1)) / 3.0 == pytest.approx(volume)
        np.testing.assert_array_equal(mesh.colors, np.tile((1.0, 0.0, 1.0), (len(mesh.frames), 1)))
        low, high = corners_of([shape]).min(axis=0), corners_of([shape]).max(axis=0)
        flat = mesh.corners.reshape(-1, 3)
        assert (flat > low - 1e-12).all()
        assert (flat < high + 1e-12).all()


@pytest.mark.parametrize(
    ("color", "expected"),
    [(None, (0.1, 0.2, 0.3)), ("teal", COLORS["teal"]), ("#ff8000", (1.0, 128 / 255, 0.0))],
)
def test_colors_are_names_or_hexadecimal_and_have_a_default(color, expected):
    shape = Shape(box=(1.0, 1.0, 1.0), color=color)
    assert color_of(shape, (0.1, 0.2, 0.3)) == pytest.approx(expected)


def test_a_base_alone_with_shapes_is_drawn():
    base = {"mass": 50, "inertia": [4, 6, 5], "geometry": [{"cylinder": {"radius": 0.5, "length": 1}}]}
    data = {"name": "port", "base": base, "tip": {"position": [0, 0, 0.5]}, "target": {"pose": {}}}
    scene = Scene.model_validate(data)
    picture = Renderer(scene).draw(start_poses(scene), NO_TRAIL)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_goals_of_other_tips_have_axes_on_the_target_or_in_space():
    place, shapes = np.array([0.3, 0.4, 0.5]), {}
    for where, frame in (("target", 1), ("inertial", 3)):
        changes = {"other_tips.0.relative_to": where, "other_tips.0.goal.position": place.tolist()}
        scene = load_scene("dual-arm").replace(changes)
        model = SpacecraftModel(scene)
        corners = model.mesh.corners[model.mesh.frames == model.frame_count + frame]
        assert np.linalg.norm(corners - place, axis=-1).min() < 1e-9  # where the arrows begin
        shapes[where] = solids_of(scene).counts
    arrows = shapes["inertial"][-1]
    assert arrows > 0 == shapes["target"][-1]
    assert shapes["target"][-3] == shapes["inertial"][-3] + arrows
    start = start_poses(scene)
    before = Renderer(scene).draw(start, NO_TRAIL)
    moved = Renderer(scene.replace({"other_tips.0.goal.position": (place + 0.3).tolist()}))
    assert (moved.draw(start, NO_TRAIL) != before).any()
