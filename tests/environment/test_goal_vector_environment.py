"""The native vector environment of goals: bit for bit the single one, in every autoreset mode."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from short_scenes import diverging, short
from test_vector_environment import MODES, assert_same

from dq_space_arm_env import DQSpaceArmGoalEnv, DQSpaceArmGoalVectorEnv, list_scenes

DRAWN = short("random-target", 5)
DIVERGING = diverging("random-target", 1e4, 20)


def twins(scene, copies, mode, reward_type="sparse"):
    arguments = {"scene": scene, "reward_type": reward_type}
    native = gymnasium.make_vec("DQSpaceArmGoal-v0", copies, autoreset_mode=mode, **arguments)
    assert isinstance(native.unwrapped, DQSpaceArmGoalVectorEnv)
    single = [lambda: gymnasium.make("DQSpaceArmGoal-v0", **arguments)] * copies
    return native, SyncVectorEnv(single, autoreset_mode=mode)


OTHERS = [
    pytest.param(
        short(name, 5),
        "dense",
        AutoresetMode.SAME_STEP,
        id=name,
        marks=(pytest.mark.slow, pytest.mark.sampled),
    )
    for name in list_scenes()
    if name not in ("random-target", "capture-and-detumble", "dual-arm")
]
CASES = [
    *(pytest.param(DRAWN, kind, mode, id=f"{kind}-{mode}") for kind in ("sparse", "dense") for mode in MODES),
    *(pytest.param(DIVERGING, "dense", mode, id=f"diverging-{mode}") for mode in MODES),
    pytest.param(short("random-target", 5, "float32"), "dense", MODES[1], id="float32"),
    pytest.param(short("capture-and-detumble", 6), "dense", MODES[0], id="capture-and-detumble"),
    *OTHERS,
]


@pytest.mark.parametrize(("scene", "kind", "mode"), CASES)
def test_bits_are_those_of_single_goal_environments_over_several_episodes(scene, kind, mode):
    native, sync = twins(scene, 5, mode, kind)
    assert native.single_observation_space == sync.single_observation_space
    assert native.observation_space == sync.observation_space
    first = native.reset(seed=1)
    assert native.observation_space.contains(first[0])
    assert_same(first, sync.reset(seed=1))
    native.action_space.seed(0)
    ended = 0
    for _ in range(25):
        actions = native.action_space.sample() * np.float32(1.2)  # some beyond their bounds
        result = native.step(actions)
        assert_same(result, sync.step(actions))
        assert native.observation_space.contains(result[0])
        np.testing.assert_array_equal(
            native.unwrapped.stage_parameters,
            [env.unwrapped._env.stage_parameters for env in sync.envs],
        )
        ended += result[3].sum()
        if "final_obs" in result[4]:
            shown = result[4]["final_obs"][result[3]]
            assert all(native.single_observation_space.contains(last) for last in shown)
    assert ended > 9


def test_episodes_that_end_at_different_times_are_those_of_single_environments():
    native, copies = DQSpaceArmGoalVectorEnv(5, DRAWN, "dense", AutoresetMode.DISABLED), 5
    single = [DQSpaceArmGoalEnv(DRAWN, "dense") for _ in range(copies)]
    seen = [env.reset(seed=i)[0] for i, env in enumerate(single)]
    native.reset(seed=0)
    rng = np.random.default_rng(0)
    over = np.zeros(copies, dtype=bool)
    for _ in range(20):
        mask = over | (rng.random(copies) < 0.3)
        if mask.any():
            for i in np.flatnonzero(mask):
                seen[i] = single[i].reset()[0]
            shown, _ = native.reset(options={"reset_mask": mask})
            for name, part in shown.items():
                np.testing.assert_array_equal(part, [each[name] for each in seen])
        actions = rng.uniform(-1, 1, (copies, 12)).astype(np.float32)
        results = [env.step(action) for env, action in zip(single, actions, strict=True)]
        seen, rewards, _, ends, infos = (list(part) for part in zip(*results, strict=True))
        observations, native_rewards, terminated, over, info = native.step(actions)
        for name, part in observations.items():
            np.testing.assert_array_equal(part, [each[name] for each in seen])
        np.testing.assert_array_equal(native_rewards, rewards)
        np.testing.assert_array_equal(over, ends)
        np.testing.assert_array_equal(info["cost_pose"], [each["cost_pose"] for each in infos])
        assert not terminated.any()
    native.reset()
    for _ in range(5):
        native.step(actions)
    with pytest.raises(ResetNeeded, match="are over"):
        native.step(actions)


def test_rewards_of_any_goals_are_those_of_a_single_environment():
    native, single = DQSpaceArmGoalVectorEnv(4, DRAWN, "dense"), DQSpaceArmGoalEnv(DRAWN, "dense")
    native.reset(seed=0)
    observations, rewards, *_, info = native.step(np.zeros((4, 12)))
    goals = observations["achieved_goal"], observations["desired_goal"]
    np.testing.assert_array_equal(native.compute_reward(*goals, info), rewards)
    other = observations["desired_goal"][::-1]
    expected = [single.compute_reward(goal, wanted) for goal, wanted in zip(goals[0], other, strict=True)]
    np.testing.assert_array_equal(native.compute_reward(goals[0], other), expected)
    assert native.compute_reward(goals[0][0], goals[0][0]) == 0.0


def test_a_single_goal_episode_branches_and_measured_states_are_observed():
    env, venv = DQSpaceArmGoalEnv(DRAWN), DQSpaceArmGoalVectorEnv(3, DRAWN)
    env.reset(seed=3)
    observation, *_ = env.step(np.full(12, 0.5))
    observations, _ = venv.reset(options={"state": env.get_state()})
    for seen in (observations, venv.observe(), venv.observe(np.tile(env.state, (3, 1)))):
        for name, part in seen.items():
            np.testing.assert_array_equal(part, np.tile(observation[name], (3, 1)))
    venv.perturb(np.eye(3, venv.kernels.n_t) * 0.1)
    moved = venv.step(np.zeros((3, 12)))[0]["achieved_goal"]
    assert len(np.unique(moved, axis=0)) == 3


def test_copies_and_results_are_the_callers():
    venv = DQSpaceArmGoalVectorEnv(3, DRAWN, "dense", AutoresetMode.SAME_STEP)
    venv.reset(seed=0)
    results = [venv.step(np.zeros((3, 12))) for _ in range(3)]
    kept = copy.deepcopy(results)
    twin = pickle.loads(pickle.dumps(venv))
    assert (twin.reward_type, twin.autoreset_mode) == ("dense", AutoresetMode.SAME_STEP)
    for _ in range(6):
        result = venv.step(np.ones((3, 12)))
        assert_same(twin.step(np.ones((3, 12))), result)
        for part in result[0].values():
            part[:] = 1.0
    assert_same(tuple(results), tuple(kept))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda v: v.step(np.zeros((3, 12))), ValueError, r"shape \(3, 12\), should be \(4, 12\)"),
        (lambda v: v.step(np.full((4, 12), np.nan)), ValueError, r"NaN for sub-environments \[0, 1, 2, 3\]"),
        (lambda v: v.step(np.full((4, 12), "0.1")), TypeError, "actions: "),
        (lambda v: v.reset(seed=[1, 2]), ValueError, "2 seeds, should be 4"),
        (lambda v: v.reset(options={"nominel": True}), ValueError, "unknown; choose from nominal"),
        (
            lambda v: v.compute_reward(np.zeros((4, 7)), np.zeros(8)),
            ValueError,
            r"shapes \(4, 7\) and \(8,\)",
        ),
        (lambda v: DQSpaceArmGoalVectorEnv(2, DRAWN, "dens"), ValueError, "choose from sparse and dense"),
        (lambda v: DQSpaceArmGoalVectorEnv(2, "dual-arm"), ValueError, "tips besides the main one"),
        (
            lambda v: DQSpaceArmGoalVectorEnv(0, DRAWN),
            ValueError,
            "num_envs: 0, should be a whole number of at least 1",
        ),
        (lambda v: DQSpaceArmGoalVectorEnv(2, DRAWN).step(np.zeros((2, 12))), ResetNeeded, "reset"),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(call, error, message):
    venv = DQSpaceArmGoalVectorEnv(4, DRAWN)
    venv.reset(seed=0)
    before = venv.get_state()
    with pytest.raises(error, match=message):
        call(venv)
    assert_same(venv.get_state(), before)
