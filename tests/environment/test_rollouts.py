"""Rollouts: equal to episodes of single environments, their records, and disturbances."""

import numpy as np
import pytest
from short_scenes import short

from dq_space_arm_env import DQSpaceArmEnv, compile_scene
from dq_space_arm_env.environment.disturbances import Disturbances, with_loads
from dq_space_arm_env.environment.rollouts import StateFeedback, rollout
from dq_space_arm_env.scene import InitialState, Spread, StateLayout
from dq_space_arm_env.task.trajectory import Trajectory


@pytest.fixture(scope="module")
def scene():
    return short("planar", 25)


def wave(observations):
    """A policy that depends on each observation alone."""
    return np.sin(3.0 * observations[:, :6])


def test_rollout_is_the_same_episodes_as_in_single_environments(scene):
    flown = rollout(wave, scene, [5, 7], record=True)
    assert (len(flown), flown.seeds) == (2, (5, 7))
    for i, seed in enumerate(flown.seeds):
        env = DQSpaceArmEnv(scene)
        observation, info = env.reset(seed=seed)
        assert flown.initial_errors[i].tolist() == [info["attitude_error"], info["position_error"]]
        rewards, effort = [], 0.0
        for step in range(25):
            np.testing.assert_array_equal(flown.observations[i, step], observation)
            action = wave(observation[None])[0]
            np.testing.assert_array_equal(flown.controls[i, step], env.kernels.layout.to_control(action))
            observation, reward, _, _, info = env.step(action)
            rewards.append(reward)
            effort += info["cost_control"]
        np.testing.assert_array_equal(flown.states[i, -1], env.state)
        np.testing.assert_array_equal(flown.observations[i, -1], observation)
        np.testing.assert_array_equal(flown.rewards[i], rewards)
        assert flown.cost_terms["cost_control"][i] == pytest.approx(effort, rel=1e-12)
        assert flown.attitude_error[i] == info["attitude_error"]
        assert flown.is_success[i] == info["is_success"]
        assert flown.cost[i] == pytest.approx(-sum(rewards), rel=1e-12)


def test_state_feedback_sees_states_and_steps_and_begins_with_the_environment(scene):
    seen, begun = [], []

    def act(states, step):
        seen.append((step, states.copy()))
        return np.zeros((len(states), 6))

    start = compile_scene(scene).layout.initial_state
    flown = rollout(StateFeedback(act, begun.append), scene, starts=[start, start], record=True, steps=4)
    assert [step for step, _ in seen] == [0, 1, 2, 3]
    np.testing.assert_array_equal(np.stack([states for _, states in seen], axis=1), flown.states[:, :4])
    assert begun[0].num_envs == 2
    resting = rollout(lambda observations: np.zeros((1, 6)), scene, steps=4, record=True)
    np.testing.assert_array_equal(flown.states[0], resting.states[0])


def test_nan_makes_a_policy_fail_and_the_others_go_on(scene):
    def partly_broken(observations):
        actions = wave(observations)
        actions[1] = np.nan
        return actions

    flown, sound = rollout(partly_broken, scene, [1, 2]), rollout(wave, scene, [1])
    assert flown.policy_failed.tolist() == [False, True]
    assert flown.cost[0] == sound.cost[0]
    assert flown.cost_terms["cost_control"][1] == 0.0
    with pytest.raises(ValueError, match=r"shape \(6,\); 2 episodes of scene 'planar' want \(2, 6\)"):
        rollout(lambda observations: np.zeros(6), scene, [1, 2])


def test_what_a_policy_does_to_its_observations_is_its_own_affair(scene):
    def in_place(seen, step=0):
        seen[:] = 0.0
        return np.zeros((1, 6))

    resting = rollout(lambda observations: np.zeros((1, 6)), scene, steps=4, record=True)
    for policy in (in_place, StateFeedback(in_place)):
        flown = rollout(policy, scene, steps=4, record=True)
        np.testing.assert_array_equal(flown.states, resting.states)
        np.testing.assert_array_equal(flown.observations, resting.observations)


def test_diverged_episode_ends_early_and_is_charged_like_in_the_environment(scene):
    layout = compile_scene(scene).layout
    fast, calm = layout.initial_state.copy(), layout.initial_state
    fast[layout.state.joint_rates] = 1e5
    flown = rollout(lambda seen: np.ones((len(seen), 6)), scene, starts=[fast, calm], record=True)
    assert flown.diverged.tolist() == [True, False]
    assert flown.length[0] < flown.length[1] == 25
    assert not flown.rewards[0, flown.length[0] :].any()
    trajectory = flown.trajectory(0, "fast")
    assert (len(trajectory.states), len(trajectory.controls)) == (flown.length[0] + 1, flown.length[0])
    assert trajectory.diverged
    env = DQSpaceArmEnv(scene)
    env.reset(options={"initial_state": fast})
    total, over = 0.0, False
    while not over:
        _, reward, over, _, _ = env.step(np.ones(6))
        total += reward
    assert trajectory.cost == pytest.approx(-total, rel=1e-12)


def test_trajectory_comes_back_from_its_file(scene, tmp_path):
    noisy = Disturbances(scene, np.random.default_rng(0), inputs=0.1)
    flown = rollout(wave, scene, [3], disturbances=noisy, record=True).trajectory(label="wave", start="drawn")
    flown.save(tmp_path / "flight.npz")
    back = Trajectory.load(tmp_path / "flight.npz")
    for name in ("states", "controls", "noise", "rewards", "target"):
        np.testing.assert_array_equal(getattr(back, name), getattr(flown, name))
    assert back.scene == scene
    assert (back.facts(), back.label) == (flown.facts(), "wave")
    assert Trajectory.load(tmp_path / "flight.npz", "other").label == "other"
    assert (back.cost, back.seed) == (flown.cost, 3)
    # What the actuators got moved the arm.
    kernels, u = compile_scene(scene), back.controls + back.noise
    np.testing.assert_allclose(kernels.step(back.states[:-1], u), back.states[1:], rtol=0, atol=1e-12)


def test_pushes_change_velocities_and_noise_only_what_is_measured(scene):
    kernels = compile_scene(scene)
    measured = []

    def act(states, step):
        measured.append(states.copy())
        return np.zeros((1, 6))

    rng = np.random.default_rng(1)
    disturbances = Disturbances(scene, rng, push=0.1, pushes=4, evenly=True, measurement=1e-3)
    flown = rollout(StateFeedback(act), scene, disturbances=disturbances, record=True)
    noise = np.array(measured)[:, 0] - flown.states[0, :-1]
    assert 1e-4 < np.abs(noise).mean() < 1e-2
    time_left = scene.simulation.dt * np.arange(25, 0, -1.0)[:, None]
    seen = kernels.observation(np.array(measured)[:, 0], time_left)[0]
    np.testing.assert_allclose(flown.observations[0, :-1], seen, rtol=0, atol=1e-12)
    free = kernels.step(flown.states[0, :-1], np.zeros((25, 6)))
    jumps = flown.states[0, 1:] - free
    struck = np.flatnonzero(np.abs(jumps).max(axis=1) > 1e-9)
    assert struck.tolist() == [3, 8, 13, 18]  # a push comes before the step whose state it changes
    others = np.delete(jumps, np.r_[kernels.layout.state.base_velocity], axis=1)
    np.testing.assert_allclose(others, 0.0, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_masses_differ_from_the_scene(scene):
    start = np.tile(compile_scene(scene).layout.initial_state, (3, 1))
    factors = [1.3, 1.0, 1.3]
    flown_in, parameters = with_loads(scene, factors)
    flown = rollout(wave, flown_in, starts=start, parameters=parameters)
    np.testing.assert_array_equal(flown.parameters, parameters)
    last = len(scene.links) - 1
    heavy = scene.replace(
        {
            f"links.{last}.mass": 1.3 * scene.links[last].mass,
            f"links.{last}.inertia": (1.3 * np.array(scene.links[last].inertia)).tolist(),
        }
    )
    alone = [rollout(wave, world, starts=start[:1]).cost[0] for world in (heavy, scene)]
    assert alone[0] != pytest.approx(alone[1], rel=1e-6)
    # Constants are rounded otherwise than inputs.
    np.testing.assert_allclose(flown.cost, [alone[0], alone[1], alone[0]], rtol=1e-12)


def test_other_masses_leave_what_else_varies():
    """A payload's factor multiplies the mass that was drawn; the target stays the drawn one."""
    scene = short("payload", 5).replace(spread={"target_position": 0.1, "payload_mass": 0.2})
    drawn = rollout(lambda seen: np.zeros((len(seen), 9)), scene, [3, 4]).parameters
    flown_in, parameters = with_loads(scene, [0.5, 1.0], drawn)
    known, varying = (StateLayout.of(each).parameters for each in (scene, flown_in))
    mass, inertia = varying.indices("payload.mass"), varying.indices("payload.inertia")
    rest = varying.indices("target.pose")
    np.testing.assert_array_equal(parameters[:, rest], drawn[:, known.indices("target.pose")])
    np.testing.assert_array_equal(parameters[:, mass], drawn[:, known.indices("payload.mass")] * [[0.5], [1]])
    np.testing.assert_array_equal(parameters[0, inertia], 0.5 * varying.nominal[inertia])
    assert sorted([*rest, *mass, *inertia]) == list(range(len(varying.names)))


def test_a_base_alone_has_no_mass_to_change(scene):
    bare = scene.replace(
        links=[], actuators={"joint_torque": None}, initial_state=InitialState(), spread=Spread()
    )
    with pytest.raises(ValueError, match="has neither payload nor links"):
        with_loads(bare, [1.0, 1.3])
    assert with_loads(bare, [1.0])[0] == bare


def test_an_inertia_that_phases_change_is_not_multiplied(scene):
    changes = {"links.2.inertia": [0.02, 0.9, 0.9]}
    phases = [{"name": "stowed", "steps": 10}, {"name": "unfolded", "steps": 15, "changes": changes}]
    with pytest.raises(ValueError, match=r"has phases that change links.2.inertia.zz: mass_factors should"):
        with_loads(scene.replace(phases=phases), [2.0])


def test_disturbances_are_those_of_all_episodes(scene):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="those of 1 episodes, should be of 3: make them with count=3"):
        rollout(wave, scene, [0, 1, 2], disturbances=Disturbances(scene, rng, inputs=0.1))
    noisy = Disturbances(scene, rng, inputs=0.1, count=3)
    flown = rollout(wave, scene, [0, 1, 2], disturbances=noisy, record=True, steps=2)
    assert not np.array_equal(flown.noise[0], flown.noise[1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"push": -0.1}, "push: -0.1, should be finite and at least 0"),
        ({"measurement": [0.0, np.nan]}, "measurement: nan, should be finite and at least 0"),
        ({"inputs": [0.1, 0.2], "count": 3}, r"inputs: shape \(2, 1\), should be one row for all of the 3"),
        ({"inputs": np.ones((2, 4)), "count": 2}, r"inputs: shape \(2, 4\), .*in each row one number or"),
        ({"push": np.zeros((1, 1, 1))}, "should have at most two axes"),
        ({"push": 0.1, "pushes": -1}, "pushes: -1, should be a finite number of at least 0"),
    ],
)
def test_disturbances_refuse_what_is_no_standard_deviation(scene, settings, message):
    with pytest.raises(ValueError, match=message):
        Disturbances(scene, np.random.default_rng(0), **settings)


@pytest.mark.parametrize("steps", [0, -1, 2.5, True])
def test_a_rollout_takes_a_step_at_least(scene, steps):
    with pytest.raises(ValueError, match=f"steps: {steps}, should be a whole number of at least 1"):
        rollout(wave, scene, [0], steps=steps)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seeds": []}, "seeds: none, should be one for each episode"),
        ({"seeds": [1.5]}, r"seeds: \[1.5\], should be whole numbers"),
        ({"starts": np.zeros(14)}, r"starts: shape \(14,\), should be \(B, n_x\)"),
        ({"starts": np.zeros((0, 14))}, "starts: none, should be one for each episode"),
        ({"delay": 1.5}, "delay: 1.5, should be at least 0 steps, a whole number"),
    ],
)
def test_episodes_are_counted_by_seeds_or_rows_of_starts(scene, given, message):
    with pytest.raises(ValueError, match=message):
        rollout(wave, scene, **given)


@pytest.mark.parametrize("actions", [np.ma.masked_array(np.ones((1, 6)), mask=True), [[None] * 6]])
def test_actions_of_policies_are_real_numbers(scene, actions):
    with pytest.raises(TypeError, match=r"actions of the policy: .*, should be real numbers"):
        rollout(lambda seen: actions, scene, [0])


def test_equal_generators_draw_equal_disturbances(scene):
    one, other = (
        Disturbances(scene, np.random.default_rng(3), push=[0.1, 0.2], pushes=6, measurement=[0.0, 0.1])
        for _ in range(2)
    )
    for _ in range(3):
        for mine, theirs in zip(one.draw()[:2], other.draw()[:2], strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_every_episode_has_its_pushes_at_even_intervals():
    scene = short("planar", 50)
    disturbances = Disturbances(scene, np.random.default_rng(0), push=0.1, pushes=2, evenly=True)
    struck = [disturbances.draw().push is not None for _ in range(3 * 50)]
    assert np.array(struck).reshape(3, 50).sum(axis=1).tolist() == [2, 2, 2]
