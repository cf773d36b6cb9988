"""Wrappers of actions and rewards: what they do, and the vector ones bit for bit like the single ones."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics, RescaleAction
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics
from gymnasium.wrappers.vector import RescaleAction as RescaleVectorAction

from agents.wrappers import RepeatAction, ShapeReward, ShrinkActionSpace, vector
from dq_space_arm_env import load_scene

PAPER = load_scene("paper")
PLANAR = load_scene("planar").replace(simulation={"steps": 200, "dt": 0.05})
EIGHT_STEPS = PAPER.replace(simulation={"steps": 8})
LINKS = [link.model_dump() | {"stiffness": 200.0} for link in PAPER.links]
BOUNDS = {"kind": "joint_limits", "name": "bounds", "upper": [0.0, 1.5, 0.0]}
UNEVEN = PAPER.replace(
    links=LINKS,
    constraints=[BOUNDS],
    simulation={"dt": 0.1, "steps": 7, "integrator": "symplectic_euler"},
)
"""Most episodes blow up, after five to seven steps; the others last seven."""
STILL = np.zeros(12, dtype=np.float32)


def assert_same(actual, expected, path="result"):
    if isinstance(expected, dict):
        assert actual.keys() == expected.keys(), path
        for key in expected:
            assert_same(actual[key], expected[key], f"{path}[{key!r}]")
    elif isinstance(expected, tuple | list) or (
        isinstance(expected, np.ndarray) and expected.dtype.hasobject
    ):
        for i, (a, b) in enumerate(zip(actual, expected, strict=True)):
            assert_same(a, b, f"{path}[{i}]")
    else:
        np.testing.assert_array_equal(actual, expected, err_msg=path)


def held(repeat=4, scene=EIGHT_STEPS, **settings):
    return RepeatAction(gymnasium.make("DQSpaceArm-v0", scene=scene), repeat, **settings)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_wrappers_are_bit_equal_to_single_ones(mode):
    """Where some episodes end during a hold, others with it, and others go on."""
    scale, shape = {"base_force": 0.01}, {"scale": 0.1, "power": 0.5}
    shape |= {"success_reward": 1.0, "end_error_cost": 2.0}

    def single():
        return ShapeReward(ShrinkActionSpace(held(3, UNEVEN, step_infos=True), scale), **shape)

    native = gymnasium.make_vec("DQSpaceArm-v0", 6, scene=UNEVEN, autoreset_mode=mode)
    native = vector.ShrinkActionSpace(vector.RepeatAction(native, 3, step_infos=True), scale)
    native = vector.ShapeReward(native, **shape)
    sync = SyncVectorEnv([single] * 6, autoreset_mode=mode)
    assert native.action_space == sync.action_space
    assert_same(native.reset(seed=3), sync.reset(seed=3))
    rng, lengths, costs = np.random.default_rng(0), set(), set()
    for step in range(10):
        actions = rng.uniform(-1.2, 1.2, (6, 12)).astype(np.float32)
        result, expected = native.step(actions), sync.step(actions)
        over = result[2] | result[3]
        assert_same((result[0], result[1].astype(float), *result[2:]), expected, f"step {step}")
        repeater = native.env.env
        lengths |= {tuple(repeater.steps_taken.tolist())}
        moved = repeater.steps_taken > 0  # and were not reset
        costs |= set(repeater.largest_cost.tolist())
        np.testing.assert_array_equal(
            repeater.largest_cost[moved], np.array(sync.get_attr("largest_cost"))[moved]
        )
        if mode is AutoresetMode.DISABLED and over.any():
            for env in (native, sync):
                env.reset(options={"reset_mask": over.copy()})
    assert {1, 2, 3} <= {taken for each in lengths for taken in each}
    assert max(costs) > 0.0


def test_actions_of_sub_environments_that_reset_do_not_matter():
    envs = [vector.RepeatAction(gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS), 3) for _ in "ab"]
    actions = np.tile(STILL, (2, 1))
    for env in envs:
        env.reset(seed=0)
        env.step(actions)
        env.reset(options={"reset_mask": np.array([True, False])})
        for _ in range(2):
            result = env.step(actions)
        np.testing.assert_array_equal(result[2], [False, True])
    missing = actions.copy()
    missing[1] = np.nan
    assert_same(envs[0].step(missing), envs[1].step(actions))
    with pytest.raises(ValueError, match=r"actions: NaN for sub-environments \[1\]"):
        envs[0].step(missing)


def test_a_decision_is_the_sum_of_its_steps_and_ends_with_its_episode():
    scene = PAPER.replace(simulation={"steps": 6})
    env, plain = held(scene=scene, step_infos=True), gymnasium.make("DQSpaceArm-v0", scene=scene)
    env.reset(seed=1)
    plain.reset(seed=1)
    action = np.full(12, 0.1, dtype=np.float32)
    for steps in (4, 2):
        observation, reward, terminated, truncated, info = env.step(action)
        flown = [plain.step(action) for _ in range(steps)]
        np.testing.assert_array_equal(observation, flown[-1][0])
        assert reward == pytest.approx(sum(each[1] for each in flown), rel=1e-12)
        assert (terminated, truncated, env.steps_taken) == (steps == 2, False, steps)
        assert env.largest_cost == 0.0  # there are no constraints
        assert_same(info.pop("step_infos"), [each[4] for each in flown])
        assert_same(info, flown[-1][4])


def test_a_time_limit_during_a_hold_truncates_the_decision():
    limited = gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS, max_episode_steps=5)
    env = RepeatAction(limited, 4)
    env.reset(seed=0)
    assert [env.step(STILL)[2:4] for _ in range(2)] == [(False, False), (False, True)]
    assert env.steps_taken == 1


def test_rewards_are_discounted_within_a_decision_if_asked():
    rewards = {}
    for discount in (1.0, 0.5):
        env = held(2, discount=discount)
        env.reset(seed=0)
        rewards[discount] = env.step(STILL)[1]
    single = held(1)
    single.reset(seed=0)
    first, second = single.step(STILL)[1], single.step(STILL)[1]
    assert rewards == {1.0: first + second, 0.5: first + 0.5 * second}


def test_pictures_of_decisions_are_as_far_apart_as_decisions():
    native = gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS)
    for env in (held(4), vector.RepeatAction(native, 4)):
        assert env.metadata["render_fps"] == env.env.metadata["render_fps"] / 4
    assert vector.RepeatAction(native, 4).metadata["autoreset_mode"] is native.metadata["autoreset_mode"]


def test_the_last_reward_counts_alone_where_it_is_that_of_a_place():
    env = RepeatAction(gymnasium.make("DQSpaceArmGoal-v0", scene=EIGHT_STEPS), 4, reward="last")
    env.reset(seed=0)
    assert env.step(STILL)[1] == -1.0


def test_a_power_is_that_of_the_mean_and_keeps_the_sign():
    reward = vector.ShapeReward(
        vector.RepeatAction(gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS), 4), 3.0, 0.5
    )
    shaped = reward._shaping.of_steps([-16.0, 64.0, 0.0], 4)
    np.testing.assert_array_equal(shaped, np.float32([-3.0 * 4 * 2.0, 3.0 * 4 * 4.0, 0.0]))


@pytest.mark.parametrize(("repeats", "lengths"), [([6], [6, 2]), ([2, 2], [4, 4]), ([3, 2], [6, 2])])
def test_the_mean_of_a_short_decision_is_that_of_its_own_steps(repeats, lengths):
    """With one repetition inside another too."""
    env = gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS)
    for repeat in repeats:
        env = RepeatAction(env, repeat)
    env = ShapeReward(env, 3.0, 0.5)
    env.reset(seed=0)
    for steps in lengths:
        _, reward, over, _, _ = env.step(STILL)
        assert reward == pytest.approx(-3.0 * steps * np.sqrt(-env.unshaped / steps), rel=1e-6)
    assert over


@pytest.mark.parametrize("repeat", [1, 20])
def test_an_early_end_never_pays_whatever_the_power(repeat):
    """Its charge for all remaining steps is shaped as theirs would have been."""
    held_back = {
        "kind": "joint_limits",
        "name": "limits",
        "lower": [-0.7, -np.inf, -np.inf],
        "tolerance": 0.05,
    }
    returns = []
    for terminates in (True, False):
        scene = PLANAR.replace(constraints=[{**held_back, "terminates": terminates}])
        env = ShapeReward(RepeatAction(gymnasium.make("DQSpaceArm-v0", scene=scene), repeat), power=0.5)
        env.reset(options={"nominal": True})
        action, over, rewards = np.zeros(env.action_space.shape), False, []
        action[3] = -1.0  # link 1 turns to its limit
        while not over:
            _, reward, over, _, _ = env.step(action)
            rewards.append(reward)
        returns.append(rewards)
    ended, flown = returns
    assert 1 < len(ended) < len(flown)
    assert sum(ended) < sum(flown)


def last_rewards(env):
    """Shaped reward, unshaped reward and info at the end of an episode of two decisions."""
    env.reset(seed=1)
    env.step(STILL)
    _, reward, terminated, _, info = env.step(STILL)
    assert terminated
    return reward, env.unshaped, info


@pytest.mark.parametrize(("degrees", "earned"), [(180.0, 0.5), (1e-6, 0.0)])
def test_success_is_rewarded_at_the_end(degrees, earned):
    success = {"attitude_error_deg": degrees, "position_error": 100.0}
    env = ShapeReward(held(scene=EIGHT_STEPS.replace(success=success)), 0.01, success_reward=0.5)
    reward, unshaped, _ = last_rewards(env)
    assert reward == pytest.approx(0.01 * unshaped + earned, rel=1e-6)


@pytest.mark.parametrize("velocity", [None, 0.2])
def test_errors_at_the_end_cost_the_more_the_larger_they_are_but_not_without_bound(velocity):
    scene = EIGHT_STEPS.replace(success={"velocity_error": velocity})
    reward, unshaped, info = last_rewards(ShapeReward(held(scene=scene), end_error_cost=2.0))
    e = (info["attitude_error"] / 3.0) ** 2 + (info["position_error"] / 0.1) ** 2
    if velocity is not None:
        e += (info["velocity_error"] / velocity) ** 2
    assert reward == pytest.approx(unshaped - 2.0 * e / (1.0 + e), rel=1e-6)


def test_gymnasium_maps_actions_to_the_smaller_box():
    scale = {"base_force": 0.003, "base_torque": 0.05}
    single = ShrinkActionSpace(gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS), scale)
    many = vector.ShrinkActionSpace(gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS), scale)
    np.testing.assert_array_equal(single.action_space.high, np.float32([0.003] * 3 + [0.05] * 3 + [1.0] * 6))
    mapped, plain = RescaleVectorAction(many, -1, 1), gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS)
    full = np.ones(12, dtype=np.float32)
    plain.reset(seed=4)
    mapped.reset(seed=4)
    expected = plain.step(single.action_space.high)
    np.testing.assert_allclose(mapped.step(np.tile(full, (2, 1)))[0][0], expected[0], rtol=0.0, atol=1e-8)
    mapped = RescaleAction(single, -1, 1)
    mapped.reset(seed=4)
    np.testing.assert_allclose(mapped.step(full)[0], expected[0], rtol=0.0, atol=1e-8)


def test_wrapped_environments_are_made_from_their_specification_and_pickle():
    made = gymnasium.make("DQSpaceArm-v0", scene="planar")
    env = ShapeReward(ShrinkActionSpace(RepeatAction(made, 5), {"base_torque": 0.1}), 0.1, success_reward=1.0)
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    for copied in (again, pickle.loads(pickle.dumps(env))):
        assert copied.action_space == env.action_space
        env.reset(seed=0)
        copied.reset(seed=0)
        action = env.action_space.high
        assert_same(copied.step(action), env.step(action))


def test_vector_wrappers_pickle_with_their_episodes():
    native = gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS)
    env = vector.ShapeReward(vector.RepeatAction(native, 3))
    env.reset(seed=0)
    env.step(np.tile(STILL, (2, 1)))
    again = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        assert_same(again.step(np.tile(STILL, (2, 1))), env.step(np.tile(STILL, (2, 1))))


@pytest.mark.parametrize(
    ("wrap", "error", "message"),
    [
        (lambda env: RepeatAction(env, 0), ValueError, "repeat: 0, should be a whole number"),
        (lambda env: RepeatAction(env, 2.0), ValueError, "repeat: 2.0, should be a whole number"),
        (lambda env: RepeatAction(env, 2, reward="mean"), ValueError, "should be 'sum' or 'last'"),
        (lambda env: RepeatAction(env, 2, discount=0.0), ValueError, "discount: 0.0, should be above 0"),
        (lambda env: RepeatAction(env, 2, discount="1"), TypeError, "discount: of type"),
        (lambda env: ShrinkActionSpace(env, "all"), TypeError, "scale: of type"),
        (lambda env: ShrinkActionSpace(env, {"base_force": None}), TypeError, "scale of base_force: of type"),
        (
            lambda env: ShrinkActionSpace(env, {"joint_torque": [0.1, 0.2]}),
            TypeError,
            r"scale of joint_torque: \[0.1, 0.2\], should be one number",
        ),
        (
            lambda env: ShrinkActionSpace(gymnasium.make("Pendulum-v1"), {"joint_torque": 0.1}),
            ValueError,
            "should be numbers for an environment without a scene's actuators",
        ),
        (lambda env: ShrinkActionSpace(env, {1: 0.5}), ValueError, "no actuator is named 1; choose from"),
        (lambda env: ShapeReward(env, scale="1"), TypeError, "scale: of type"),
        (lambda env: ShapeReward(env, scale=[1.0, 2.0]), TypeError, "scale: .*, should be one number"),
        (lambda env: RepeatAction(env, 2, discount=[1.0]), TypeError, "discount: .*, should be one number"),
        (lambda env: ShapeReward(env, end_error_cost=None), TypeError, "end_error_cost: of type"),
        (lambda env: ShrinkActionSpace(env, 1.5), ValueError, "scale: 1.5, should be numbers above 0"),
        (lambda env: ShrinkActionSpace(env, [0.5] * 3), ValueError, "one for each of the 12 actions"),
        (lambda env: ShrinkActionSpace(env, {"base_fource": 0.5}), ValueError, "did you mean 'base_force'"),
        (lambda env: ShrinkActionSpace(env, {"wheel_torque": 0.5}), ValueError, "has no wheel_torque"),
        (lambda env: ShapeReward(env, scale=-1.0), ValueError, "scale: -1.0, should be a positive"),
        (lambda env: ShapeReward(env, power=2.0), ValueError, "power: 2.0, should be above 0"),
        (lambda env: ShapeReward(env, success_reward=-1.0), ValueError, "success_reward: -1.0"),
        (
            lambda env: ShapeReward(gymnasium.make("Pendulum-v1"), end_error_cost=1.0),
            ValueError,
            "an environment without a scene",
        ),
        (lambda env: ShrinkActionSpace(gymnasium.make("CartPole-v1"), 0.5), TypeError, "should be a Box"),
    ],
)
def test_wrong_arguments_are_refused(wrap, error, message):
    with pytest.raises(error, match=message):
        wrap(gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS))


def test_vector_environments_that_cannot_wait_are_refused():
    with pytest.raises(TypeError, match=r"SyncVectorEnv has no get_state\(\)"):
        vector.RepeatAction(SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1")]), 2)
    counting = RecordVectorStatistics(gymnasium.make_vec("DQSpaceArm-v0", 2, scene=EIGHT_STEPS))
    with pytest.raises(TypeError, match=r"RecordEpisodeStatistics inside RepeatAction .* put it around"):
        vector.RepeatAction(counting, 2)
    RepeatAction(RecordEpisodeStatistics(gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS)), 2)


def test_success_has_no_reward_where_nothing_tells_it():
    env = ShapeReward(gymnasium.make("CartPole-v1", max_episode_steps=1), success_reward=1.0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"success_reward: 1.0, should be 0: .* no is_success"):
        env.step(0)


def test_rewards_in_single_precision_are_discounted_in_double_precision():
    def single():
        shaped = ShapeReward(gymnasium.make("DQSpaceArm-v0", scene=EIGHT_STEPS), 0.1, 0.5)
        return RepeatAction(shaped, 4, discount=0.9)

    native = vector.ShapeReward(gymnasium.make_vec("DQSpaceArm-v0", 3, scene=EIGHT_STEPS), 0.1, 0.5)
    native = vector.RepeatAction(native, 4, discount=0.9)
    for env in (native, sync := SyncVectorEnv([single] * 3)):
        env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 12)).astype(np.float32)
    np.testing.assert_array_equal(native.step(actions)[1], sync.step(actions)[1])
