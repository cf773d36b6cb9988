"""Solids and view of a page: closed surfaces seen from outside, everything in the picture."""

import numpy as np
import pytest

from dq_space_arm_env import list_scenes, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.viewing.rendering.solids import Mesh, ball, box
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.viewing.replay.flights import prepare
from dq_space_arm_env.viewing.replay.geometry import direction, smooth_normals, solids_of, view_of


@pytest.mark.sampled
@pytest.mark.parametrize("name", list_scenes())
def test_triangles_enclose_the_volume_of_the_mesh(name):
    """By the divergence theorem; a triangle the wrong way around would take its part away."""
    scene = load_scene(name)
    solids, mesh = solids_of(scene), SpacecraftModel(scene).mesh
    a, b, c = np.moveaxis(solids.positions[solids.triangles].astype(float), 1, 0)
    area = 0.5 * np.cross(b - a, c - a)
    quads = 0.5 * np.cross(mesh.corners[:, 2] - mesh.corners[:, 0], mesh.corners[:, 3] - mesh.corners[:, 1])
    outward = np.sign(np.einsum("fi,fi->f", quads, mesh.normals))[:, None] * quads
    volume = np.einsum("fi,fi->", outward, mesh.corners.mean(axis=1)) / 3.0
    assert np.einsum("ti,ti->", a, area) / 3.0 == pytest.approx(volume, rel=2e-3)
    assert volume > 0.0
    normals = solids.normals[solids.triangles[:, 0], :3].astype(float)
    assert (np.einsum("ti,ti->t", normals, area) > 0.0).mean() > 0.999
    assert sum(solids.counts) == len(solids.triangles)
    assert len(solids.counts) == SpacecraftModel(scene).frame_count + 4


def test_a_ball_is_shaded_round_and_a_box_is_not():
    smooth = smooth_normals(Mesh.joined([ball(0, (0.0, 0.0, 0.0), 2.0, (1.0, 1.0, 1.0))]))
    corners = ball(0, (0.0, 0.0, 0.0), 2.0, (1.0, 1.0, 1.0)).corners
    assert (np.einsum("fki,fki->fk", smooth, corners / 2.0) > 0.995).all()
    cube = box(0, (0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (1.0, 1.0, 1.0))
    np.testing.assert_array_equal(smooth_normals(cube), np.repeat(cube.normals[:, None], 4, axis=1))


@pytest.mark.sampled
@pytest.mark.parametrize("name", list_scenes())
def test_the_points_to_be_seen_surround_every_corner(name, make_flight):
    scene = load_scene(name)
    flight = make_flight(scene)
    shown = prepare([flight], scene)
    view = view_of(shown, scene)
    assert len(view.points) <= 240
    # The target, and the tip at both ends, lie within them, in the camera's directions and any other.
    tips = np.transpose(poses.position(shown[0].frames[[0, -1], -1].T))
    inside = np.array([scene.target.pose.position, *tips])
    for axis in (*np.eye(3), direction(view.azimuth, view.elevation)):
        along = view.points @ axis
        assert ((along.min() <= inside @ axis) & (inside @ axis <= along.max())).all()


def test_planar_scenes_are_seen_from_above_and_others_from_a_side(make_flight, paper):
    planar = load_scene("planar")
    assert view_of(prepare([make_flight(planar)], planar), planar).elevation > 1.0
    assert view_of(prepare([make_flight(paper)], paper), paper).elevation < 0.7


def test_a_robot_that_flies_away_does_not_shrink_the_picture(make_flight, paper):
    flight = make_flight(paper)
    near = view_of(prepare([flight], paper), paper)
    states = flight.states.copy()
    states[-8:, 4:8] *= 1e4  # the dual part of the base's pose: kilometers away
    away = view_of(prepare([type(flight)("away", states, flight.controls)], paper), paper)
    assert np.ptp(away.points, axis=0).max() < 2.0 * np.ptp(near.points, axis=0).max()


def test_a_target_far_away_is_in_the_picture(make_flight, paper):
    scene = paper.replace({"target.pose.position": (0.0, 30.0, 0.0)})
    points = view_of(prepare([make_flight(scene)], scene), scene).points
    assert np.linalg.norm(points - [0.0, 30.0, 0.0], axis=1).min() < 1.0
