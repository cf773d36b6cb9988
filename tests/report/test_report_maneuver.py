"""The quantities of Figures 3 to 6, and the replays: eq. (31), the cost of section V."""

import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.environment.rollouts import StateFeedback, rollout
from dq_space_arm_env.scene import StateLayout
from experts.report import Maneuver, ManeuverRun, integrator_precision, replay, reproduction, run_maneuver
from experts.report.effort import QUICK
from experts.report.maneuver_run import errors_with_finer_steps
from experts.report.maneuver_summary import print_tables, summarize


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix, written out independently of the package."""
    w, v = quaternion[0], quaternion[1:]
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew


def test_tip_times_error_is_target(paper_maneuver: Maneuver) -> None:
    # (31): q_{G/I} q_{D/G} = q_{D/I}
    target = paper_maneuver.scene.target.pose.dual_quaternion
    for tip, error in zip(paper_maneuver.frames[:, -1], paper_maneuver.error_pose, strict=True):
        assert dual_quaternion.multiply(tip, error) == pytest.approx(target, abs=1e-13)


def test_position_error_is_in_tip_axes(paper_maneuver: Maneuver) -> None:
    target = np.array([0.0, -4.0, 5.0])  # the paper's
    for tip, error in zip(paper_maneuver.frames[:, -1], paper_maneuver.position_error, strict=True):
        (w, *v), (dual_w, *dual_v) = tip[:4], tip[4:]  # r = 2 q_d q_r*
        position = 2.0 * (w * np.array(dual_v) - dual_w * np.array(v) - np.cross(dual_v, v))
        assert rotation_matrix(tip[:4]) @ error == pytest.approx(target - position, abs=1e-13)
    assert paper_maneuver.distance == pytest.approx(np.linalg.norm(paper_maneuver.position_error, axis=1))


def test_angle_is_twice_the_arc_cosine_of_the_scalar_part(paper_maneuver: Maneuver) -> None:
    expected = 2.0 * np.arccos(np.minimum(1.0, np.abs(paper_maneuver.error_pose[:, 0])))
    assert paper_maneuver.angle == pytest.approx(expected, abs=1e-7)


def test_actuator_counts_what_is_at_the_limit(paper_maneuver: Maneuver) -> None:
    joints = paper_maneuver.actuator("joint_torque")
    assert joints.clamped_share == pytest.approx(4 / (40 * 3))
    assert joints.largest[0] == 2.0
    assert joints.largest[1:].max() < 2.0
    shares = [actuator.clamped_share > 0.0 for actuator in paper_maneuver.actuators]
    assert shares == [False, False, True, False]


def test_a_thruster_that_is_idle_is_at_its_limit() -> None:
    layout = StateLayout.of(load_scene("thrusters"))
    controls = np.tile(0.5 * layout.control_limit, (10, 1))
    controls[:4, layout.control.thruster_force] = 0.0
    maneuver = Maneuver(load_scene("thrusters"), np.tile(layout.initial_state, (11, 1)), controls)
    shares = {actuator.name: actuator.clamped_share for actuator in maneuver.actuators}
    assert shares.pop("thruster_force") == pytest.approx(0.4)
    assert not any(shares.values())


def test_efforts_add_up_to_the_input_part_of_the_cost(paper_maneuver: Maneuver) -> None:
    kernels = compile_scene(paper_maneuver.scene)
    states, controls = paper_maneuver.states[:-1], paper_maneuver.controls
    effort = np.sum(kernels.cost(states, controls) - kernels.cost(states, 0.0 * controls))
    assert sum(actuator.effort for actuator in paper_maneuver.actuators) == pytest.approx(effort, rel=1e-9)
    values = np.hstack([actuator.values for actuator in paper_maneuver.actuators])
    assert np.array_equal(values, controls)


def test_phases_have_weights_and_robots_of_their_own() -> None:
    """A coast whose torques cost more, and a payload that is let go on the way."""
    plain = load_scene("release")
    last = len(plain.phases) - 1
    scene = plain.replace({f"phases.{last}.changes.cost.joint_torque": 10.0})
    kernels = compile_scene(scene)
    rows, steps = kernels.stage_parameters(), scene.simulation.steps
    actions = np.random.default_rng(1).uniform(-0.01, 0.01, (steps, kernels.n_u))
    flown = rollout(StateFeedback(lambda states, stage: actions[stage, None]), scene, record=True)
    assert flown.states is not None
    assert flown.controls is not None
    maneuver = Maneuver(scene, flown.states[0], flown.controls[0])
    states = flown.states[0, :-1]
    acting = flown.controls[0]
    effort = np.sum(
        kernels.cost(states, acting, p=rows[:-1]) - kernels.cost(states, 0.0 * acting, p=rows[:-1])
    )
    assert sum(actuator.effort for actuator in maneuver.actuators) == pytest.approx(effort, rel=1e-9)
    found = errors_with_finer_steps(scene, acting)
    assert found is not None
    np.testing.assert_allclose(found, [flown.attitude_error[0], flown.position_error[0]], rtol=0.0, atol=1e-6)


def test_a_limit_of_a_phase_is_that_of_its_steps(short_scene: Scene) -> None:
    """A joint whose torque is limited to 0.1 N m in the first 20 of 60 steps, and to 0.5 N m then."""
    weak = {"name": "weak", "steps": 20, "changes": {"links.0.torque_limit": 0.1}}
    scene = short_scene.replace(
        {"links.0.torque_limit": 0.5, "phases": [weak, {"name": "strong", "steps": 40}]}
    )
    layout, controls = StateLayout.of(scene), np.zeros((60, 2))
    controls[:20, layout.control.joint_torque], controls[20:, layout.control.joint_torque] = 0.1, -0.2
    flown = replay(scene, controls)
    kernels = compile_scene(scene)
    end = kernels.simulate(layout.initial_state, controls, 60, p=kernels.stage_parameters()[:-1])[-1]
    attitude, position = kernels.tip_errors(end, p=kernels.stage_parameters()[-1])[:2]
    np.testing.assert_allclose(flown.attitude_error[0], attitude, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(flown.position_error[0], position, rtol=0.0, atol=1e-9)
    motor = Maneuver(scene, np.tile(layout.initial_state, (61, 1)), controls).actuator("joint_torque")
    assert motor is not None
    assert motor.limits.tolist() == [0.5]
    assert motor.clamped_share == pytest.approx(20 / 60)


def test_an_actuator_out_of_work_is_at_no_limit() -> None:
    scene = load_scene("capture-and-detumble")
    idle = next(phase for phase in scene.phases if ("actuators.joint_torque", None) in phase.changes)
    assert 0 < idle.steps < scene.simulation.steps
    layout, steps = StateLayout.of(scene), scene.simulation.steps
    still = Maneuver(scene, np.tile(layout.initial_state, (steps + 1, 1)), np.zeros((steps, layout.n_u)))
    assert [actuator.clamped_share for actuator in still.actuators] == [0.0] * len(still.actuators)


def test_thrusters_out_of_work_are_at_no_limit_and_closed_ones_at_their_least() -> None:
    closed = {"name": "closed", "steps": 1, "changes": {"actuators": {"thrusters": None}}}
    scene = load_scene("thrusters").replace(
        {"simulation.steps": 3, "phases": [{"name": "open", "steps": 2}, closed]}
    )
    layout = StateLayout.of(scene)
    maneuver = Maneuver(scene, np.tile(layout.initial_state, (4, 1)), np.zeros((3, layout.n_u)))
    jets = maneuver.actuator("thruster_force")
    assert jets is not None
    assert jets.at_limit.all(axis=1).tolist() == [True, True, False]


def test_absent_actuators_are_left_out(short_run: ManeuverRun) -> None:
    assert [actuator.name for actuator in short_run.maneuver.actuators] == ["base_torque", "joint_torque"]
    assert short_run.maneuver.actuator("base_force") is None
    assert short_run.maneuver.time[[0, 1, -1]] == pytest.approx([0.0, 0.05, 3.0])


def test_replay_flies_and_charges_what_the_solver_planned(short_run: ManeuverRun) -> None:
    planned = [math.degrees(short_run.maneuver.angle[-1]), short_run.maneuver.distance[-1]]
    assert short_run.solution.converged
    assert short_run.replay.is_success[0]
    flown = [short_run.replay.attitude_error[0], short_run.replay.position_error[0]]
    assert flown == pytest.approx(planned, rel=1e-9)
    whole = errors_with_finer_steps(short_run.scene, short_run.solution.controls, substeps=1)
    assert whole == pytest.approx(planned, rel=1e-9)
    assert short_run.replay_difference < 1e-12
    assert short_run.replay_agrees
    assert sum(short_run.cost_terms.values()) == pytest.approx(short_run.solution.cost, rel=1e-12)


def test_a_missed_catch_is_no_contradiction_of_environment_and_solver(short_run: ManeuverRun) -> None:
    flown = replace(short_run.replay, caught=np.array([False]))
    missed = replace(short_run, replay=flown)
    assert reproduction._verdict(missed).startswith("A catch is MISSED: J is as if it were met")


def test_scenes_in_single_precision_are_replayed_in_double(short_run: ManeuverRun) -> None:
    """As they are solved: their rounding is no fault of solver or environment."""
    run = run_maneuver(short_run.scene.replace(simulation={"precision": "float32"}))
    assert run.replay_agrees
    assert run.replay_cost == short_run.replay_cost
    assert run.finer_errors == short_run.finer_errors


def test_a_maneuver_that_costs_nothing_is_shown_too(short_scene: Scene) -> None:
    still = compile_scene(short_scene).tip_pose(StateLayout.of(short_scene).initial_state)
    run = run_maneuver(short_scene.replace(target={"pose": {"dual_quaternion": still.tolist()}}))
    assert run.solution.cost == run.replay_cost == run.replay_difference == 0.0
    assert run.replay_agrees
    print_tables(Console(file=io.StringIO()), run)
    assert summarize(run)["replay"]["relative_difference"] == 0.0


def test_finer_steps_show_the_error_of_a_poor_integrator(short_scene: Scene) -> None:
    simulation = {"dt": 0.05, "steps": 60, "integrator": "symplectic_euler"}
    poor = short_scene.replace(simulation=simulation)
    controls = np.tile([0.5, 0.2], (60, 1))
    planned = replay(poor, controls)
    angle, distance = errors_with_finer_steps(poor, controls)
    finer_angle, finer_distance = errors_with_finer_steps(poor, controls, substeps=8)
    assert abs(planned.attitude_error[0] - angle) > 1e-2  # degrees
    assert abs(finer_angle - angle) < 1e-6
    assert abs(finer_distance - distance) < 1e-6


def test_finer_steps_show_the_worst_of_several_tips(short_scene: Scene) -> None:
    far = {"name": "far", "link": "base", "relative_to": "inertial", "goal": {"position": [0.0, 3.0, 0.0]}}
    scene = short_scene.replace(other_tips=[far])
    _, distance = errors_with_finer_steps(scene, np.zeros((60, 2)))
    assert distance == pytest.approx(3.0, abs=1e-9)


def test_each_error_has_its_own_verdict_and_a_pose_within_may_be_no_success(short_run: ManeuverRun) -> None:
    exact = short_run.scene.replace(success={"position_error": 1e-12})
    for scene, flown, verdict in (
        (short_run.scene, True, "within"),
        (short_run.scene, False, "within"),
        (exact, False, "NOT within"),
    ):
        replayed = replace(short_run.replay, is_success=np.array([flown]))
        console = Console(width=200, record=True, file=io.StringIO())
        print_tables(console, replace(short_run, scene=scene, replay=replayed))
        text = console.export_text()
        assert re.search("attitude error .*° +within the tolerance of 3°", text)
        assert re.search(f"position error .* m +{verdict} the tolerance of", text)
        assert bool(re.search("success +NO ", text)) == (verdict == "within" and not flown)


def test_zero_controls_cost_is_that_of_staying(short_run: ManeuverRun) -> None:
    # At rest without gravity, nothing moves: N stage costs and a terminal cost of the initial state.
    kernels = compile_scene(short_run.scene)
    start = kernels.layout.initial_state
    expected = 60 * kernels.cost(start, np.zeros(2)) + kernels.terminal_cost(start)
    assert short_run.zero_control_cost == pytest.approx(expected, rel=1e-9)


def test_delays_count_steps_so_finer_ones_show_no_error_of_the_integrator(short_run: ManeuverRun) -> None:
    delayed = short_run.scene.replace(actuators={"joint_torque": {"limit": 0.5, "delay": 2}})
    assert errors_with_finer_steps(delayed, short_run.solution.controls) is None
    run = replace(short_run, finer_errors=None)
    assert summarize(run)["finer_integration"]["final_attitude_error_deg"] is None
    console = Console(width=200, record=True, file=io.StringIO())
    print_tables(console, run)
    assert "delays of actuators are whole steps" in console.export_text()
    with pytest.raises(ValueError, match="another step would be another robot"):
        integrator_precision.measure(delayed, QUICK, lambda *given: None)


def test_a_missed_payload_goes_on_without_the_tip() -> None:
    scene = load_scene("capture-and-detumble")
    layout, steps = StateLayout.of(scene), scene.simulation.steps
    still = Maneuver(scene, np.tile(layout.initial_state, (steps + 1, 1)), np.zeros((steps, layout.n_u)))
    held, missed = still.payload, replace(still, caught=False).payload
    assert held is not None
    assert missed is not None
    np.testing.assert_array_equal(held[-1], still.frames[-1, -1])
    assert poses.error_distance(tuple(missed[-1]), tuple(still.frames[-1, -1])) > 0.1
