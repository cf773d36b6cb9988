"""`DQSpaceArm-v0`: Gymnasium's conventions, the paper's cost as reward, starts, ends, and bad input."""

import copy
import pickle
import subprocess
import sys
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from short_scenes import diverging, short

import dq_space_arm_env
from dq_space_arm_env import list_scenes, load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.scene import Actuators
from dq_space_arm_env.scene.constraint_rows import path_rows
from dq_space_arm_env.validation.fields import MOST_STEPS

TARGET = np.array([0.5, 0.5, -0.5, -0.5, 0.25, 2.25, 0.25, 2.25])


def make(scene="paper", **arguments):
    return gymnasium.make("DQSpaceArm-v0", scene=scene, **arguments)


def test_the_environment_and_its_pictures_load_nothing_heavy():
    env = make(render_mode="rgb_array")  # compiled, with CasADi, for the first use
    env.reset(seed=0)
    env.render()
    code = """
import os, sys, gymnasium, dq_space_arm_env
before = dict(os.environ)
env = gymnasium.make("DQSpaceArm-v0", render_mode="rgb_array")
env.reset(seed=0)
env.step(env.action_space.sample())
env.render()
assert dict(os.environ) == before
heavy = {"torch", "stable_baselines3", "matplotlib", "numba", "casadi", "pygame", "rich"}
assert not heavy & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.sampled(scenes="all")
@pytest.mark.parametrize("scene", list_scenes())
def test_check_env_has_no_complaint(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(scene).unwrapped, skip_render_check=True)


@pytest.mark.render
def test_check_env_has_no_complaint_about_pictures(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # "human" opens a window, which needs a display
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(render_mode="rgb_array").unwrapped)


@pytest.mark.sampled
@pytest.mark.parametrize("scene", list_scenes())
def test_a_thousand_random_steps(scene):
    env = make(scene)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(1000):
        assert env.observation_space.contains(observation)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert np.isfinite(reward)
        assert reward <= 0.0
        assert not truncated
        assert not info["diverged"]
        if terminated:
            observation, _ = env.reset()


def test_reward_is_the_papers_formula_step_by_step():
    env = make(short())
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    limit = np.array([10.0] * 3 + [5.0] * 3 + [2.0] * 3 + [0.5] * 3)
    effort = np.array([10.0] * 3 + [1.0] * 3 + [0.01] * 3 + [0.1] * 3)
    kernels = env.unwrapped.kernels
    terminated = False
    while not terminated:
        x, action = env.unwrapped.state, rng.uniform(-1, 1, 12)
        error, twist, u = kernels.tip_pose(x) - TARGET, x[14:20], limit * action
        terms = [15.0 * error @ error, twist @ twist, effort @ (u * u)]
        _, reward, terminated, _, info = env.step(action)
        expected = -sum(terms)
        if terminated:
            x = env.unwrapped.state
            error, twist = kernels.tip_pose(x) - TARGET, x[14:20]
            ends = [150.0 * error @ error, twist @ twist]
            expected -= sum(ends)
            assert [info["terminal_cost_pose"], info["terminal_cost_base_velocity"]] == pytest.approx(ends)
        else:
            assert info["terminal_cost_pose"] == info["terminal_cost_base_velocity"] == 0.0
        assert reward == pytest.approx(expected, rel=1e-12)
        charged = [info["cost_pose"], info["cost_base_velocity"], info["cost_control"]]
        assert charged == pytest.approx(terms, rel=1e-12)


@pytest.mark.sampled
@pytest.mark.parametrize("scene", list_scenes())
def test_observation_is_what_the_documentation_says(scene):
    env = make(short(scene, steps=20))
    env.reset(seed=2)
    observation, *_, info = env.step(env.action_space.sample())
    kernels, x = env.unwrapped.kernels, env.unwrapped.state
    layout, target = kernels.layout.state, tuple(env.unwrapped.target)
    if env.unwrapped.scene.target.motion is None:
        own = env.unwrapped.episode_scene.target
        desired = dual_quaternion.multiply(own.pose.dual_quaternion, own.grasp.dual_quaternion)
        assert target == pytest.approx(desired, abs=1e-15)
    error = np.array(poses.error_pose(tuple(kernels.tip_pose(x)), target))  # (31)
    if kernels.layout.planar:
        np.testing.assert_allclose(error[[1, 2, 4, 7]], 0.0, rtol=0, atol=1e-15)
        error = error[[0, 3, 5, 6]]
    parts = (layout.base_velocity, layout.joint_angles, layout.wrist_angles, layout.joint_rates)
    parts += (layout.motor_angles, layout.motor_rates, layout.wheel_momenta)
    parts += (layout.actuators, layout.drives)
    twists = []
    if env.unwrapped.scene.target.motion is not None:
        relative = kernels.relative_twist(x, p=env.unwrapped.stage_parameters)
        twists = [relative, kernels.tip_twist(x) - relative]
        assert info["angular_velocity_error"] == pytest.approx(np.degrees(np.linalg.norm(relative[:3])))
        assert info["velocity_error"] == pytest.approx(np.linalg.norm(relative[3:]))
    phase = [info["phase"]] if env.unwrapped.scene.phases else []
    rows = [row for row in path_rows(env.unwrapped.scene) if row.observed is not None]
    margins = [np.tanh(-info["constraints"][row.name] / row.observed) for row in rows]
    tips, goals = [tuple(kernels.tip_pose(x))], [target]
    body = tuple(kernels.layout.target_body_with(np.array(env.unwrapped.stage_parameters)).tolist())
    others = kernels.frame_poses(x)[1 + len(env.unwrapped.scene.links) :]
    for tip, pose in zip(env.unwrapped.scene.other_tips, others, strict=False):
        tips.append(tuple(pose.tolist()))
        goals.append(dual_quaternion.multiply(body, tip.goal.dual_quaternion))
    errors = [np.array(poses.error_pose(*pair)) for pair in zip(tips, goals, strict=True)]
    seen = [np.copysign(1.0, error[0]) * error for error in errors[1:]]
    state = [x[part] for part in parts]
    expected = np.concatenate([error, *state, phase, *seen, margins, *twists, [19 * 0.015]])
    np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-14)
    angles = [poses.error_angle(*pair) for pair in zip(tips, goals, strict=True)]
    distances = [poses.error_distance(*pair) for pair in zip(tips, goals, strict=True)]
    assert info["attitude_error"] == pytest.approx(np.degrees(max(angles)))
    assert info["position_error"] == pytest.approx(max(distances))


def test_the_sign_of_the_error_is_fixed_at_reset_and_carried_along():
    env = make(short())
    x = env.unwrapped.kernels.layout.initial_state.copy()
    observation, _ = env.reset(options={"initial_state": x})
    flipped = x.copy()
    flipped[:8] *= -1
    again, _ = env.reset(options={"initial_state": flipped})
    np.testing.assert_array_equal(observation, again)
    assert observation[0] >= 0.0


def test_starts():
    env = make()
    nominal = env.unwrapped.kernels.layout.initial_state
    first, _ = env.reset(options={"nominal": True})
    np.testing.assert_array_equal(env.unwrapped.state, nominal)
    second, _ = env.reset(seed=0, options={"nominal": True})
    np.testing.assert_array_equal(first, second)
    env.reset(seed=0)
    drawn = env.unwrapped.state
    assert not np.array_equal(drawn, nominal)
    env.reset(options={"initial_state": drawn})
    np.testing.assert_allclose(env.unwrapped.state, drawn, rtol=0, atol=1e-15)
    env.reset(seed=1)
    assert not np.array_equal(env.unwrapped.state, drawn)
    assert env.reset(options={"nominal": True})[1].keys() == env.step(env.action_space.sample())[4].keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:-1], r"shape \(22,\), should be finite numbers of shape \(23,\)"),
        (lambda x: np.where(np.arange(23) == 9, np.nan, x), "should be finite"),
        (lambda x: np.where(np.arange(23) == 0, 1.1, x), r"\|q_r\| = 1\.1.*unit dual quaternion has 1 and 0"),
        (lambda x: np.where(np.arange(23) == 4, 0.1, x), r"q_r \. q_d = 0\.1"),
    ],
)
def test_bad_options_are_refused(change, message):
    env = make()
    x = env.unwrapped.kernels.layout.initial_state
    with pytest.raises(ValueError, match=message):
        env.reset(options={"initial_state": change(x)})
    with pytest.raises(ValueError, match="exclude each other"):
        env.reset(options={"nominal": True, "initial_state": x})


@pytest.mark.parametrize("make_one", [make, partial(gymnasium.make_vec, "DQSpaceArm-v0", num_envs=2)])
def test_options_are_a_mapping_and_nominal_a_bool(make_one):
    env = make_one(scene=short("planar"))
    for bad in (["nominal"], "nominal", 3):
        with pytest.raises(ValueError, match=r"options: .*, should be a mapping from names"):
            env.reset(options=bad)
    with pytest.raises(ValueError, match=r"options: \[1, 'a'\] unknown; choose from"):
        env.reset(options={"a": 3, 1: 2})
    with pytest.raises(ValueError, match="state holds the whole episode, it excludes 1, nominal"):
        env.reset(options={"state": {}, 1: 2, "nominal": True})
    for bad in ("no", 1, [True]):
        with pytest.raises(ValueError, match=r"options: nominal .*, should be True or False"):
            env.reset(options={"nominal": bad})
    env.reset(options={"nominal": np.True_, "target": None})


def test_actuators_and_tank_start_with_what_they_can_have():
    actuators = {
        "base_force": {"limit": 1.0, "time_constant": 0.3, "delay": 1},
        "base_torque": {"limit": 0.1, "slew_limit": 1.0},
        "thrusters": [
            {"position": [-0.5, 0, 0], "direction": [1, 0, 0], "force": 2, "specific_impulse": 200}
        ],
        "tank": {"propellant": 5.0},
    }
    env = make(short("planar").replace(actuators=actuators)).unwrapped
    layout = env.kernels.layout
    for name, bad, allowed in (
        ("previous base torque z", 1e4, "from -0.1 to 0.1"),
        ("base force x commanded 1 before", -1.1, "from -1 to 1"),
        ("base force y output", 2.0, "from -1 to 1"),
        ("propellant mass", -9.0, "at least 0"),
    ):
        index = layout.state.names.index(name)
        x = np.where(np.arange(env.kernels.n_x) == index, bad, layout.initial_state)
        message = rf"initial_state has {name} = {bad:g} \(entry {index}\), should be {allowed}"
        with pytest.raises(ValueError, match=message):
            env.reset(options={"initial_state": x})
    env.reset(options={"initial_state": layout.initial_state})
    for _ in range(5):
        env.step(np.ones(layout.n_u))
    env.reset(options={"initial_state": env.state})


def test_goals_of_phases_and_of_other_tips_are_within_observations():
    far = {"position": [5e6, 0, 0]}
    phases = [{"name": "a", "steps": 6}, {"name": "b", "steps": 6, "changes": {"target.pose": far}}]
    with pytest.raises(ValueError, match=r"phases\[1\]\.changes\.target\.pose\.position: 5e\+06 m"):
        make(short("planar").replace(phases=phases))
    tips = [tip.model_dump() | {"goal": far} for tip in load_scene("dual-arm").other_tips]
    with pytest.raises(ValueError, match=r"other_tips\[0\]\.goal\.position: 5e\+06 m"):
        make(short("dual-arm").replace(other_tips=tips))


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_an_action_of_nan_moves_nothing(precision):
    env = make("tracking").unwrapped  # whose target moves
    env.reset(seed=0)
    for _ in range(2):
        before = env.get_state()
        with pytest.raises(ValueError, match="holds NaN"):
            env.step(np.full(12, np.nan, precision))
        after = env.get_state()
        for name, array in before.items():
            np.testing.assert_array_equal(after[name], array)
        env.step(np.zeros(12, precision))


def test_bad_actions_are_refused_and_large_ones_clipped():
    env = make().unwrapped
    env.reset(seed=0)
    before = env.state
    for index in range(12):
        with pytest.raises(ValueError, match="holds NaN"):
            env.step(np.where(np.arange(12) == index, np.nan, 0.0))
    np.testing.assert_array_equal(env.state, before)
    with pytest.raises(ValueError, match=r"shape \(11,\), should be \(12,\)"):
        env.step(np.zeros(11))
    results = []
    for value in (1.0, 50.0, np.inf, 0.1, np.float32(0.1)):
        env.reset(seed=0)
        results.append(env.step(np.full(12, value))[0])
    np.testing.assert_array_equal(results[1:3], results[:1] * 2)
    assert not np.array_equal(results[3], results[4])  # float64 is used at full precision


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_the_longest_episode_is_counted_to_its_end(precision):
    """Single precision counts to 2^24, and no episode is that long."""
    scene = short(steps=MOST_STEPS).replace(simulation={"precision": precision})
    env = make(scene).unwrapped
    env.reset(seed=0)
    state = env.get_state()
    state["memory"][0] = MOST_STEPS - 3
    env.set_state(state)
    assert [env.step(np.zeros(12))[2] for _ in range(3)] == [False, False, True]
    assert MOST_STEPS < 2**24


def test_order_of_calls_is_enforced():
    env = make(short(steps=1)).unwrapped
    for call in (lambda: env.step(np.zeros(12)), lambda: env.state):
        with pytest.raises(ResetNeeded):
            call()
    env.reset(seed=0)
    *_, terminated, truncated, _ = env.step(np.zeros(12))
    assert (terminated, truncated) == (True, False)
    with pytest.raises(ResetNeeded, match="the episode is over"):
        env.step(np.zeros(12))


def test_a_diverged_state_ends_the_episode_and_says_so():
    env = make(diverging(steps=500))
    _, info = env.reset(seed=0)
    assert not info["diverged"]
    total, steps, terminated = 0.0, 0, False
    while not terminated:
        observation, reward, terminated, _, info = env.step(np.zeros(12))
        total, steps = total + reward, steps + 1
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
    assert info["diverged"]
    assert not info["is_success"]
    assert steps < 500
    # Ending early does not pay: the rest is charged, and not at the last sound state's cost only.
    assert reward < -(500 - steps) * info["cost_pose"]


def test_returned_arrays_are_the_callers():
    env = make()
    observation, _ = env.reset(seed=0)
    kept = observation.copy()
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(observation, kept)
    state = env.unwrapped.state
    state[:] = np.nan
    assert np.isfinite(env.unwrapped.state).all()


def test_environments_pickle_and_copy():
    env = make("planar")
    env.reset(seed=0)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        np.testing.assert_array_equal(twin.reset(seed=1)[0], env.reset(seed=1)[0])


def test_scenes_that_have_no_normalized_actions_are_refused():
    scene = load_scene("paper")
    unlimited = scene.actuators.model_dump() | {"base_force": {"limit": float("inf")}}
    with pytest.raises(ValueError, match=r"base force x, .* base force z have no finite limit"):
        make(scene.replace(actuators=unlimited))
    with pytest.raises(ValueError, match=r": link \S+ torque has no finite limit"):
        make(load_scene("planar").replace({"links.0.torque_limit": float("inf")}))
    with pytest.raises(ValueError, match="it has no actuator"):
        make(scene.replace(actuators=Actuators()))
    with pytest.raises(ValueError, match="render_mode: 'ansi' is unknown"):
        dq_space_arm_env.DQSpaceArmEnv(render_mode="ansi")


@pytest.mark.parametrize("kind", ["name", "path", "mapping", "scene"])
@pytest.mark.parametrize("name", ["DQSpaceArm-v0", "DQSpaceArmGoal-v0"])
def test_environments_are_made_again_from_their_specification_as_json(name, kind, tmp_path):
    scene = load_scene("planar").replace(simulation={"steps": 7})
    file = tmp_path / "short.yaml"
    file.write_text(scene.to_yaml(), encoding="utf-8")
    given = {"name": "planar", "path": file, "mapping": scene.model_dump(mode="json"), "scene": scene}[kind]
    env = gymnasium.make(name, scene=given)
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.scene == env.unwrapped.scene
    assert gymnasium.make_vec("DQSpaceArm-v0", 2, scene=given).spec.to_json()


def test_modes_cameras_and_numpys_numbers_are_in_the_specification_as_json():
    mode, camera = AutoresetMode.SAME_STEP, {"lookat": np.arange(3.0), "azimuth": np.float64(3.0)}
    pictures = {"width": np.int64(64), "default_camera_config": camera}
    venv = gymnasium.make_vec("DQSpaceArm-v0", 2, scene="planar", autoreset_mode=mode, **pictures)
    again = gymnasium.make_vec(EnvSpec.from_json(venv.spec.to_json()))
    assert (again.autoreset_mode, again._picture) == (mode, venv._picture)
