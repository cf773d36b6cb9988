"""Constraints in pictures: shapes of the right size, red where the compiled residuals are violated."""

import json
import re
from base64 import b64decode

import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.constraint_rows import path_rows
from dq_space_arm_env.viewing.constraint_shapes import (
    GAS,
    INERTIAL,
    VISIBLE,
    constraint_shapes,
    gas_of,
    shapes_in_space,
    violations,
)
from dq_space_arm_env.viewing.replay import replay_page
from dq_space_arm_env.viewing.replay.flights import prepare
from dq_space_arm_env.viewing.replay.geometry import constraints_of

CAPSULE = {"frame": "link 2", "position": [0.1, 0, 0], "to": [0.1, 0.6, 0], "radius": 0.05}
KINDS = [
    {
        "name": "far",
        "kind": "distance",
        "bodies": [CAPSULE],
        "obstacles": [{"frame": "inertial", "radius": 6.0}],
    },
    {
        "name": "sun",
        "kind": "keep_out_direction",
        "axis": {"frame": "base", "direction": [0, 0, 2]},
        "direction": {"frame": "inertial", "direction": [1, 0, 0]},
        "angle_deg": 120,
    },
    {
        "name": "camera",
        "kind": "line_of_sight",
        "camera": {"frame": "base", "position": [0, 0, 0.5]},
        "boresight": [0, -1, 0],
        "angle_deg": 30,
        "point": {"frame": "grasp"},
    },
    {
        "name": "corridor",
        "kind": "approach_corridor",
        "apex": {"frame": "target"},
        "direction": [-1, 0, 0],
        "angle_deg": 25,
        "width": 0.1,
    },
    {"name": "limits", "kind": "joint_limits", "rate": 1.0},
    {
        "name": "gas",
        "kind": "plume",
        "thruster": [0.1, 0, -0.4],
        "angle_deg": 20,
        "keeps_clear": {"frame": "tip", "radius": 0.2},
    },
]


@pytest.fixture(scope="module")
def constrained(paper):
    return paper.replace(constraints=KINDS)


def test_shapes_have_the_sizes_and_frames_of_the_constraints(constrained):
    far, sun, camera, corridor, limits, gas = constraint_shapes(constrained, 2.0)
    body, obstacle = (shape.mesh.corners.reshape(-1, 3) for shape in far)
    axis = np.clip(body[:, 1], 0.0, 0.6)
    offsets = np.linalg.norm(body - np.stack([np.full_like(axis, 0.1), axis, 0 * axis], axis=1), axis=1)
    np.testing.assert_allclose(offsets, 0.05, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(obstacle, axis=1), 6.0, rtol=0, atol=1e-12)
    assert (far[1].place, far[1].axes) == (INERTIAL, INERTIAL)
    cone, needle = sun
    rim = cone.mesh.corners.reshape(-1, 3)
    rim = rim[np.linalg.norm(rim, axis=1) > 1e-9]
    np.testing.assert_allclose(
        rim[:, 2] / np.linalg.norm(rim, axis=1), np.cos(np.radians(120)), rtol=0, atol=1e-12
    )
    assert (needle.place, needle.axes) == (0, INERTIAL)
    seen = camera[0].mesh.corners.reshape(-1, 3) - [0, 0, 0.5]
    seen = seen[np.linalg.norm(seen, axis=1) > 1e-9]
    np.testing.assert_allclose(
        -seen[:, 1] / np.linalg.norm(seen, axis=1), np.cos(np.radians(30)), rtol=0, atol=1e-12
    )
    wall = corridor[0].mesh.corners.reshape(-1, 3)
    radius = 0.1 - wall[:, 0] * np.tan(np.radians(25))
    np.testing.assert_allclose(np.linalg.norm(wall[:, 1:], axis=1), radius, rtol=0, atol=1e-12)
    assert limits == []
    assert gas[0].rows == gas[1].rows == (10,)
    assert (gas[1].place, gas[1].axes, gas[1].nozzle) == (0, GAS, (0.1, 0.0, -0.4))
    blown = gas[1].mesh.corners.reshape(-1, 3)
    blown = blown[np.linalg.norm(blown, axis=1) > 1e-9]
    np.testing.assert_allclose(
        blown[:, 2] / np.linalg.norm(blown, axis=1), np.cos(np.radians(20)), rtol=0, atol=1e-12
    )


def test_gas_leaves_against_the_force(paper):
    controls = np.zeros((2, 12))
    controls[:, :3] = [[10, 0, 0], [0, -5, 2.5]]
    found = gas_of(paper, controls)
    np.testing.assert_array_equal(found, [[[-1, 0, 0]], [[0, 0.5, -0.25]], [[0, 0, 0]]])


def test_each_thruster_blows_at_its_place_as_it_fires(make_flight):
    scene = load_scene("thrusters")
    flight, jets = make_flight(scene), scene.actuators.thrusters
    drawn = constraints_of(scene, prepare([flight], scene))
    assert (drawn.names, drawn.frames) == (("thrusters",), tuple((0, GAS - 1 - i) for i in range(8)))
    assert drawn.nozzles == tuple(jet.position for jet in jets)
    fired = np.maximum(flight.controls[:, -8:], 0.0) / 5.0
    expected = -fired[:, :, None] * np.array([jet.unit_direction for jet in jets])
    np.testing.assert_allclose(drawn.gas[0][:-1, 1:], expected, rtol=0, atol=1e-15)
    assert not drawn.gas[0][-1].any()
    assert not drawn.violated[0].any()
    sphere = {"frame": "tip", "radius": 0.3}
    clear = {"kind": "plume", "name": "gas", "angle_deg": 20, "keeps_clear": sphere}
    careful = scene.replace(constraints=[clear])
    around, *cones = constraint_shapes(careful, 2.0)[0]
    assert [shape.rows for shape in (around, *cones)] == [tuple(range(8)), *((i,) for i in range(8))]
    assert constraints_of(careful, prepare([flight], careful)).names == ("gas",)


def test_what_is_red_is_what_the_compiled_residuals_call_violated(constrained, make_flight):
    kernels, flight = compile_scene(constrained), make_flight(constrained)
    aim = np.array(constrained.target.pose.dual_quaternion)
    found = violations(constrained, flight.states, flight.controls, aim, aim)
    residuals = kernels.constraints(flight.states[:-1], flight.controls)
    tolerance = [row.tolerance for row in path_rows(constrained)]
    expected = residuals > VISIBLE * np.array(tolerance)
    np.testing.assert_array_equal(found[:, :-1], expected.T)
    assert expected.any(axis=0).sum() >= 3  # of several kinds


def test_what_is_red_belongs_to_the_grasp_of_the_flight():
    scene = load_scene("planar").replace(
        {
            "target.grasp": {"position": [0.1, 0.0, 0.0]},
            "spread.grasp_position": 1.0,
            "simulation.steps": 3,
            "constraints": [
                {
                    "name": "apart",
                    "kind": "distance",
                    "bodies": [{"frame": "base", "radius": 0.9}],
                    "obstacles": [{"frame": "grasp", "radius": 0.9}],
                }
            ],
        }
    )
    flown = rollout(lambda seen: np.zeros((len(seen), 6)), scene, list(range(6)), record=True)
    kernels = compile_scene(scene)
    rows = (kernels.stage_parameters(p)[:-1] for p in flown.parameters)
    residuals = [
        kernels.constraints(states[:-1], controls, p=p)[:, 0]
        for states, controls, p in zip(flown.states, flown.controls, rows, strict=True)
    ]
    expected = np.array(residuals) > VISIBLE * path_rows(scene)[0].tolerance
    flights = prepare([flown.trajectory(i, label="a flight") for i in range(6)], scene)
    np.testing.assert_array_equal([flight.violated[0, :-1] for flight in flights], expected)
    assert 0 < expected.all(axis=1).sum() < 6


def test_what_the_tip_holds_in_a_phase_counts():
    """The momentum of an arm that has let its payload go is that of the scene without payload."""
    scene = load_scene("release").replace(constraints=[{"name": "spin", "kind": "momentum", "angular": 3.0}])
    layout, rng = StateLayout.of(scene), np.random.default_rng(0)
    states = np.tile(layout.initial_state, (1201, 1))
    states[:, layout.state.joint_rates] = rng.normal(scale=0.3, size=(1201, 3))
    controls, aim = np.zeros((1200, layout.n_u)), np.array(scene.target.pose.dual_quaternion)
    found = violations(scene, states, controls, aim, aim)
    laden, empty = (
        violations(each, states, controls, aim, aim)
        for each in (scene.replace(phases=()), scene.replace({"phases": (), "payload": None}))
    )
    assert (laden != empty).any(axis=1).all()
    np.testing.assert_array_equal(found[:, :800], laden[:, :800])
    np.testing.assert_array_equal(found[:, 800:], empty[:, 800:])


def test_the_page_knows_shapes_and_violations(constrained, make_flight, paper):
    flight = make_flight(constrained)
    pages = [replay_page([flight], scene) for scene in (paper, constrained)]
    text = r'<script type="application/json" class="replay-data"[^>]*>(.*?)</script>'
    plain, data = (json.loads(re.search(text, page, re.DOTALL)[1]) for page in pages)
    assert "constraints" not in plain
    drawn, blob, flight = data["constraints"], b64decode(data["blob"]), make_flight(constrained)

    def table(place, rows):
        return np.frombuffer(blob, place["type"], place["length"], place["start"]).reshape(rows, -1)

    assert drawn["names"] == [each["name"] for each in KINDS]
    assert drawn["owners"] == [0, 0, 1, 1, 2, 2, 3, 5, 5]
    assert drawn["frames"][-1] == [0, GAS]
    np.testing.assert_array_equal(
        table(drawn["gas"][0], len(flight.states)),
        gas_of(constrained, flight.controls)[:, 0].astype(np.float32),
    )
    assert drawn["frames"][:3] == [[2, 2], [-1, -1], [0, 0]]
    shapes, broken = table(drawn["violated"][0], 9), table(drawn["broken"][0], 6)
    np.testing.assert_array_equal(shapes, broken[drawn["owners"]])  # each of these has one row, or none
    assert broken.any()
    assert not broken.all()


def test_scenes_that_ship_have_few_shapes():
    counts = [len(group) for group in constraint_shapes(load_scene("keep-out"), 1.0)]
    assert counts == [3, 2]


def test_shapes_stand_in_space_where_their_frames_are(constrained):
    """The base is turned and moved: its cones go with it, the sun and the ball in space do not."""
    shapes = [shape for group in constraint_shapes(constrained, 2.0) for shape in group]
    turn = rotations.from_axis_angle((0.6, 0.0, 0.8), 0.7)
    pose = np.array(poses.from_rotation_and_position(turn, (1.0, 2.0, 3.0)))
    matrix, origin = np.array(rotations.to_matrix(turn)), np.array([1.0, 2.0, 3.0])
    layout = StateLayout.of(constrained)
    count = compile_scene(constrained).frame_poses(layout.initial_state).shape[0]
    frames = np.tile(pose, (count + 2, 1))
    gas = np.array([[0.0, 0.25, 0.0]])
    placed = [mesh.corners.reshape(-1, 3) for mesh in shapes_in_space(shapes, frames, gas)]
    assert len(placed) == len(shapes)
    for corners, shape in zip(placed, shapes, strict=True):
        own = shape.mesh.corners.reshape(-1, 3)
        if shape.place == INERTIAL:
            expected = own
        elif shape.axes == INERTIAL:
            expected = origin + own
        elif shape.axes > GAS:
            expected = own @ matrix.T + origin
        else:  # along the force's gas in base axes, half as long at a quarter of the largest force
            along = (corners - (matrix @ shape.nozzle + origin)) @ matrix
            np.testing.assert_allclose(along[:, 1].max(), 0.5 * own[:, 2].max())
            np.testing.assert_allclose(
                np.hypot(along[:, 0], along[:, 2]).max(), 0.5 * own[:, 0].max(), rtol=0.01
            )
            continue
        np.testing.assert_allclose(corners, expected, rtol=0, atol=1e-12)
    quiet = [*shapes_in_space(shapes, frames, 0.0 * gas)]
    assert len(quiet) == len(shapes) - 1
