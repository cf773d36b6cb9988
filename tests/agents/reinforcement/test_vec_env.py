"""The environment for Stable-Baselines3 does what that library's own vector environment does, only faster."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, TransformReward

pytest.importorskip("stable_baselines3")

from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from agents import DQSpaceArmVecEnv, SB3VecEnv
from agents.wrappers import RepeatAction, ShapeReward, ShrinkActionSpace, vector
from dq_space_arm_env import DQSpaceArmVectorEnv, load_scene

pytestmark = pytest.mark.agents

STEPS = 20
SMALL = {"net_arch": [8]}


def short_scene(steps=STEPS):
    scene = load_scene("paper")
    return scene.replace(simulation={"steps": steps})


def diverging_scene():
    """Links so stiff that most episodes blow up, after five to seven steps; the others last seven."""
    scene = load_scene("paper")
    links = [link.model_dump() | {"stiffness": 200.0} for link in scene.links]
    return scene.replace(links=links, simulation={"dt": 0.1, "steps": 7, "integrator": "symplectic_euler"})


SHORT, DIVERGING = short_scene(), diverging_scene()


def dummy(copies, scene=SHORT):
    return DummyVecEnv([lambda: Monitor(gymnasium.make("DQSpaceArm-v0", scene=scene)) for _ in range(copies)])


def assert_same_infos(actual, expected):
    """All entries and their types, but for the clock."""
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        if name == "terminal_observation":
            assert actual[name].dtype == np.float32
            np.testing.assert_array_equal(actual[name], value.astype(np.float32))
        elif name == "episode":
            assert actual[name].keys() == value.keys()
            assert actual[name]["l"] == value["l"]
            # Rounded to six digits.
            assert actual[name]["r"] == pytest.approx(value["r"], rel=1e-12, abs=2e-6)
            assert 0.0 < actual[name]["t"] < 600.0
        else:
            assert type(actual[name]) is type(value), name
            np.testing.assert_equal(actual[name], value, name)  # an error that nothing estimates is NaN


class ClockPolicy:
    """Actions that depend on the time left, alike in both precisions."""

    @staticmethod
    def predict(observations, state=None, episode_start=None, deterministic=True):
        phases = np.arange(12) + 10.0 * observations[:, -1:].astype(np.float32)
        return np.sin(phases).astype(np.float32), state


@pytest.mark.parametrize(("scene", "steps"), [(SHORT, 3 * STEPS + 5), (DIVERGING, 60)])
def test_steps_are_those_of_monitored_single_environments(scene, steps):
    native, single = DQSpaceArmVecEnv(5, scene), dummy(5, scene)
    assert native.seed(7) == single.seed(7) == [7, 8, 9, 10, 11]
    first = native.reset()
    np.testing.assert_array_equal(first, single.reset().astype(np.float32))
    assert native.reset_infos == single.reset_infos
    rng = np.random.default_rng(0)
    ended = []
    for _ in range(steps):
        actions = rng.uniform(-1.2, 1.2, (5, 12)).astype(np.float32)
        observations, rewards, dones, infos = native.step(actions)
        expected = single.step(actions)
        assert (observations.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, np.bool_)
        np.testing.assert_array_equal(observations, expected[0].astype(np.float32))
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2])
        for done, info, expected_info in zip(dones, infos, expected[3], strict=True):
            if done:
                assert_same_infos(info, expected_info)
                ended.append((info["episode"]["l"], info["diverged"]))
            else:
                assert info == {}
        assert native.reset_infos == single.reset_infos
    expected_ends = {(STEPS, False)} if scene is SHORT else {(5, True), (6, True), (7, True), (7, False)}
    assert set(ended) == expected_ends
    assert len(ended) >= 15


def same_step(scene, *wrap, **options):
    env = gymnasium.make_vec("DQSpaceArm-v0", 5, scene=scene, autoreset_mode=AutoresetMode.SAME_STEP)
    for each in wrap:
        env = each(env)
    return SB3VecEnv(env, **options)


@pytest.mark.parametrize("step_infos", [False, True])
def test_wrapped_copies_are_those_of_wrapped_single_environments(step_infos):
    """Decisions that their episodes end early, with shaped rewards; statistics are the environment's."""
    scale, shape = {"joint_torque": 0.5}, {"scale": 0.1, "power": 0.5, "success_reward": 1.0}

    def single():
        env = RepeatAction(Monitor(gymnasium.make("DQSpaceArm-v0", scene=DIVERGING)), 3)
        return ShapeReward(ShrinkActionSpace(env, scale), **shape)

    native = same_step(
        DIVERGING,
        lambda env: vector.RepeatAction(env, 3),
        lambda env: vector.ShapeReward(vector.ShrinkActionSpace(env, scale), **shape),
        step_infos=step_infos,
    )
    singles = DummyVecEnv([single] * 5)
    assert native.action_space == singles.action_space
    assert native.seed(7) == singles.seed(7)
    np.testing.assert_array_equal(native.reset(), singles.reset().astype(np.float32))
    rng, ends = np.random.default_rng(0), 0
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (5, 12)).astype(np.float32)
        observations, rewards, dones, infos = native.step(actions)
        expected = singles.step(actions)
        np.testing.assert_array_equal(observations, expected[0].astype(np.float32))
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2])
        ends += dones.sum()
        for done, info, expected_info in zip(dones, infos, expected[3], strict=True):
            if done or step_infos:
                assert_same_infos(info, expected_info)
            else:
                assert info == {}
    assert ends >= 15


def test_returns_are_those_of_the_environment_whether_steps_or_decisions_are_shaped():
    wrap = [lambda env: vector.RepeatAction(env, 3), lambda env: vector.ShapeReward(env, 0.1, 0.5)]
    both = [same_step(DIVERGING, *each, seed=7) for each in (wrap, wrap[::-1])]
    rng, statistics = np.random.default_rng(0), []
    for env in both:
        env.reset()
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (5, 12)).astype(np.float32)
        infos = [env.step(actions)[3] for env in both]
        statistics += [[info["episode"]["r"] for info in each if info] for each in infos]
    assert statistics[::2] == statistics[1::2]
    assert sum(map(len, statistics)) >= 30


def test_any_vector_environment_is_adapted_time_limits_included():
    def single():
        return gymnasium.make("DQSpaceArmGoal-v0", scene=SHORT)

    adapted = SB3VecEnv(SyncVectorEnv([single] * 2, autoreset_mode=AutoresetMode.SAME_STEP), seed=3)
    singles = DummyVecEnv([lambda: Monitor(single()) for _ in range(2)])
    singles.seed(3)
    first = adapted.reset()
    assert {part.dtype for part in first.values()} == {np.dtype(np.float32)}
    for name, part in singles.reset().items():
        np.testing.assert_array_equal(first[name], part.astype(np.float32))
    for _ in range(STEPS):
        observations, _, dones, infos = adapted.step(np.zeros((2, 12)))
        expected = singles.step(np.zeros((2, 12)))
    assert dones.all()
    for name, part in expected[0].items():
        np.testing.assert_array_equal(observations[name], part.astype(np.float32))
    for info, other in zip(infos, expected[3], strict=True):
        assert info["TimeLimit.truncated"]
        assert other["TimeLimit.truncated"]
        assert info["episode"]["l"] == STEPS
        last = other["terminal_observation"]
        for name, part in info["terminal_observation"].items():
            np.testing.assert_array_equal(part, last[name].astype(np.float32))


def test_native_goals_are_those_of_held_and_monitored_single_environments():
    def single():
        return RepeatAction(Monitor(gymnasium.make("DQSpaceArmGoal-v0", scene=SHORT)), 3, reward="last")

    mode = AutoresetMode.SAME_STEP
    native = gymnasium.make_vec("DQSpaceArmGoal-v0", 3, scene=SHORT, autoreset_mode=mode)
    native, singles = SB3VecEnv(vector.RepeatAction(native, 3, reward="last")), DummyVecEnv([single] * 3)
    assert native.seed(7) == singles.seed(7)
    seen, expected = native.reset(), singles.reset()
    rng, ends = np.random.default_rng(0), 0
    for _ in range(STEPS):
        for name, part in expected.items():
            np.testing.assert_array_equal(seen[name], part.astype(np.float32))
        actions = rng.uniform(-1.0, 1.0, (3, 12)).astype(np.float32)
        seen, rewards, dones, infos = native.step(actions)
        expected, *others, other_infos = singles.step(actions)
        np.testing.assert_array_equal([rewards, dones], others)
        for done, info, other in zip(dones, infos, other_infos, strict=True):
            if done:
                last, other_last = info.pop("terminal_observation"), other.pop("terminal_observation")
                for name, part in other_last.items():
                    np.testing.assert_array_equal(last[name], part.astype(np.float32))
                assert_same_infos(info, other)
        ends += dones.sum()
    assert ends >= 6
    goals = expected["achieved_goal"], expected["desired_goal"]
    for venv in (native, singles):  # as hindsight asks
        (rewards,) = venv.env_method("compute_reward", *goals, [{}] * 3, indices=[0])
        np.testing.assert_array_equal(rewards, [-1.0] * 3)


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (
            lambda env: vector.ShapeReward(vector.RepeatAction(env, 3, reward="last"), 0.01),
            "leave ShapeReward",
        ),
        (lambda env: vector.RepeatAction(env, 3), "reward='last'"),
        (lambda env: TransformReward(env, np.float32), "without TransformReward: leave it out"),
    ],
)
def test_hindsight_is_refused_where_stored_rewards_are_others(wrap, message):
    goals = gymnasium.make_vec("DQSpaceArmGoal-v0", 2, scene=SHORT, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(ValueError, match=message):
        SB3VecEnv(wrap(goals)).env_method("compute_reward", np.zeros((2, 8)), np.zeros((2, 8)), None)


def test_copies_of_gymnasiums_own_vector_environments_are_asked():
    def single(**wrapper):
        return RepeatAction(gymnasium.make("DQSpaceArmGoal-v0", scene=SHORT), 3, **wrapper)

    def adapted(**wrapper):
        return SB3VecEnv(
            SyncVectorEnv([lambda: single(**wrapper)] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
        )

    venv = adapted(reward="last")
    assert venv.get_attr("reward_type", indices=[1]) == ["sparse"]
    assert venv.get_attr("scene") == [SHORT] * 2
    assert (venv.has_attr("compute_reward"), venv.has_attr("nothing")) == (True, False)
    goal = np.eye(8)[:1]
    (rewards,) = venv.env_method("compute_reward", goal, goal, None, indices=[0])
    np.testing.assert_array_equal(rewards, [0.0])
    assert venv.env_method("compute_terminated", goal, goal) == [False, False]
    with pytest.raises(ValueError, match="sums or shaped rewards"):
        adapted(reward="sum").env_method("compute_reward", goal, goal, None)


def test_infos_as_lists_are_refused():
    native = DQSpaceArmVectorEnv(2, SHORT, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(TypeError, match=r"in DictInfoToList, .*: leave it out"):
        SB3VecEnv(DictInfoToList(native))


def test_vector_environments_that_reset_at_the_next_step_are_refused():
    with pytest.raises(ValueError, match=r"autoreset mode AutoresetMode.NEXT_STEP, should be .*SAME_STEP"):
        SB3VecEnv(gymnasium.make_vec("DQSpaceArm-v0", 2, scene=SHORT))


def test_what_is_returned_is_the_callers():
    venv = DQSpaceArmVecEnv(3, SHORT, seed=0)
    results = [(venv.reset(), None, None, None)]
    results += [venv.step(np.zeros((3, 12))) for _ in range(STEPS + 1)]
    kept = copy.deepcopy(results)
    for observations, rewards, dones, infos in results[1:]:
        observations += 1.0
        rewards += 1.0
        np.logical_not(dones, out=dones)
        assert len({id(info) for info in infos}) == 3
        for info in infos:
            info["mine"] = True
    twin = DQSpaceArmVecEnv(3, SHORT, seed=0)
    np.testing.assert_array_equal(twin.reset(), kept[0][0])
    for expected in kept[1:]:
        for array, expected_array in zip(twin.step(np.zeros((3, 12)))[:3], expected[:3], strict=True):
            np.testing.assert_array_equal(array, expected_array)
    np.testing.assert_array_equal(results[0][0], kept[0][0])
    assert venv.step(np.zeros((3, 12)))[3] == [{}, {}, {}]


def test_spaces_are_those_of_a_copy_in_single_precision():
    venv = DQSpaceArmVecEnv(4, SHORT)
    single = gymnasium.make("DQSpaceArm-v0", scene=SHORT)
    space = venv.observation_space
    assert (space.dtype, space.shape) == (np.float32, (24,))
    np.testing.assert_array_equal(space.high, single.observation_space.high.astype(np.float32))
    np.testing.assert_array_equal(space.low, single.observation_space.low.astype(np.float32))
    assert venv.action_space == single.action_space
    # The most extreme observation that the environment may give is inside.
    assert space.contains(single.observation_space.high.astype(np.float32))
    assert all(space.contains(observation) for observation in venv.reset())


@pytest.mark.parametrize("wrapper", [lambda venv: venv, lambda venv: VecNormalize(venv, norm_obs=False)])
def test_policies_are_evaluated_like_on_single_environments(wrapper):
    """Without a warning, and with the environment's rewards even where a wrapper changes them."""
    native, single = wrapper(DQSpaceArmVecEnv(3, SHORT, seed=3)), dummy(3)
    single.seed(3)
    returns, lengths = evaluate_policy(ClockPolicy, native, n_eval_episodes=7, return_episode_rewards=True)
    expected = evaluate_policy(ClockPolicy, single, n_eval_episodes=7, return_episode_rewards=True)
    np.testing.assert_allclose(returns, expected[0], rtol=1e-12, atol=2e-6)
    assert lengths == expected[1] == [STEPS] * 7


@pytest.mark.parametrize("wrapper", [lambda venv: venv, VecNormalize])
def test_replay_buffer_holds_last_observations_as_terminal(wrapper):
    venv = wrapper(DQSpaceArmVecEnv(3, SHORT))
    model = SAC(
        "MlpPolicy", venv, learning_starts=30, batch_size=16, policy_kwargs=SMALL, seed=0, device="cpu",
        buffer_size=300,
    )  # fmt: skip
    model.learn(3 * 50)
    buffer, last = model.replay_buffer, [STEPS - 1, 2 * STEPS - 1]
    assert buffer.handle_timeout_termination
    assert buffer.observations.dtype == np.float32
    assert np.flatnonzero(buffer.dones.all(axis=1)).tolist() == last
    assert buffer.dones.sum() == 3 * len(last)
    assert not buffer.timeouts.any()  # a target that looks beyond the end would be wrong here
    whole = SHORT.simulation.steps * SHORT.simulation.dt
    for row in last:
        np.testing.assert_allclose(buffer.next_observations[row, :, -1], 0.0, rtol=0, atol=1e-5)
        np.testing.assert_allclose(buffer.observations[row + 1, :, -1], whole, rtol=1e-4)


def test_seeds_are_for_one_reset():
    venv = DQSpaceArmVecEnv(3, SHORT, seed=5)
    first, second = venv.reset(), venv.reset()
    assert (first[0] != second[0]).any()
    assert (first[0] != first[1]).any()
    venv.seed(5)
    np.testing.assert_array_equal(venv.reset(), first)
    np.testing.assert_array_equal(venv.reset(), second)
    assert len(set(venv.seed())) == 3  # at random
    np.testing.assert_array_equal(DQSpaceArmVecEnv(3, SHORT, seed=5).reset(), first)


def test_a_reset_begins_new_statistics():
    venv = DQSpaceArmVecEnv(2, SHORT, seed=0)
    venv.reset()
    for _ in range(7):
        venv.step(np.ones((2, 12)))
    venv.seed(0)
    venv.reset()
    for _ in range(STEPS):
        infos = venv.step(np.zeros((2, 12)))[3]
    assert [info["episode"]["l"] for info in infos] == [STEPS] * 2
    twin = DQSpaceArmVecEnv(2, SHORT, seed=0)
    twin.reset()
    rewards = np.sum([twin.step(np.zeros((2, 12)))[1] for _ in range(STEPS)], axis=0, dtype=np.float64)
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], rewards, rtol=1e-6)


def test_options_are_for_one_reset_and_may_differ_between_copies():
    native, single = DQSpaceArmVecEnv(4, SHORT), dummy(4)
    start = native.vector_env.kernels.layout.initial_state
    turned = start.copy()
    turned[8] += 0.5
    options = [{"nominal": True}, {}, {"initial_state": turned}, {}]
    for venv in (native, single):
        venv.seed(2)
        venv.set_options(options)
    for _ in range(3):  # the second and third at random
        np.testing.assert_array_equal(native.reset(), single.reset().astype(np.float32))
        assert native.reset_infos == single.reset_infos
    native.set_options({"nominal": True})
    nominal = native.reset()
    np.testing.assert_array_equal(nominal, np.tile(nominal[0], (4, 1)))
    native.set_options({"initial_state": np.stack([start, turned, start, turned])})
    np.testing.assert_array_equal(native.reset()[[0, 2]], nominal[[0, 2]])
    np.testing.assert_array_equal(native.vector_env.states[:, 8], [start[8], turned[8]] * 2)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda v: v.set_options([{}] * 2), ValueError, "2 dictionaries, should be 3"),
        (lambda v: v.set_options({"reset_mask": np.ones(3, dtype=bool)}), ValueError, "leave it out"),
        (lambda v: (v.set_options({"nominel": 1}), v.reset()), ValueError, "unknown; choose from nominal"),
        (lambda v: v.step(np.zeros((2, 12))), ValueError, r"shape \(2, 12\), should be \(3, 12\)"),
        (lambda v: v.set_attr("tag", 1, indices=0), ValueError, r"all 3 copies .* for \[0\] alone"),
        (lambda v: v.set_attr("scene", "far"), AttributeError, "'scene' is fixed"),
        (lambda v: v.env_method("close", indices=[1]), ValueError, r"method 'close' is shared"),
        (lambda v: v.env_method("reset"), ValueError, "call that of DQSpaceArmVecEnv"),
        (lambda v: v.get_attr("nothing"), AttributeError, "nothing"),
        (lambda v: v.get_attr("scene", indices=[0, 3]), IndexError, "out of range"),
        (lambda v: DQSpaceArmVecEnv(3, SHORT, render_mode="human"), ValueError, "render_mode: 'human'"),
        (lambda v: DQSpaceArmVecEnv(3, SHORT).step_wait(), RuntimeError, "step_async"),
        (lambda v: DQSpaceArmVecEnv(3, SHORT).step(np.zeros((3, 12))), ResetNeeded, "reset"),
    ],
)
def test_bad_calls_are_refused(call, error, message):
    venv = DQSpaceArmVecEnv(3, SHORT, seed=0)
    venv.reset()
    with pytest.raises(error, match=message):
        call(venv)


def test_attributes_and_methods_are_shared_by_the_copies():
    venv = DQSpaceArmVecEnv(3, SHORT)
    assert venv.get_attr("scene") == [venv.vector_env.scene] * 3
    assert venv.get_attr("scene", indices=[0, -1]) == [venv.vector_env.scene] * 2
    assert venv.get_attr("observation_space", indices=1) == [venv.observation_space]
    assert (venv.has_attr("kernels"), venv.has_attr("nothing")) == (True, False)
    venv.set_attr("tag", "first", indices=range(3))
    assert venv.get_attr("tag") == ["first"] * 3
    assert venv.env_method("close") == [None] * 3
    assert venv.env_is_wrapped(Monitor) == [True] * 3
    assert venv.env_is_wrapped(gymnasium.wrappers.TimeLimit, indices=[0]) == [False]


def test_attributes_of_wrappers_are_as_fixed_as_those_of_the_environment():
    native = DQSpaceArmVectorEnv(2, SHORT, autoreset_mode=AutoresetMode.SAME_STEP)
    venv = SB3VecEnv(vector.RepeatAction(native, 4))
    with pytest.raises(AttributeError, match="attribute 'repeat' is fixed"):
        venv.set_attr("repeat", 2)


@pytest.mark.parametrize(
    "wrong", [{"returns": np.zeros(3)}, {"returns": "x"}, {"lengths": np.array(["1"] * 2)}]
)
def test_statistics_of_another_kind_are_refused_with_nothing_changed(wrong):
    venv = DQSpaceArmVecEnv(2, SHORT, seed=0)
    venv.reset()
    saved = venv.get_state()
    venv.step(np.ones((2, 12)))
    states = venv.vector_env.states
    with pytest.raises(ValueError, match=r"(returns|lengths) is missing, or not numbers of shape \(2,\)"):
        venv.set_state({**saved, **wrong})
    np.testing.assert_array_equal(venv.vector_env.states, states)


def test_copies_are_drawn_with_a_render_mode():
    venv = DQSpaceArmVecEnv(2, SHORT, seed=0, render_mode="rgb_array", width=64, height=48)
    venv.reset()
    pictures = venv.get_images()
    assert [picture.shape for picture in pictures] == [(48, 64, 3)] * 2
    assert not np.array_equal(*pictures)
    np.testing.assert_array_equal(pictures, venv.vector_env.render())
    assert venv.render().shape == (96, 64, 3)  # Stable-Baselines3 tiles them
    assert venv.metadata["render_fps"] == venv.vector_env.metadata["render_fps"]


@pytest.mark.parametrize("duplicate", [lambda venv: pickle.loads(pickle.dumps(venv)), copy.deepcopy])
def test_pickled_environments_are_made_anew(duplicate):
    venv = DQSpaceArmVecEnv(2, scene=SHORT, seed=4)
    first = venv.reset()
    venv.step(np.zeros((2, 12)))
    twin = duplicate(venv)
    assert twin.vector_env is not venv.vector_env
    np.testing.assert_array_equal(twin.reset(), first)
    assert twin.step(np.zeros((2, 12)))[3] == [{}, {}]
