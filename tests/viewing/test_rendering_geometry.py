"""Solids, camera and depth buffer of the pictures, against identities and against rays cast one by one."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dq_space_arm_env.scene import list_scenes, load_scene
from dq_space_arm_env.viewing.picture_format import View
from dq_space_arm_env.viewing.rendering.camera import Camera, camera_around
from dq_space_arm_env.viewing.rendering.drawing import mesh_faces
from dq_space_arm_env.viewing.rendering.rasterizer import Faces, Rasterizer
from dq_space_arm_env.viewing.rendering.solids import Mesh, ball, box, crumpled_box, cylinder
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel, equivalent_box

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)
STILL = np.eye(3)[None], np.zeros((1, 3))

# Looks along +x from the origin: y goes left, z up.
FORWARD = Camera(np.zeros(3), np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), 60.0, 64, 48)


def faces_of(corners, colors=None, sieved=False):
    """Faces in one color each; by default one that tells their number."""
    count = len(corners)
    if colors is None:
        colors = (np.arange(count)[:, None] + 1 >> np.array([0, 8, 16]) & 255) / 255.0
    return Faces(corners, np.repeat(np.asarray(colors)[:, None], 4, axis=1), np.full(count, sieved))


def nearest_faces(corners, width, height):
    """Number of the nearest face plus one in the middle of every pixel, 0 where there is none."""
    image = np.zeros((height, width, 3), dtype=np.uint8)
    Rasterizer(width, height, samples=1).draw(faces_of(corners), image)
    return image @ np.array([1, 256, 65536])


def volume_and_closure(corners):
    """Volume by the divergence theorem, and the sum of the area vectors, zero for a closed surface."""
    area = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return np.einsum("fi,fi->", corners.mean(axis=1), area) / 3.0, area.sum(axis=0)


# Occlusion ------------------------------------------------------------------------------------------------


def rays_one_by_one(corners, camera):
    """Nearest face in every pixel by intersecting each pixel's ray with each face in space."""
    nearest = np.zeros((camera.height, camera.width), dtype=int)
    for row, column in itertools.product(range(camera.height), range(camera.width)):
        right, down = column + 0.5 - 0.5 * camera.width, row + 0.5 - 0.5 * camera.height
        ray = np.array([right, down, camera.focal_length]) @ camera.axes
        best = math.inf
        for face, (a, b, c, d) in enumerate(corners):
            normal = np.cross(c - a, d - b)
            along = normal @ ray
            if along == 0.0:
                continue
            distance = normal @ (a - camera.position) / along
            hit = camera.position + distance * ray
            sides = [
                np.cross(end - start, hit - start) @ normal >= 0.0
                for start, end in ((a, b), (b, c), (c, d), (d, a))
            ]
            if 0.0 < distance < best and all(sides):
                best, nearest[row, column] = distance, face + 1
    return nearest


@pytest.mark.sampled
@pytest.mark.parametrize("seed", range(4))
def test_depth_buffer_agrees_with_rays_cast_one_by_one(seed):
    rng = np.random.default_rng(seed)
    camera = Camera(FORWARD.position, FORWARD.axes, 20.0, 24, 18)
    boxes = [
        box(0, rng.uniform((3, -1.5, -1.0), (7, 1.5, 1.0)), rng.uniform(0.2, 2.5, 3), RED, _rotation(rng))
        for _ in range(5)
    ]
    corners = Mesh.joined(boxes).corners
    found = nearest_faces(camera.project(corners), camera.width, camera.height)
    expected = rays_one_by_one(corners, camera)
    assert len(np.unique(expected)) > 8
    assert (expected == 0).any()
    np.testing.assert_array_equal(found, expected)


@pytest.mark.sampled
@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_reach_behind_the_camera_are_seen_as_far_as_they_are_before_it(seed):
    """Against rays cast one by one; without cuts at the camera's plane the long faces would be missing."""
    rng = np.random.default_rng(seed)
    camera = Camera(FORWARD.position, FORWARD.axes, 20.0, 24, 18)
    bars = [
        box(0, (2.0, y, z), (*rng.uniform((8.0, 0.3, 0.3), (14.0, 0.8, 0.8)),), color)
        for (y, z), color in zip(((0.0, -0.9), (1.1, 0.2)), (RED, GREEN), strict=True)
    ]
    mesh = Mesh.joined(bars).moved(0, _small_turn(rng), np.zeros(3))
    image = np.zeros((18, 24, 3), dtype=np.uint8)
    Rasterizer(24, 18, samples=1).draw(mesh_faces(mesh, *STILL, camera), image)
    nearest = rays_one_by_one(mesh.corners, camera)
    shown = np.where(image.any(axis=2), 1 + image.argmax(axis=2), 0)
    expected = np.where(nearest > 0, 1 + (nearest > 6), 0)
    assert min((expected == color).sum() for color in (1, 2)) > 10
    np.testing.assert_array_equal(shown, expected)


def _small_turn(rng):
    matrix, _ = np.linalg.qr(np.eye(3) + 0.05 * rng.normal(size=(3, 3)))
    return matrix * np.sign(np.diag(matrix))


def _rotation(rng):
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix


def test_tiles_leave_no_gap_and_do_not_overlap():
    """A skewed grid of tiles at the same depth: each pixel center inside belongs to one of them."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(9) * 5.0 + 3.3, np.arange(7) * 5.0 + 2.1), axis=-1)
    grid[1:-1, 1:-1] += rng.uniform(-1.5, 1.5, (5, 7, 2))
    tiles = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 2)
    corners = np.concatenate([tiles, np.full((48, 4, 1), 0.5)], axis=2)
    counts = sum((nearest_faces(corners[[tile]], 48, 36) > 0).astype(int) for tile in range(48))
    assert (counts[2:32, 3:43] == 1).all()
    assert counts.sum() == 30 * 40


def test_order_of_the_corners_does_not_matter():
    corners = np.array([[(3.2, 2.1, 0.2), (20.7, 4.0, 0.3), (17.0, 15.5, 0.25), (5.0, 12.2, 0.2)]])
    expected = nearest_faces(corners, 24, 18)
    assert expected.any()
    for shift in range(4):
        rolled = np.roll(corners, shift, axis=1)
        for variant in (rolled, rolled[:, ::-1]):
            np.testing.assert_array_equal(nearest_faces(variant, 24, 18), expected)


def test_faces_reach_out_of_the_picture():
    corners = np.array([[(-1e6, -1e6, 0.1), (1e6, -1e6, 0.1), (1e6, 1e6, 0.1), (-1e6, 1e6, 0.1)]])
    assert (nearest_faces(corners, 24, 18) == 1).all()
    assert not nearest_faces(corners + np.array([3e6, 0.0, 0.0]), 24, 18).any()
    assert not nearest_faces(corners[:0], 24, 18).any()


def edge_at(x):
    """A face without gradient of depth that covers everything right of x."""
    return np.array([[(x, -5.0, 0.5), (99.0, -5.0, 0.5), (99.0, 99.0, 0.5), (x, 99.0, 0.5)]])


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_pixel_is_the_mean_of_its_samples(samples):
    background = np.random.default_rng(0).integers(0, 256, (6, 20, 3), dtype=np.uint8)
    rasterizer = Rasterizer(20, 6, samples)
    color = np.array((200.0, 100.0, 50.0))
    for covered in range(samples + 1):
        image = background.copy()
        rasterizer.draw(faces_of(edge_at(7.0 + 1.0 - covered / samples), [color / 255.0]), image)
        np.testing.assert_array_equal(image[:, :7], background[:, :7])
        np.testing.assert_array_equal(image[:, 8:], np.broadcast_to(color, (6, 12, 3)))
        share = covered / samples
        exact = share * color + (1.0 - share) * background[:, 7]
        assert np.abs(image[:, 7] - exact).max() <= 0.5 + 1e-9


def test_sieved_face_lets_half_of_what_is_behind_through():
    image = np.full((6, 20, 3), 100, dtype=np.uint8)
    faces = faces_of(edge_at(10.0), [(200 / 255, 0.0, 100 / 255)], sieved=True)
    Rasterizer(20, 6, samples=4).draw(faces, image)
    np.testing.assert_array_equal(image[:, :10], 100)
    np.testing.assert_array_equal(image[:, 10:], np.broadcast_to((150, 50, 100), (6, 10, 3)))


def test_colors_go_over_from_corner_to_corner():
    corners = np.array([[(0.0, 0.0, 0.5), (20.0, 0.0, 0.5), (20.0, 6.0, 0.5), (0.0, 6.0, 0.5)]])
    colors = np.zeros((1, 4, 3))
    colors[0, 1:3, 0] = 1.0  # red toward the right
    colors[0, 2:, 1] = 0.5  # green toward the bottom
    image = np.zeros((6, 20, 3), dtype=np.uint8)
    Rasterizer(20, 6, samples=1).draw(Faces(corners, colors, np.zeros(1, dtype=bool)), image)
    x, y = np.arange(20) + 0.5, np.arange(6) + 0.5
    assert np.abs(image[..., 0] - 255.0 * x / 20.0).max() <= 1.0
    assert np.abs(image[..., 1] - 127.5 * y[:, None] / 6.0).max() <= 1.0
    assert not image[..., 2].any()


def test_nothing_of_a_picture_is_left_for_the_next_one():
    rasterizer = Rasterizer(20, 6)
    images = [np.zeros((6, 20, 3), dtype=np.uint8) for _ in range(2)]
    for image in images:
        rasterizer.draw(faces_of(edge_at(3.3)), image)
    rasterizer.draw(faces_of(edge_at(3.3)[:0]), image)
    np.testing.assert_array_equal(*images)


# Solids ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sides", [3, 8, 24])
def test_cylinder_is_a_closed_prism(sides):
    start, end = np.array([1.0, 2.0, 3.0]), np.array([-1.0, 2.5, 4.0])
    mesh = cylinder(0, start, end, 0.7, RED, sides)
    volume, closure = volume_and_closure(mesh.corners)
    base = 0.5 * sides * 0.7**2 * math.sin(2.0 * math.pi / sides)
    assert volume == pytest.approx(base * np.linalg.norm(end - start))
    np.testing.assert_allclose(closure, 0.0, rtol=0, atol=1e-12)


def test_ball_is_closed_and_its_volume_converges():
    errors = []
    for sides in (16, 32, 64):
        volume, closure = volume_and_closure(ball(0, (0.0, 1.0, 0.0), 2.0, RED, sides).corners)
        np.testing.assert_allclose(closure, 0.0, rtol=0, atol=1e-11)
        errors.append(4.0 / 3.0 * math.pi * 8.0 - volume)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("name", list_scenes())
def test_solids_of_a_scene_have_planar_faces_with_unit_normals(name):
    mesh = SpacecraftModel(load_scene(name)).mesh
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, rtol=0, atol=1e-12)
    edges = np.diff(mesh.corners, axis=1)
    np.testing.assert_allclose(np.einsum("fci,fi->fc", edges, mesh.normals), 0.0, rtol=0, atol=1e-9)
    assert ((mesh.colors >= 0.0) & (mesh.colors <= 1.0)).all()


def test_normals_of_a_ball_point_away_from_its_center():
    center = np.array((1.0, -1.0, 2.0))
    mesh = ball(0, center, 0.5, RED, 32)
    np.testing.assert_allclose(mesh.corner_normals, (mesh.corners - center) / 0.5, rtol=0, atol=0.01)


def test_crumpled_box_is_a_box_but_for_its_light():
    mesh = crumpled_box(0, (1.0, -2.0, 3.0), (0.5, 2.0, 3.0), RED, _rotation(np.random.default_rng(0)))
    area = 0.5 * np.cross(mesh.corners[:, 2] - mesh.corners[:, 0], mesh.corners[:, 3] - mesh.corners[:, 1])
    area = np.abs(np.einsum("fi,fi->f", area, mesh.normals))
    assert area.sum() == pytest.approx(2 * (1.0 + 1.5 + 6.0))
    outward = np.einsum("fi,fi->f", mesh.corners.mean(axis=1) - (1.0, -2.0, 3.0), mesh.normals)
    assert (area * outward).sum() / 3.0 == pytest.approx(3.0), "the volume, by the divergence theorem"
    leaning = np.einsum("fci,fi->fc", mesh.corner_normals, mesh.normals)
    assert 0.5 < leaning.min() < 0.999


def test_mesh_moves_with_its_frames():
    meshes = [box(0, (0, 0, 0), (1, 1, 1), RED), box(1, (1.0, 0.0, 0.0), (1, 1, 1), GREEN)]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    origins = np.array([(5.0, -1.0, 0.0), (6.0, 0.0, 0.5)])
    by_frames = mesh_faces(Mesh.joined(meshes), np.array([np.eye(3), turn]), origins, FORWARD)
    placed = [meshes[0].moved(0, np.eye(3), origins[0]), meshes[1].moved(0, turn, origins[1])]
    by_hand = mesh_faces(Mesh.joined(placed), *STILL, FORWARD)
    for one, other in zip(by_frames, by_hand, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


@given(st.tuples(*[st.floats(0.2, 3.0)] * 3), st.floats(40.1, 8000.0), st.integers(0, 10))
@settings(derandomize=True, deadline=None)
def test_equivalent_box_has_the_inertia(edges, density, seed):
    """I = m / 12 diag(b^2 + c^2, c^2 + a^2, a^2 + b^2), turned; smaller if that is lighter than foam."""
    squares, mass = np.array(edges) ** 2, density * np.prod(edges)
    moments = mass / 12.0 * (squares.sum() - squares)
    axes = _rotation(np.random.default_rng(seed)) if seed else np.eye(3)
    size, directions = equivalent_box(mass, axes @ np.diag(moments) @ axes.T)
    inertia = directions @ np.diag(mass / 12.0 * ((size**2).sum() - size**2)) @ directions.T
    np.testing.assert_allclose(inertia, axes @ np.diag(moments) @ axes.T, rtol=1e-9, atol=1e-9 * mass)
    light, _ = equivalent_box(1e-3 * mass, axes @ np.diag(1e-3 * moments) @ axes.T)
    np.testing.assert_allclose(light, np.cbrt(1e-3 * density / 40.0) * size, rtol=1e-9)


# Camera ---------------------------------------------------------------------------------------------------


def extent(camera, centers, radii, rng):
    """Lower and upper corner in the picture of what balls cover, pixels."""
    directions = rng.normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = camera.project((centers[:, None] + radii[:, None, None] * directions).reshape(-1, 3))
    return seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)


@pytest.mark.parametrize("seed", range(20))
def test_camera_has_all_balls_in_view_and_no_farther_than_needed(seed):
    rng = np.random.default_rng(seed)
    centers, radii = rng.normal(size=(4, 3)) * 3.0, rng.uniform(0.1, 2.0, 4)
    view = View(azimuth=rng.uniform(-180.0, 180.0), elevation=rng.uniform(-85.0, 85.0))
    low, high = extent(camera_around(centers, radii, view, 640, 480), centers, radii, rng)
    assert (low > -1e-6).all()
    assert (high < (640 + 1e-6, 480 + 1e-6)).all()
    used = (high - low) / (640, 480)
    assert used.max() > 0.98, f"the balls use only {used} of the picture"


@pytest.mark.parametrize("seed", range(20))
def test_camera_aimed_at_a_point_has_all_balls_in_view_and_no_farther_than_needed(seed):
    rng = np.random.default_rng(seed)
    centers, radii = rng.normal(size=(4, 3)) * 3.0, rng.uniform(0.1, 2.0, 4)
    point = rng.normal(size=3) * 6.0
    view = View(rng.uniform(-180.0, 180.0), rng.uniform(-85.0, 85.0), lookat=tuple(point))
    camera = camera_around(centers, radii, view, 640, 480)
    np.testing.assert_allclose(camera.project(point)[:2], (320.0, 240.0), rtol=0, atol=1e-6)
    # The point is a ball too, so that the camera stays before it.
    shown = np.vstack([centers, point]), np.append(radii, radii.min())
    low, high = extent(camera, *shown, rng)
    assert (low > -1e-6).all()
    assert (high < (640 + 1e-6, 480 + 1e-6)).all()
    margin = np.concatenate([low, (640, 480) - high]).min()
    assert margin < 8.0, f"there are {margin:.1f} pixels left on all sides"


def test_camera_aimed_past_what_it_shows_backs_away():
    view = View(azimuth=0.0, elevation=0.0, lookat=(0.0, 50.0, 0.0))
    camera = camera_around([(0.0, 0.0, 0.0)], [1.0], view, 640, 480)
    assert 0.0 < camera.project(np.zeros(3))[0] < 640.0
    behind = camera_around([(0.0, 0.0, 0.0)], [1.0], view._replace(lookat=(-50.0, 0.0, 0.0)), 640, 480)
    assert behind.position[0] < -51.0, "the point is before the camera"
