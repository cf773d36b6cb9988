"""What a page shows of flights: poses (27), errors (31), what is refused, and where a flight is cut off."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import DQSpaceArmEnv, compile_scene, list_scenes, load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.constraint_rows import path_rows
from dq_space_arm_env.scene.pose import PLANAR_POSE
from dq_space_arm_env.viewing.replay import Trajectory, common_scene
from dq_space_arm_env.viewing.replay.curves import panels
from dq_space_arm_env.viewing.replay.flights import MOST_FLIGHTS, prepare, verdict


@pytest.mark.parametrize("name", list_scenes())
def test_frames_are_those_of_the_chain_one_state_at_a_time(name, make_flight):
    """(27) with plain numbers, and the errors (31)."""
    scene = load_scene(name)
    flight = make_flight(scene, steps=5)
    shown = prepare([flight], scene)[0]
    layout, tree = StateLayout.of(scene), KinematicTree.from_scene(scene)
    targets = compile_scene(scene).layout.target_with(compile_scene(scene).stage_parameters())
    for instant, state in enumerate(flight.states.tolist()):
        base = np.zeros(8)
        base[list(PLANAR_POSE) if layout.planar else list(range(8))] = state[layout.state.pose]
        joints, wrist = state[layout.state.joint_angles], state[layout.state.wrist_angles]
        expected = kinematics.frame_poses(tree, tuple(base.tolist()), tree.coordinates(joints), wrist)
        np.testing.assert_allclose(shown.frames[instant], expected, rtol=0, atol=1e-14)
        pairs = [(tuple(expected[-1]), tuple(targets[instant].tolist()))]
        for index, tip in enumerate(scene.other_tips, 1 + len(scene.links)):
            goal = dual_quaternion.multiply(scene.target.pose.dual_quaternion, tip.goal.dual_quaternion)
            pairs.append((tuple(expected[index]), goal))
        angle = max(poses.error_angle(*pair) for pair in pairs)
        assert shown.angle[instant] == pytest.approx(np.degrees(angle), abs=1e-6)
        distance = max(poses.error_distance(*pair) for pair in pairs)
        assert shown.distance[instant] == pytest.approx(distance, abs=1e-12)


def test_neighboring_poses_have_the_same_sign(paper, make_flight):
    flight = make_flight(paper, steps=20)
    states = flight.states.copy()
    states[7:12, :8] *= -1.0
    frames = prepare([replace(flight, states=states)], paper)[0].frames
    np.testing.assert_allclose(frames, prepare([flight], paper)[0].frames, rtol=0, atol=1e-14)
    assert (np.sum(frames[1:, :, :4] * frames[:-1, :, :4], axis=2) > 0.0).all()


@pytest.mark.parametrize(
    ("field", "bad"),
    [("states", np.nan), ("controls", np.inf), ("states", 1e9), ("controls", 1e39), ("noise", -1e200)],
)
def test_diverged_flight_is_cut_off_before_what_is_not_finite(paper, make_flight, bad, field):
    flight = replace(make_flight(paper), noise=np.zeros((60, 12)))
    array = getattr(flight, field).copy()
    array[40:, 3] = bad
    shown = prepare([replace(flight, **{field: array})], paper)[0]
    assert shown.steps == (39 if field == "states" else 40)
    assert shown.frames.shape == (shown.steps + 1, 6, 8)
    assert shown.note == f"diverges after {shown.steps * 0.015:.4g} s"
    assert verdict(shown, paper).startswith("diverges after 0.")
    assert np.isfinite(shown.frames).all()


def test_own_target_is_what_errors_refer_to(paper, make_flight):
    flight = make_flight(paper)
    tip = prepare([flight], paper)[0].frames[-1, -1]
    shown = prepare([replace(flight, target=tip)], paper)[0]
    assert shown.distance[-1] == pytest.approx(0.0, abs=1e-12)
    assert shown.angle[-1] == pytest.approx(0.0, abs=1e-5)
    assert verdict(shown, paper).endswith("success")
    turn = poses.from_axis_angle((0.0, 0.0, 1.0), np.radians(4.0), (0.0, 0.0, 0.0))
    aside = dual_quaternion.multiply(tuple(tip.tolist()), turn)
    missed = prepare([replace(flight, target=np.array(aside))], paper)[0]
    assert missed.angle[-1] == pytest.approx(4.0)
    assert verdict(missed, paper).startswith("ends 4°")
    assert verdict(missed, paper).endswith("outside the tolerances")


def test_success_is_that_of_the_environment(paper, make_flight):
    """It may ask for more than a pose: velocities, a catch."""
    flight = replace(make_flight(paper), attitude_error=1.0, position_error=0.01)
    tip = prepare([flight], paper)[0].frames[-1, -1]
    for success, end in ((True, ": success"), (False, ": no success")):
        shown = prepare([replace(flight, target=tip, is_success=success)], paper)[0]
        assert verdict(shown, paper).endswith(end)


def test_a_plan_is_called_a_success_only_where_no_velocity_counts(paper, make_flight):
    for success, end in (({}, "success"), ({"velocity_error": 0.01}, "pose within the tolerances")):
        scene = paper.replace(success=success)
        flight = prepare([make_flight(scene)], scene)[0]
        plan = replace(flight, angle=np.zeros(61), distance=np.zeros(61))
        assert verdict(plan, scene).endswith(f"from the target: {end}")
        assert verdict(replace(plan, is_success=True), scene).endswith(": success")
        assert verdict(replace(plan, is_success=False), scene).endswith(": no success")
        far = replace(plan, distance=np.ones(61))
        assert verdict(far, scene).endswith(": outside the tolerances")


def test_states_that_are_no_poses_are_refused(paper, make_flight):
    flight = make_flight(paper)
    states = flight.states.copy()
    states[7, :4] *= 2.0
    with pytest.raises(ValueError, match=r"states: entries 0 to 3 have length 2, should have 1"):
        prepare([replace(flight, states=states)], paper)
    with pytest.raises(ValueError, match=r"have length 0, should have 1"):
        prepare([replace(flight, states=np.zeros_like(states))], paper)


@pytest.mark.parametrize("name", ["wheels", "motors"])
def test_constraints_are_those_of_what_acts(name):
    """Full actions, which the actuators cut down to what they can do."""
    scene = load_scene(name)
    env = DQSpaceArmEnv(scene)
    env.reset(seed=0)
    states, controls = [env.state], []
    for _ in range(60):
        action = np.ones(env.action_space.shape, np.float32)
        *_, info = env.step(action)
        assert info["cost"] < 1e-9
        states.append(env.state)
        controls.append(env.kernels.layout.to_control(action))
    flight = Trajectory("full", np.array(states), np.array(controls), scene=scene)
    shown = prepare([flight], scene)[0]
    assert np.abs(shown.acting - shown.controls).max() > 1e-3
    assert not shown.violated[:, :-1].any()


def test_constraints_are_those_of_the_page():
    """Those of the flight's own scene may be others."""
    scene = load_scene("keep-out").replace(simulation={"steps": 20})
    states = np.tile(compile_scene(scene).layout.initial_state, (21, 1))
    controls = np.zeros((20, compile_scene(scene).n_u))
    before = scene.replace(constraints=[])
    shown = prepare([Trajectory("before", states, controls, scene=before)], scene)[0]
    assert shown.violated.shape == (len(path_rows(scene)), 21)


def drifting(start, steps):
    """Poses that move along x and turn about their own z axis by more than a turn, shape (steps + 1, 8)."""
    shares = np.linspace(0.0, 1.0, steps + 1)
    turns = [poses.from_axis_angle((0.0, 0.0, 1.0), 7.0 * share, (0.0, 0.0, 0.0)) for share in shares]
    shifts = [poses.from_axis_angle((0.0, 0.0, 1.0), 0.0, (0.5 * share, 0.0, 0.0)) for share in shares]
    multiply = dual_quaternion.multiply
    return np.array(
        [multiply(multiply(shift, start), turn) for shift, turn in zip(shifts, turns, strict=True)]
    )


def test_errors_refer_to_the_target_of_the_moment(paper, make_flight):
    """State by state, whatever the signs of the poses."""
    flight = make_flight(paper)
    target = drifting(paper.target.pose.dual_quaternion, 60)
    signs = np.where(np.arange(61) % 7 == 3, -1.0, 1.0)[:, None]
    shown = prepare([replace(flight, target=signs * target)], paper)[0]
    np.testing.assert_allclose(shown.target, target, rtol=0, atol=1e-15)
    assert (np.sum(shown.target[1:, :4] * shown.target[:-1, :4], axis=1) > 0.0).all()
    for instant in (0, 3, 31, 60):
        alone = prepare([replace(flight, target=target[instant])], paper)[0]
        assert shown.angle[instant] == pytest.approx(alone.angle[instant], abs=1e-6)
        assert shown.distance[instant] == pytest.approx(alone.distance[instant], abs=1e-12)
    assert verdict(shown, paper) == verdict(prepare([replace(flight, target=target[-1])], paper)[0], paper)


def test_a_target_at_rest_is_one_pose_and_a_moving_one_is_cut_off_with_the_flight(paper, make_flight):
    flight = make_flight(paper)
    target = drifting(paper.target.pose.dual_quaternion, 60)
    resting = prepare([replace(flight, target=np.tile(target[0], (61, 1)), target_body=target)], paper)[0]
    assert resting.target.shape == (8,)
    np.testing.assert_allclose(resting.target_body, target, rtol=0, atol=1e-15)
    states = flight.states.copy()
    states[31:] = np.nan
    cut = prepare([replace(flight, states=states, target=target, target_body=target[0])], paper)[0]
    assert (cut.target.shape, cut.target_body.shape) == ((31, 8), (8,))
    assert prepare([flight], paper)[0].target_body is None


@pytest.mark.parametrize(
    ("angle", "distance", "expected"),
    [
        (104.2, 1.1934, "ends 104° and 1.19 m from the target"),
        (0.456, 0.09994, "ends 0.46° and 10 cm from the target"),
        (0.0, 0.00012, "ends 0° and 0.12 mm from the target"),
    ],
)
def test_verdict_is_in_plain_numbers(paper, make_flight, angle, distance, expected):
    shown = prepare([make_flight(paper, steps=1)], paper)[0]
    ending = replace(shown, angle=np.array([0.0, angle]), distance=np.array([0.0, distance]))
    assert verdict(ending, paper).startswith(expected + ":")


@pytest.mark.parametrize("name", ["tracking", "release"])
def test_flights_beyond_the_end_of_a_scene_need_a_target_where_it_moves(make_flight, name):
    scene = load_scene(name)
    steps = scene.simulation.steps + 1
    flight = make_flight(scene, steps=steps)
    sentence = rf"has {steps} steps, .* for {steps - 1}: give the flight a target of its own"
    with pytest.raises(ValueError, match=sentence):
        prepare([flight], scene)
    with pytest.raises(ValueError, match=sentence):
        common_scene([replace(flight, scene=scene)])
    own = np.tile(scene.target.pose.dual_quaternion, (steps + 1, 1))
    assert prepare([replace(flight, target=own)], scene)[0].steps == steps


def test_unusable_flights_are_refused_in_a_sentence(paper, make_flight):
    good = make_flight(paper)
    nan = np.full_like(good.states, np.nan)
    for flights, sentence in (
        ([], "there is no flight to show"),
        ([good] * (MOST_FLIGHTS + 1), "7 flights, should be at most 6"),
        ([replace(good, label=" ")], "a flight has no label"),
        ([replace(good, states=good.states[:, :5])], r"shape \(61, 5\), should be \(N \+ 1, 23\)"),
        ([replace(good, states=good.states[:1], controls=good.controls[:0])], "1 rows, should be at least 2"),
        ([replace(good, controls=good.controls[1:])], r"controls: shape \(59, 12\), should be \(60, 12\)"),
        ([replace(good, states=nan)], "its first step is not finite"),
        ([replace(good, target=np.zeros(3))], "should be a pose, 8 finite numbers"),
        ([replace(good, target=np.zeros(8))], "its real part should have length 1"),
        ([replace(good, target=np.ones((60, 8)))], "should be a pose, .* or one for each of 61 states"),
        ([replace(good, target_body=np.full((61, 8), np.nan))], "target_body: .* 8 finite numbers"),
        ([replace(good, target_body=np.ones((61, 8)))], "target_body: .*real part should have length 1"),
        ([replace(good, payload=np.ones((61, 8)))], "payload: .*real part should have length 1"),
        ([replace(good, controls=np.full((60, 12), "x"))], "'expert': controls: should be numbers"),
        ([replace(good, states=np.ma.masked_array(good.states, True))], "states: should be numbers .*mask"),
        ([replace(good, controls=good.controls + 0j)], "controls: should be numbers .*type complex128"),
    ):
        with pytest.raises(ValueError, match=sentence):
            prepare(flights, paper)


def test_panels_hold_errors_and_the_actuators_that_there_are(paper, make_flight):
    flights = [make_flight(paper), replace(make_flight(paper, steps=30), noise=np.full((30, 12), 0.25))]
    shown = panels(prepare(flights, paper), paper)
    assert len(shown) == 6
    assert [curve.shape for curve in shown[0].curves] == [(1, 61), (1, 31)]
    joints = shown[4]
    assert (joints.names, joints.unit, joints.bounds) == (("1", "2", "3"), "N m", (-2.0, 2.0))
    np.testing.assert_array_equal(joints.curves[1], flights[1].controls[:, 6:9].T)
    assert joints.disturbed[0] is None
    np.testing.assert_array_equal(joints.disturbed[1], flights[1].controls[:, 6:9].T + 0.25)


def test_small_inputs_are_shown_in_thousandths(paper, make_flight):
    flight = make_flight(paper)
    controls = flight.controls.copy()
    controls[:, :3] *= 1e-3
    force = panels(prepare([replace(flight, controls=controls)], paper), paper)[2]
    assert (force.unit, force.note, force.bounds) == ("mN", "limit ±10 N", (-10000.0, 10000.0))
    np.testing.assert_allclose(force.curves[0], flight.controls[:, :3].T)


def test_motors_that_turn_and_motors_that_slide_have_both_units(make_flight):
    scene = load_scene("sliding")
    flight = make_flight(scene)
    weak = replace(flight, controls=1e-3 * flight.controls)
    units = [panels(prepare([each], scene), scene)[4].unit for each in (flight, weak)]
    assert units == ["N m or N", "mN m or mN"]


def test_inputs_of_limits_far_apart_are_shares_of_them(paper, make_flight):
    scene = paper.replace({"links.0.torque_limit": 2.0, "links.1.torque_limit": 0.001})
    flight = make_flight(scene)
    torque = panels(prepare([flight], scene), scene)[4]
    assert (torque.unit, torque.note, torque.bounds) == (
        "% of each limit",
        "limits ±0.001 to ±2 N m",
        (-100.0, 100.0),
    )
    limits = np.array([2.0, 0.001, 2.0])
    place = StateLayout.of(scene).control.joint_torque
    expected = 100.0 * flight.controls[:, place].T / limits[:, None]
    np.testing.assert_allclose(torque.curves[0], expected, rtol=1e-12)


def test_absent_actuators_have_no_panel(make_flight):
    scene = load_scene("planar")
    shown = panels(prepare([make_flight(scene)], scene), scene)
    assert [panel.names for panel in shown[2:]] == [("x", "y"), ("z",), ("1", "2", "3")]


def test_a_solution_of_a_scene_with_phases_is_shown_with_the_target_of_each_phase(make_flight):
    """The file of a solution has a scene and no target."""
    scene = load_scene("release")
    steps, start = scene.simulation.steps, scene.staged.starts[-1]
    flight = replace(make_flight(scene, steps=steps), scene=scene)
    shown = prepare(common_scene([flight])[0], scene)[0]
    for stage, phase in ((0, 0), (start - 1, 0), (start, -1), (steps, -1)):
        np.testing.assert_allclose(shown.target[stage], scene.staged.resting[phase], rtol=0, atol=1e-15)
    resting = prepare([make_flight(load_scene("refuelling"))], load_scene("refuelling"))[0]
    assert resting.target.shape == (8,)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("no-wrist", {"links.0.joint_type": "prismatic"}),
        ("dual-arm", {"other_tips.0.frame.position": [0.0, 0.1, 0.0]}),
        ("dual-arm", {"other_tips": []}),
    ],
)
def test_robots_that_move_otherwise_are_not_shown_together(name, change):
    scene = load_scene(name)
    flights = []
    for own in (scene, scene.replace({**change, "name": "changed"})):
        layout = compile_scene(own).layout
        states, controls = np.tile(layout.initial_state, (2, 1)), np.zeros((1, layout.n_u))
        flights.append(Trajectory(own.name, states, controls, scene=own))
    with pytest.raises(
        ValueError, match=r"'changed' is one of another robot .*: show them on separate pages"
    ):
        common_scene(flights)
    same = scene.replace({"base.mass": 200.0, "name": "heavy"})
    same = same.replace({"actuators.base_force.limit": 3.0})
    assert common_scene([flights[0], replace(flights[0], scene=same)])[1] == scene


@pytest.mark.parametrize("name", ["thrusters", "free-floating", "motors"])
def test_flights_of_other_actuators_are_not_shown_together(paper, make_flight, name):
    """Six thrusters are as many numbers as force and torque on the base."""
    other = load_scene(name)
    if other.actuators.thrusters:
        other = other.replace({"actuators.thrusters": list(other.actuators.thrusters[:6])})
    flights = [replace(make_flight(scene), scene=scene) for scene in (paper, other)]
    with pytest.raises(ValueError, match=f"other states or inputs \\('{name}'\\) than the scene"):
        common_scene(flights)


def test_a_plan_is_no_success_where_what_it_catches_is_not_known():
    wide = {"attitude_error_deg": 180.0, "position_error": 10.0}
    scene = load_scene("capture-and-detumble")
    scene = scene.replace(success={**wide, "angular_velocity_error_deg": None, "velocity_error": None})
    layout, steps = StateLayout.of(scene), scene.simulation.steps
    states, controls = np.tile(layout.initial_state, (steps + 1, 1)), np.zeros((steps, layout.n_u))
    plan = Trajectory("plan", states, controls, scene=scene)
    assert verdict(prepare([plan], scene)[0], scene).endswith("pose within the tolerances")
