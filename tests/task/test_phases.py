"""Phases: the environment, the kernels and the solver's rows agree; a catch is a plastic impact."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import dq_space_arm_env
from dq_space_arm_env import Scene, SceneError, compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics import kinematics, minimal
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.environment.catches import catches
from dq_space_arm_env.environment.disturbances import with_loads
from dq_space_arm_env.environment.rollouts import StateFeedback, rollout
from dq_space_arm_env.interoperability.pinocchio_twin import pinocchio_model, to_pinocchio
from dq_space_arm_env.kernels.capture import catch_payload
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.parameters import parameters
from dq_space_arm_env.scene.phases import phase_scene
from dq_space_arm_env.task.catching import Catching
from dq_space_arm_env.task.equations import SceneEquations
from experts.problems.arm_problem import ArmProblem

ANYWAY = {
    "attitude_error_deg": 180.0,
    "position_error": 100.0,
    "angular_velocity_error_deg": None,
    "velocity_error": None,
}


def shortened(name: str) -> Scene:
    """A scene with phases, in a tenth of its steps and with a catch that succeeds anywhere."""
    scene = load_scene(name)
    lengths = [max(1, phase.steps // 10) for phase in scene.phases]
    changes: dict[str, Any] = {f"phases.{i}.steps": steps for i, steps in enumerate(lengths)}
    for index, phase in enumerate(scene.phases):
        if phase.catch is not None:
            changes |= {f"phases.{index}.catch": ANYWAY}
    return scene.replace({**changes, "simulation.steps": sum(lengths)})


SCENES = {name: shortened(name) for name in ("capture-and-detumble", "release", "refuelling")}
SCENES["refuelling"] = SCENES["refuelling"].replace({"phases.2.changes.cost.base_torque": 3.0})


def test_a_motion_with_more_steps_than_the_phases_has_no_numerical_error() -> None:
    kernels = compile_scene(SCENES["release"])
    steps = kernels.scene.simulation.steps + 1
    states = np.tile(kernels.layout.initial_state, (steps + 1, 1))
    with pytest.raises(ValueError, match=rf"u: {steps} steps, should be at most {steps - 1}: the phases"):
        kernels.numerical_error(states, np.zeros((steps, kernels.n_u)))


@pytest.mark.sampled
@pytest.mark.parametrize("name", SCENES)
def test_an_episode_costs_what_the_kernels_say_stage_by_stage(name: str) -> None:
    scene = SCENES[name]
    env = gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped
    venv = gymnasium.make_vec("DQSpaceArm-v0", num_envs=3, scene=scene)
    assert isinstance(env, dq_space_arm_env.DQSpaceArmEnv)
    kernels, rng = env.kernels, np.random.default_rng(0)
    first, _ = env.reset(seed=7)
    assert np.array_equal(venv.reset(seed=7)[0][0], first)
    rows, x, cost, returned = kernels.stage_parameters(env.parameters), env.state, 0.0, 0.0
    for stage in range(scene.simulation.steps):
        action = rng.uniform(-0.3, 0.3, kernels.n_u).astype(np.float32)
        u = kernels.layout.limits_with(rows[stage]) * action.astype(np.float64)
        cost += kernels.cost(x, u, p=rows[stage])
        x = kernels.step(x, u, p=rows[stage])
        observation, reward, over, _, info = env.step(action)
        returned += float(reward)
        seen, rewards, *_ = venv.step(np.tile(action, (3, 1)))
        assert np.array_equal(seen[0], observation)
        assert rewards[0] == reward
        assert np.abs(env.state - x).max() < 1e-13
        assert info["phase"] == rows[stage + 1][kernels.parameters.names.index("phase")]
        assert np.abs(env.stage_parameters - rows[stage + 1]).max() < 1e-13
    cost += kernels.terminal_cost(x, p=rows[-1])
    assert over
    assert returned == pytest.approx(-cost, rel=1e-13)


def test_motors_that_turn_and_motors_that_slide_share_a_weight_that_phases_change() -> None:
    phases = [{"name": "a", "steps": 1}, {"name": "b", "steps": 1, "changes": {"cost.joint_torque": 10.0}}]
    scene = load_scene("no-wrist").replace(
        {"links.1.joint_type": "prismatic", "phases": phases, "simulation.steps": 2}
    )
    env = dq_space_arm_env.DQSpaceArmEnv(scene)
    kernels, action = env.kernels, np.full(9, 0.5)
    assert kernels.parameters.names == ("phase", "cost.joint_torque")
    assert kernels.parameters.units == ("1", "(N m)^-2 or (N)^-2")
    env.reset(seed=0)
    for row in kernels.stage_parameters()[:2]:
        effort = kernels.cost(env.state, kernels.layout.to_control(action), p=row)
        effort -= kernels.cost(env.state, np.zeros(9), p=row)
        assert env.step(action)[-1]["cost_control"] == pytest.approx(effort, rel=1e-12)


def test_a_body_that_came_to_rest_is_caught_at_rest() -> None:
    rest = {"target.motion": None, "target.pose.position": [1.7, -0.5, 0.9]}
    scene = SCENES["capture-and-detumble"].replace(
        phases=[
            {"name": "tumble", "steps": 1, "changes": {"payload": None}},
            {"name": "rest", "steps": 1, "changes": {"payload": None, **rest}},
            {"name": "hold", "steps": 1, "catch": ANYWAY, "changes": rest},
        ],
        simulation={"steps": 3},
    )
    kernels = compile_scene(scene)
    caught = kernels.stage_parameters()[1, kernels.parameters.indices("catch")]
    assert caught.tolist() == [1.0, *[0.0] * 6]


SLIDING = {"kind": "screw", "linear_velocity": [1.0, 0.0, 0.0]}
PASSING = {
    "kind": "waypoints",
    "points": [{"time": t, "pose": {"position": [1.5 + t, 0.0, 0.0]}} for t in (0.0, 10.0)],
}


@pytest.mark.parametrize("motion", [SLIDING, PASSING])
def test_a_body_that_came_to_rest_is_caught_where_it_rests(motion: dict[str, Any]) -> None:
    """However its way would have gone on."""
    still: dict[str, Any] = {"target.motion": None}
    scene = load_scene("planar").replace(
        {
            "payload": {"mass": 20.0, "inertia": [1.0, 1.0, 1.0]},
            "target.motion": motion,
            "phases": [
                {"name": "move", "steps": 5, "changes": {"payload": None}},
                {"name": "rest", "steps": 5, "changes": {"payload": None, **still}},
                {
                    "name": "hold",
                    "steps": 5,
                    "catch": {"position_error": 0.05, "velocity_error": 0.05},
                    "changes": still,
                },
            ],
            "simulation": {"steps": 15},
        }
    )
    at_tip = poses.to_rotation_and_position(
        compile_scene(scene).tip_pose(StateLayout.of(scene).initial_state)
    )
    scene = scene.replace({"target.pose": dict(zip(("rotation", "position"), at_tip, strict=True))})
    env = dq_space_arm_env.DQSpaceArmEnv(scene)
    env.reset(options={"nominal": True})
    states = [env.state]
    for _ in range(15):
        info = env.step(np.zeros(6))[-1]
        states.append(env.state)
    assert info["caught"]
    assert info["is_success"]
    rows = env.kernels.stage_parameters()
    (planned,) = catches(env.kernels, rows, np.array(states), np.zeros((15, 6)))
    assert planned.is_met
    np.testing.assert_allclose(planned.errors, 0.0, atol=1e-6)


DRAWN = load_scene("planar").replace(
    {
        "target.motion": SLIDING,
        "spread.target_position": 0.5,
        "phases": [
            {"name": "move", "steps": 5},
            {"name": "rest", "steps": 5, "changes": {"target.motion": None}},
        ],
        "simulation": {"steps": 10},
    }
)


@pytest.mark.parametrize("scene", [DRAWN, SCENES["capture-and-detumble"]])
def test_the_scene_of_an_episode_has_its_phases(scene: Scene) -> None:
    """A target that comes to rest rests where it does in the episode, wherever its pose was drawn."""
    env = dq_space_arm_env.DQSpaceArmEnv(scene)
    env.reset(seed=3)
    twin = dq_space_arm_env.DQSpaceArmEnv(env.episode_scene)
    twin.reset(options={"initial_state": env.state})
    rng = np.random.default_rng(0)
    for _ in range(env.scene.simulation.steps):
        action = rng.uniform(-0.1, 0.1, env.kernels.n_u)
        reward, expected = (float(each.step(action)[1]) for each in (twin, env))
        assert reward == pytest.approx(expected, rel=1e-9)


def test_recorded_controls_are_fractions_of_the_limits_of_their_phase() -> None:
    scene = SCENES["release"]
    problem = ArmProblem(scene)
    layout, rows = problem.kernels.layout, problem.parameters.rows[:-1]
    limits = layout.limits_with(rows)
    assert not limits.all(axis=1).all()  # the robot coasts
    actions = np.random.default_rng(8).uniform(-1.0, 1.0, limits.shape)
    acting = rollout(StateFeedback(lambda states, stage: actions[stage, None]), scene, record=True)
    assert acting.controls is not None
    np.testing.assert_array_equal(acting.controls[0], actions * limits)
    back = layout.to_action(acting.controls[0], rows)
    np.testing.assert_allclose(back, np.where(limits > 0.0, actions, 0.0), rtol=0.0, atol=1e-15)
    gains = np.ones((*limits.shape, problem.n_tangent))
    found = layout.to_action_gains(gains, rows)
    assert found.shape == gains.shape
    np.testing.assert_array_equal(found[..., 3], np.divide(1.0, limits, out=0.0 * limits, where=limits > 0.0))


@pytest.mark.parametrize("name", ["capture-and-detumble"])
def test_state_is_kept_and_restored_across_a_catch(name: str) -> None:
    scene = SCENES[name]
    one, other = (gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped for _ in range(2))
    one.reset(seed=3)
    rng, start = np.random.default_rng(1), scene.staged.starts[2] - 3
    actions = rng.uniform(-0.3, 0.3, (scene.simulation.steps, one.action_space.shape[0]))
    for action in actions[:start]:
        one.step(action)
    other.reset(seed=9)
    other.set_state(one.get_state())
    for action in actions[start:]:
        results = [each.step(action) for each in (one, other)]
        assert np.array_equal(results[0][0], results[1][0])
        assert results[0][1:] == results[1][1:]


def caught(kernels: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """State before and after a catch, from rows without and with it."""
    rows, rng = kernels.stage_parameters(), np.random.default_rng(2)
    stage = kernels.scene.staged.starts[2] - 1
    x = kernels.retract(kernels.layout.initial_state, 0.2 * rng.standard_normal(kernels.n_t))
    u = rng.standard_normal(kernels.n_u)
    free = rows[stage].copy()
    free[kernels.parameters.indices("catch")] = 0.0
    return kernels.step(x, u, p=free), kernels.step(x, u, p=rows[stage]), rows[stage], rows[stage + 1], u


def center_of_mass(scene: Scene, x: np.ndarray, given: dict[str, float]) -> np.ndarray:
    tree, total, moment = KinematicTree.from_scene(scene, given), 0.0, np.zeros(3)
    for body, pose in zip(tree.bodies, compile_scene(scene).frame_poses(x), strict=False):
        rotation, position = poses.to_matrix(tuple(pose.tolist()))
        moment += body.mass * (np.array(position) + np.array(rotation) @ np.array(body.center_of_mass))
        total += body.mass
    return np.asarray(moment / total)


def test_a_catch_conserves_the_momentum_of_robot_and_payload() -> None:
    """Linear, and angular about the origin, with the payload where the latch holds it."""
    scene = SCENES["capture-and-detumble"]
    kernels = compile_scene(scene)
    before, after, row, next_row, _ = caught(kernels)
    twist = row[kernels.parameters.indices("catch")][1:]
    payload, (rotation, tip) = scene.payload, poses.to_matrix(tuple(kernels.tip_pose(before).tolist()))
    assert payload is not None
    turn, center = np.array(rotation), np.array(payload.center_of_mass)
    brought = payload.mass * (turn @ (twist[3:] + np.cross(twist[:3], center)))
    spin = turn @ (np.array(payload.inertia) @ twist[:3])
    spin += np.cross(np.array(tip) + turn @ center, brought)
    momenta = kernels.momentum(before, p=row), kernels.momentum(after, p=next_row)
    missing = {name: 0.0 for name in kernels.parameters.names if name.startswith("payload")}
    centers = center_of_mass(scene, before, missing), center_of_mass(scene, after, {})
    linear, angular = (momenta[0][:3] + brought, momenta[0][3:] + np.cross(centers[0], momenta[0][:3]) + spin)
    assert np.abs(momenta[1][:3] - linear).max() < 1e-13 * np.abs(linear).max()
    found = momenta[1][3:] + np.cross(centers[1], momenta[1][:3])
    assert np.abs(found - angular).max() < 1e-13 * np.abs(angular).max()
    assert np.array_equal(before[:11], after[:11])  # pose and angles stay


def test_the_merged_body_has_the_momentum_that_pinocchio_finds() -> None:
    pinocchio = pytest.importorskip("pinocchio")
    scene = SCENES["capture-and-detumble"]
    kernels = compile_scene(scene)
    _, after, _, next_row, _ = caught(kernels)
    loaded = scene.replace({"phases": ()})
    model = pinocchio_model(loaded)
    q, v = to_pinocchio(loaded, after)
    momentum = pinocchio.computeCentroidalMomentum(model, model.createData(), q, v)
    found = kernels.momentum(after, p=next_row)
    expected = np.concatenate([momentum.linear, momentum.angular])
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_a_catch_in_an_episode_is_that_of_a_single_call() -> None:
    scene = SCENES["capture-and-detumble"]
    kernels = compile_scene(scene)
    before, after, row, *_ = caught(kernels)
    loaded = scene.replace({"phases": ()})
    free = compile_scene(loaded.replace({"payload": None}))
    expected = catch_payload(
        free, compile_scene(loaded), before, row[kernels.parameters.indices("catch")][1:]
    )
    assert np.abs(after - expected).max() < 1e-14


def test_a_payload_of_the_plane_moves_within_it() -> None:
    held = load_scene("planar").replace(payload={"mass": 5.0, "inertia": [1.0, 1.0, 1.0]})
    kernels = [compile_scene(scene) for scene in (held.replace(payload=None), held)]
    x = kernels[0].layout.initial_state
    assert np.isfinite(catch_payload(*kernels, x, [0, 0, 0.3, 0.1, 0.2, 0])).all()
    with pytest.raises(ValueError, match=r"payload_twist: .* leaves the plane of scene 'planar'"):
        catch_payload(*kernels, x, [0, 0, 0.3, 0.1, 0.2, 5.0])


def test_derivatives_across_a_catch() -> None:
    """Against central differences, extrapolated to order 6."""
    kernels = compile_scene(SCENES["capture-and-detumble"])
    rows, rng = kernels.stage_parameters(), np.random.default_rng(3)
    p = rows[kernels.scene.staged.starts[2] - 1]
    x = kernels.retract(kernels.layout.initial_state, 0.2 * rng.standard_normal(kernels.n_t))
    u, n_t = rng.standard_normal(kernels.n_u), kernels.n_t
    landed = kernels.step(x, u, p=p)

    def moved(direction: np.ndarray, h: float) -> np.ndarray:
        state = kernels.retract(x, h * direction[:n_t])
        return np.asarray(kernels.difference(landed, kernels.step(state, u + h * direction[n_t:], p=p)))

    def slope(direction: np.ndarray, h: float) -> np.ndarray:
        return (moved(direction, h) - moved(direction, -h)) / (2.0 * h)

    found = np.hstack(kernels.linearize(x, u, p=p))
    for column, direction in enumerate(np.eye(n_t + kernels.n_u)):
        slopes = [slope(direction, h) for h in (4e-3, 2e-3, 1e-3)]
        slopes = [(4.0 * fine - coarse) / 3.0 for coarse, fine in pairwise(slopes)]
        expected = (16.0 * slopes[1] - slopes[0]) / 15.0
        assert np.abs(found[:, column] - expected).max() < 1e-11


def test_a_start_has_the_sign_of_the_first_phases_target() -> None:
    """The pose of the scene itself, half a turn away, is that of the second phase."""
    turned = {"rotation": {"axis": [0, 0, 1], "angle": -120}}
    first = {"name": "first", "steps": 10, "changes": {"target.pose.rotation": turned["rotation"]}}
    scene = load_scene("planar").replace(
        {
            "initial_state.base_pose.rotation": {"axis": [0, 0, 1], "angle": 100},
            "initial_state.joint_angles": [0, 0, 0],
            "target.pose.rotation": [1, 0, 0, 0],
            "simulation.steps": 20,
            "phases": [first, {"name": "second", "steps": 10}],
        }
    )
    env = gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped
    drawn, _ = env.reset(seed=0)
    nominal, _ = env.reset(options={"nominal": True})
    assert drawn[0] >= 0.0
    assert nominal[0] >= 0.0


def test_a_catch_outside_the_tolerances_fails() -> None:
    names = ("attitude_error_deg", "position_error", "angular_velocity_error_deg", "velocity_error")
    changes = {"phases.2.catch.position_error": 0.01, "success": dict.fromkeys(names, 1e4)}
    scene = shortened("capture-and-detumble").replace(changes)
    env = gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped
    env.reset(options={"nominal": True})
    still, start = np.zeros(env.action_space.shape), scene.staged.starts[2]
    for stage in range(scene.simulation.steps):
        before = env.state
        *_, info = env.step(still)
        assert info["caught"] == (stage + 1 < start)
        assert info["shock"] == 0.0
    assert not info["is_success"]
    _, seen = env.reset(options={"state": env.get_state()})
    assert (seen["caught"], seen["is_success"]) == (0.0, False)
    assert env.stage_parameters[env.kernels.parameters.names.index("payload.mass")] == 0.0
    # Nothing is held: the free robot moves on.
    assert (
        np.abs(
            env.kernels.step(before, np.zeros(env.kernels.n_u), p=env.kernels.parameters.nominal) - env.state
        ).max()
        < 1e-14
    )


def test_a_catch_beyond_all_limits_is_a_divergence() -> None:
    light = {"mass": 0.1, "inertia": [1e-4, 1e-4, 1e-4], "center_of_mass": [0.01, 0.0, 0.0]}
    short = {
        f"links.{i}.joint.position": place for i, place in ((1, [0.0, 0.0, 0.02]), (2, [0.02, 0.0, 0.0]))
    }
    changes = {f"links.{i}": light for i in range(3)} | short | {"tip.position": [0.02, 0.0, 0.0]}
    changes |= {f"phases.{i}.steps": steps for i, steps in enumerate((1, 1, 3))}
    changes |= {"phases.2.catch": {**ANYWAY, "position_error": 1e6}, "simulation.steps": 5}
    changes |= {"target.motion.linear_velocity": [3e5, 3e5, 2e5], "payload.center_of_mass": [0.035, 0.0, 0.0]}
    scene = load_scene("capture-and-detumble").replace(changes)
    env: Any = gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    assert not env.step(action)[2]
    before = env.state
    observation, reward, terminated, _, info = env.step(action)
    assert terminated
    assert info["diverged"]
    assert reward < -1e20  # all that is left, with as much energy as a catch can bring
    np.testing.assert_array_equal(env.state, before)
    assert env.observation_space.contains(observation)


def test_the_shock_is_the_change_of_the_payloads_momentum() -> None:
    scene = SCENES["capture-and-detumble"]
    env = gymnasium.make("DQSpaceArm-v0", scene=scene).unwrapped
    env.reset(seed=5)
    start, kernels = scene.staged.starts[2], env.kernels
    rows, rng = kernels.stage_parameters(env.parameters), np.random.default_rng(4)
    for _ in range(start):
        *_, info = env.step(rng.uniform(-0.3, 0.3, kernels.n_u))
    payload, twist = scene.payload, rows[start - 1][kernels.parameters.indices("catch")][1:]
    gained = kernels.tip_twist(env.state, np.zeros(kernels.n_u)) - twist
    center = np.array(payload.center_of_mass)
    linear = payload.mass * (gained[3:] + np.cross(gained[:3], center))
    angular = np.array(payload.inertia) @ gained[:3] + np.cross(center, linear)
    assert info["caught"] == 1.0
    assert info["shock"] == pytest.approx(float(np.linalg.norm(linear)), rel=1e-12)
    assert info["angular_shock"] == pytest.approx(float(np.linalg.norm(angular)), rel=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_the_robot_of_each_phase_is_that_of_a_scene_with_its_numbers(name: str) -> None:
    """Without its payload where nothing is held; velocities stay when it is let go."""
    scene = SCENES[name]
    kernels = compile_scene(scene)
    rows, rng = kernels.stage_parameters(), np.random.default_rng(5)
    x = kernels.retract(kernels.layout.initial_state, 0.2 * rng.standard_normal(kernels.n_t))
    for phase, stage in zip(scene.phases, scene.staged.starts, strict=True):
        own, removed = phase_scene(scene, phase)
        alone = compile_scene(own.replace({"payload": None}) if "payload" in removed else own)
        p = rows[stage].copy()
        p[kernels.parameters.indices("catch")] = 0.0
        u = rng.standard_normal(kernels.n_u)
        assert np.abs(kernels.step(x, u, p=p) - alone.step(x, u)).max() < 1e-14


def test_what_every_phase_changes_is_changed() -> None:
    """One phase with another base is the scene with that base."""
    scene = load_scene("payload")
    changes = {"base.mass": 90.0, "actuators": {"base_force": None}}
    steps = scene.simulation.steps
    kernels = compile_scene(scene.replace(phases=[{"name": "only", "steps": steps, "changes": changes}]))
    alone = compile_scene(scene.replace({"base.mass": 90.0}))
    rows, rng = kernels.stage_parameters(), np.random.default_rng(6)
    x, u = kernels.layout.initial_state, rng.standard_normal(kernels.n_u)
    assert np.abs(kernels.step(x, u, p=rows[3]) - alone.step(x, u)).max() < 1e-14
    assert not kernels.layout.limits_with(rows[3])[kernels.layout.control.base_force].any()


@pytest.mark.parametrize(
    ("name", "actuator", "change"),
    [
        ("wheels", "wheels", {}),
        ("thrusters", "thrusters", {}),
        ("paper", "joint_torque", {"links.0.torque_limit": 1.5}),
    ],
)
def test_an_actuator_out_of_work_gives_nothing(name: str, actuator: str, change: dict[str, Any]) -> None:
    scene = load_scene(name).replace(change) if change else load_scene(name)
    phases = [
        {"name": "off", "steps": 2, "changes": {f"actuators.{actuator}": None}},
        {"name": "on", "steps": scene.simulation.steps - 2},
    ]
    scene = scene.replace(phases=phases)
    layout, rows = StateLayout.of(scene), compile_scene(scene).stage_parameters()
    fields = {"wheels": "wheel_torque", "thrusters": "thruster_force"}
    own = getattr(layout.control, fields.get(actuator, actuator))
    off, on = layout.limits_with(rows[1])[own], layout.limits_with(rows[2])[own]
    assert not off.any()
    np.testing.assert_array_equal(on, layout.control_limit[own])


def test_what_phases_set_is_no_option_of_a_reset() -> None:
    scene = SCENES["release"].replace({"phases.1.changes.target.pose.position": [1.0, 0.0, 2.0]})
    env = dq_space_arm_env.DQSpaceArmEnv(scene)
    with pytest.raises(ValueError, match="target; the phases of scene"):
        env.reset(options={"target": scene.target.pose.dual_quaternion})
    env.reset(seed=1)
    env.reset(options={"parameters": env.parameters})
    env.reset(options={"parameters": env.stage_parameters})
    heavier = env.parameters
    heavier[env.kernels.parameters.names.index("payload.mass")] *= 2.0
    with pytest.raises(ValueError, match=r"payload.mass is 100, should be 50: it is the phases"):
        env.reset(options={"parameters": heavier})


def test_a_payload_that_phases_change_has_no_factor() -> None:
    scene = SCENES["release"]
    assert with_loads(scene, [1.0])[0] is not None
    with pytest.raises(ValueError, match=r"phases that change payload.mass: mass_factors should be 1"):
        with_loads(scene, [1.0, 2.0])


@pytest.mark.parametrize("integrator", ["rk4", "momentum_rk4", "gauss6"])
def test_many_steps_across_a_release_are_single_ones(integrator: str) -> None:
    scene = SCENES["release"].replace(simulation={"integrator": integrator})
    kernels = compile_scene(scene)
    x, rows = kernels.layout.initial_state, kernels.stage_parameters()[:-1]
    u, count = np.full(kernels.n_u, 0.01), len(rows)
    walked = kernels.simulate(x, u, count, p=rows)
    states = [x]
    for row in rows:
        states.append(kernels.step(states[-1], u, p=row))
    np.testing.assert_allclose(walked, states, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(kernels.simulate(x, u, count, every=3, p=rows), walked[::3])


def test_long_steps_have_mean_weights_and_catch_at_their_end() -> None:
    problem = ArmProblem("capture-and-detumble")
    coarse, entries = problem.coarsened(5), problem.kernels.parameters
    rows, long_rows = problem.parameters.rows, coarse.parameters.rows
    weights, catch = entries.indices("cost"), entries.indices("catch")
    start = problem.scene.staged.starts[2] // 5
    assert np.array_equal(long_rows[start - 1, weights], rows[795:800, weights].mean(axis=0))
    assert np.array_equal(long_rows[start - 1, catch], rows[799, catch])
    assert long_rows[:, catch[0]].sum() == 1.0
    np.testing.assert_array_equal(coarse.in_long_steps(rows), long_rows)
    assert not problem.can_coarsen(3)
    with pytest.raises(ValueError, match="phases that change the robot"):
        problem.coarsened(3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"phases.0.steps": 7}, "make them equal"),
        ({"phases.1.changes": {"payload.mass": 3}}, "held as it is, or not at all"),
        ({"phases.1.changes": {"payload": None, "base.mas": 3}}, "leads to no number that phases change"),
        ({"phases.1.changes": {"payload": None, "base.mass": -3}}, "must be a finite number greater than 0"),
        ({"phases.1.changes": {"payload": None, "base.mass": float("nan")}}, "must be a finite number"),
        ({"phases.1.changes": {"payload": None, "base": None}}, "may be null"),
        ({"phases.1.changes": [1]}, "must be a mapping from paths"),
        (
            {"phases.1.changes": {"payload": None, "cost.tippose": 3}},
            "did you mean 'cost.pose'? Such are base.mass",
        ),
        (
            {"phases.1.changes": {"payload": None, "cost.jointtorque": 3}},
            "did you mean 'cost.joint_torque'?",
        ),
        (
            {"cost": {"tip_twist": 0, "terminal_tip_twist": 0}},
            "phases[2].changes.cost.tip_twist = 300: its weight is 0 in the scene",
        ),
        (
            {"phases.1.changes": {"payload": None, "actuators.base_force.limit": 3}},
            "actuators.base_force.limit = 3: is the same in all phases",
        ),
        ({"phases.1.changes": {"payload": None, "simulation.dt": 0.1}}, "is the same in all phases"),
        (
            {"phases.2.catch": None},
            "catch = null: must be given: the phase before holds no payload",
        ),
        ({"phases.1.catch": {}}, "catch = {}: must be absent: this phase holds no payload"),
        (
            {"phases.1.catch": {"position_error": 0.5}, "phases.1.changes": {"cost.pose": 1.0}},
            "phases[2].catch = {attitude_error_deg: 180.0, position_error: 100.0, "
            "angular_velocity_error_deg: null, velocity_error: null}: must be absent: the phase before "
            "already holds the payload",
        ),
        (
            {"phases.0.catch": {}, "phases.0.changes": {"cost.pose": 1.0}},
            "must be absent: the first phase holds the payload from the start",
        ),
        ({"phases.0.changes": {"base.mass": 100.0}}, "no phase after one that holds the payload"),
        ({"phases.2.catch": None, "phases.2.changes": {"payload": None}}, "never hold the payload"),
        ({"phases.2.changes": {"target.motion": None, "cost.tip_twist": 0}}, "adds or removes a term"),
        ({"spread.payload_mass": 0.1}, "it can have no spread"),
        ({"payload": None}, "the scene has no payload"),
        (
            {"phases.1.changes": {"payload": None, "actuators.wheels": None}},
            "phases[1].changes.actuators.wheels = null: the scene has no actuators.wheels",
        ),
        ({"phases.0.changes": {"payload": None, "target.motion": None}}, "keep target.motion null"),
        (
            {f"phases.{i}.changes": {"payload": None, "target.motion": None} for i in range(2)},
            "stops the target before it moves: remove target.motion",
        ),
        (
            {"phases.0.changes": {"payload": None, "target.pose.position": [1, 2, 3]}},
            "needs target.motion: null",
        ),
        ({"phases.1.changes": {"payload": None, "links": [{"mass": 3}]}}, "links must be numbers or null"),
        (
            {"phases.1.changes": {"payload": None, "simulation.dt": {}}},
            "simulation.dt must be numbers or null",
        ),
        (
            {"phases.1.changes": {"payload": None, "base.mass": 50, "base": {"mass": 60}}},
            "gives base.mass twice",
        ),
    ],
)
def test_mistakes_are_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match="phases") as error:
        SCENES["capture-and-detumble"].replace(changes)
    assert words in str(error.value)


def test_a_phase_takes_no_friction_away() -> None:
    scene = load_scene("motors")
    steps = scene.simulation.steps // 2
    changes = {"links.0.motor.friction": 0.0}
    phases = [{"name": "a", "steps": steps}, {"name": "b", "steps": steps, "changes": changes}]
    with pytest.raises(SceneError, match=r"adds or removes links\.0\.motor\.friction: give it a number"):
        scene.replace(phases=phases)


def test_scenes_with_phases_survive_their_yaml() -> None:
    for scene in SCENES.values():
        again = load_scene(scene.model_dump())
        assert again == scene
        assert again.content_hash() == scene.content_hash()


def test_phases_take_numbers_of_numpy() -> None:
    changes = {"base.mass": np.float64(97.0), "base.inertia": np.array([9.7, 9.7, 8.64])}
    scene = SCENES["refuelling"].replace({"phases.2.changes": changes})
    assert scene.phases[2].changes == (("base.inertia", (9.7, 9.7, 8.64)), ("base.mass", 97.0))
    assert "base.mass: 97.0" in scene.to_yaml()


def test_an_entry_of_an_inertia_may_change() -> None:
    changed = SCENES["release"].replace({"phases.1.changes.base.inertia.0.0": 11.0})
    assert changed.staged.values["base.inertia.xx"][1] == 11.0


def momentum(equations, state):
    """Linear momentum of the robot with what it holds, base axes."""
    motion, tree = equations.field.motion(equations.y(state)), equations.tree
    tree = tree.with_propellant(motion.propellant)
    frames = minimal.link_frames(tree, motion.joint_angles)
    base = (*motion.angular, *motion.linear)
    velocities = kinematics.body_velocities(tree, frames, base, motion.joint_rates)
    return np.array(kinematics.momentum(tree, frames, velocities, ())[0], dtype=float)


def test_a_catch_takes_the_payload_as_parameters_have_it():
    """Its center of mass off the plane of the scene's, which no phase changes: the momentum stays."""
    scene = load_scene("capture-and-detumble").replace(parameters=["payload.center_of_mass"])
    names = [number.name for number in parameters(scene)]
    given = dict(zip(names, (number.nominal for number in parameters(scene)), strict=True))
    given["payload.center_of_mass.y"] = 0.4
    free = SceneEquations.of(scene, [given[name] for name in names])
    held = given | {name: values[-1] for name, values in scene.staged.values.items()}
    loaded = SceneEquations.of(scene, [held[name] for name in names])
    x, twist = free.layout.initial_state.tolist(), [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]

    rotation, _ = poses.to_matrix(poses.error_pose(free.base_pose(x), free.tip(x)))
    center = [held[f"payload.center_of_mass.{axis}"] for axis in "xyz"]
    brought = held["payload.mass"] * (np.array(twist[3:]) + np.cross(twist[:3], center))
    before = momentum(free, x) + np.array(rotation, dtype=float) @ brought
    after = momentum(loaded, Catching(free)(x, twist))
    np.testing.assert_allclose(after, before, rtol=1e-12)


def test_a_catch_moves_what_is_left_in_the_tank_too():
    jet = {"position": [-0.5, 0, 0], "direction": [1, 0, 0], "force": 5.0, "specific_impulse": 220.0}
    actuators = {"base_force": None, "thrusters": [jet], "tank": {"propellant": 30.0}}
    loaded = load_scene("payload").replace(actuators=actuators)
    scenes = loaded.replace(payload=None), loaded
    layouts = [StateLayout.of(scene) for scene in scenes]
    kernels: Any = [
        SimpleNamespace(scene=scene, n_x=layout.n_x, layout=layout)
        for scene, layout in zip(scenes, layouts, strict=True)
    ]
    x = layouts[0].initial_state.copy()
    x[layouts[0].state.base_velocity] = [0.0, 0.1, 0.0, 1.0, 0.0, 0.0]
    after = catch_payload(*kernels, x, np.zeros(6))
    free, held = (SceneEquations.of(scene, []) for scene in scenes)
    np.testing.assert_allclose(momentum(held, after.tolist()), momentum(free, x.tolist()), atol=1e-11)


@pytest.mark.parametrize("path", ["phase", "catch", "catch.now"])
def test_what_the_stage_says_is_no_parameter(path: str) -> None:
    with pytest.raises(SceneError, match=rf"parameters\[0\] = '{path}': leads to no number that may vary"):
        load_scene("capture-and-detumble").replace(parameters=[path])
