"""A running episode that is saved and put back, in any environment, goes on to the same bits."""

import copy
import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from short_scenes import short

from dq_space_arm_env import (
    DQSpaceArmEnv,
    DQSpaceArmGoalEnv,
    DQSpaceArmGoalVectorEnv,
    DQSpaceArmVectorEnv,
    list_scenes,
)

LENGTH, MODES = 12, ("NextStep", "SameStep", "Disabled")
DRAWN = short("random-target", LENGTH)


def actions(shape, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def fly(env, steps, seed=0):
    """All that an environment returns, across the ends of episodes."""
    seen = []
    for action in actions((steps, *env.action_space.shape), seed):
        *returned, info = env.step(action)
        seen += [*returned, info]
        over = np.asarray(returned[2]) | np.asarray(returned[3])
        if over.ndim == 0 and over:
            seen += [*env.reset()]
        elif over.ndim and over.any() and env.unwrapped.autoreset_mode.value == "Disabled":
            seen += [*env.reset(options={"reset_mask": over})]
        seen.append(env.unwrapped.get_state())
    return copy.deepcopy(seen)


def assert_same(actual, expected):
    if isinstance(expected, dict):
        assert actual.keys() == expected.keys()
        actual, expected = list(actual.values()), list(expected.values())
    if isinstance(expected, list | tuple) or (isinstance(expected, np.ndarray) and expected.dtype == object):
        for one, other in zip(actual, expected, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(actual, expected)


def check(env, other, *, seed):
    with pytest.raises(ResetNeeded):
        env.unwrapped.get_state()
    env.reset(seed=seed)
    fly(env, LENGTH + 4, seed=1)  # in the middle of a second episode
    state = env.unwrapped.get_state()
    kept = copy.deepcopy(state)
    copied, pickled = copy.deepcopy(env), pickle.dumps(env)
    expected = fly(env, 2 * LENGTH)
    assert_same(state, kept)  # it is a copy
    if isinstance(other, DQSpaceArmVectorEnv):
        other.set_state(state)
    else:  # wrappers want a reset
        other.reset(options={"state": state})
    for again in (other, env, copied, pickle.loads(pickled)):
        if again is env:
            env.unwrapped.set_state(state)
        assert_same(fly(again, 2 * LENGTH), expected)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_copies_know_their_specification(make):
    env = make("DQSpaceArm-v0", scene=DRAWN)
    for again in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert again.spec == env.spec
        assert again.spec.id == "DQSpaceArm-v0"
    alone = DQSpaceArmEnv(DRAWN)
    assert copy.deepcopy(alone).spec is alone.spec is None


@pytest.mark.sampled
@pytest.mark.parametrize("name", list_scenes())
def test_a_single_environment_goes_on(name):
    check(*(gymnasium.make("DQSpaceArm-v0", scene=short(name, LENGTH)) for _ in range(2)), seed=3)


def test_a_goal_environment_goes_on():
    check(*(gymnasium.make("DQSpaceArmGoal-v0", scene=DRAWN) for _ in range(2)), seed=3)


@pytest.mark.sampled
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", list_scenes())
def test_a_vector_environment_goes_on(name, mode):
    check(*(DQSpaceArmVectorEnv(3, short(name, LENGTH), mode) for _ in range(2)), seed=[1, 2, 3])


@pytest.mark.parametrize("mode", MODES)
def test_a_goal_vector_environment_goes_on(mode):
    check(*(DQSpaceArmGoalVectorEnv(3, DRAWN, "dense", mode) for _ in range(2)), seed=[1, 2, 3])


@pytest.mark.parametrize("kind", ["DQSpaceArm-v0", "DQSpaceArmGoal-v0"])
def test_reset_goes_on_with_a_state(kind):
    env, other = (gymnasium.make(kind, scene=DRAWN) for _ in range(2))
    env.reset(seed=3)
    *_, (observation, _, _, _, info) = [env.step(action) for action in actions((5, 12))]
    state = env.unwrapped.get_state()
    found, seen = other.reset(options={"state": state})
    assert_same(found, observation)
    for name in ("attitude_error", "position_error", "is_success", "diverged"):
        assert seen[name] == info[name]
    assert_same(other.unwrapped.get_state(), state)
    other.reset(options={"state": state}, seed=7)
    assert_same({**other.unwrapped.get_state(), "generator": 0}, {**state, "generator": 0})
    assert_same(other.reset(), gymnasium.make(kind, scene=DRAWN).reset(seed=7))


@pytest.mark.parametrize("kind", [DQSpaceArmEnv, DQSpaceArmGoalEnv])
def test_elapsed_steps_are_those_since_the_reset(kind):
    vector = {DQSpaceArmEnv: DQSpaceArmVectorEnv, DQSpaceArmGoalEnv: DQSpaceArmGoalVectorEnv}[kind]
    env, venv = kind(DRAWN), vector(2, DRAWN, autoreset_mode="Disabled")
    for each in (env, venv):
        with pytest.raises(ResetNeeded):
            _ = each.elapsed_steps
        each.reset(seed=1)
        for _ in range(3):
            each.step(np.zeros(each.action_space.shape))
    assert env.elapsed_steps == 3
    venv.reset(options={"reset_mask": np.array([False, True])})
    assert venv.elapsed_steps.tolist() == [3, 0]


def test_a_copy_of_a_goal_environment_saves_the_generator_that_it_draws_from():
    env = DQSpaceArmGoalEnv(DRAWN)
    env.reset(seed=1)
    copied = copy.deepcopy(env)
    copied.np_random.random(5)
    state = copied.get_state()
    expected, _ = copied.reset()
    env.set_state(state)
    assert_same(env.reset()[0], expected)


def test_the_episodes_scene_and_target_come_along():
    env, other = DQSpaceArmEnv(DRAWN), DQSpaceArmEnv(DRAWN)
    env.reset(seed=3)
    given = env.target
    for options in ({}, {"target": given}):
        env.reset(seed=4, options=options)
        other.set_state(env.get_state())
        assert other.episode_scene == env.episode_scene
        np.testing.assert_array_equal(other.target, env.target)


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_branches_into_copies(mode):
    env, venv = DQSpaceArmEnv(DRAWN), DQSpaceArmVectorEnv(4, DRAWN, mode)
    observation, _ = env.reset(seed=3)
    for action in actions((5, 12)):
        observation, *_ = env.step(action)
    observations, _ = venv.reset(options={"state": env.get_state()})
    assert_same(observations, np.tile(observation, (4, 1)))
    branches = actions((4, 12), seed=2)
    rewards = venv.step(branches)[1]
    for i, action in enumerate(branches):
        branch = copy.deepcopy(env)
        assert branch.step(action)[1] == rewards[i]


@pytest.mark.parametrize("steps", [5, LENGTH])
@pytest.mark.parametrize(
    "kinds", [(DQSpaceArmEnv, DQSpaceArmVectorEnv), (DQSpaceArmGoalEnv, DQSpaceArmGoalVectorEnv)]
)
def test_an_episode_goes_on_alone(kinds, steps):
    env, venv = kinds[0](DRAWN), kinds[1](3, DRAWN, autoreset_mode="Disabled")
    venv.reset(seed=[1, 2, 3])
    for move in actions((steps, 3, 12)):
        venv.step(move)
    env.set_state({name: array[1] for name, array in venv.get_state().items()})
    over = {"over": np.array(steps == LENGTH)}
    over |= {"truncated": over["over"]} if kinds[0] is DQSpaceArmGoalEnv else {}
    assert_same({name: env.get_state()[name] for name in over}, over)
    if steps < LENGTH:
        assert env.step(move[1])[1] == venv.step(move)[1][1]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rows", [[2, 0], np.array([True, False, True])])
def test_rows_are_saved_and_put_back(mode, rows):
    venv = DQSpaceArmVectorEnv(3, DRAWN, mode)
    venv.reset(seed=[1, 2, 3])
    moves = actions((8, 3, 12))
    for move in moves[:4]:
        venv.step(move)
    state, other = venv.get_state(rows), DQSpaceArmVectorEnv(3, DRAWN, mode)
    with pytest.raises(ResetNeeded, match="the other episodes have not begun"):
        other.set_state(state, rows)
    other.reset(seed=[4, 5, 6])
    before = other.get_state([1])
    other.set_state(state, rows)
    assert_same(other.get_state([1]), before)
    chosen = np.arange(3)[rows]
    for move in moves[4:]:
        np.testing.assert_array_equal(other.step(move)[0][chosen], venv.step(move)[0][chosen])
    mask = np.isin(np.arange(3), chosen)
    whole = venv.get_state()
    other.reset(options={"state": whole, "reset_mask": mask})
    np.testing.assert_array_equal(other.states[mask], whole["x"][mask])
    assert (other.states[1] != whole["x"][1]).any()


@pytest.mark.parametrize("mode", MODES[:2])
def test_environments_that_reset_themselves_hand_over_to_one_that_does_not(mode):
    venv, other = DQSpaceArmVectorEnv(3, DRAWN, mode), DQSpaceArmVectorEnv(3, DRAWN, "Disabled")
    venv.reset(seed=0)
    shown = venv.step(actions((3, 12)))[0]
    other.set_state(venv.get_state())
    observations, _ = other.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(observations[[0, 2]], shown[[0, 2]])
    move = actions((3, 12), 1)
    np.testing.assert_array_equal(other.step(move)[1][[0, 2]], venv.step(move)[1][[0, 2]])


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_that_is_over_stays_so(mode):
    venv, other = (DQSpaceArmVectorEnv(2, DRAWN, mode) for _ in range(2))
    venv.reset(seed=[1, 2])
    for move in actions((LENGTH, 2, 12)):
        venv.step(move)
    other.reset(options={"state": venv.get_state()})
    if mode == "Disabled":
        with pytest.raises(ResetNeeded, match="are over"):
            other.step(move)
    else:
        assert_same(other.step(move), venv.step(move))


def test_bad_states_are_refused_and_change_nothing():
    venv = DQSpaceArmVectorEnv(3, DRAWN, "Disabled")
    env = DQSpaceArmEnv(DRAWN)
    for each in (env, venv):
        each.reset(seed=0)
        state = each.get_state()
        for name, array in state.items():
            wrong = [{name: np.zeros((7, 7))}, {name: array.astype(np.complex128)}]
            wrong += [{}] if name != "seen" else []
            for change in wrong:
                rest = {key: value for key, value in state.items() if key != name}
                with pytest.raises(ValueError, match=f"state: {name} "):
                    each.set_state({**rest, **change})
        for bad in (3, [1, 2], "x"):
            with pytest.raises(ValueError, match=r"should be what get_state.*initial_state"):
                each.set_state(bad)
            with pytest.raises(ValueError, match="should be what get_state"):
                each.reset(options={"state": bad})
        with pytest.raises(ValueError, match="state holds the whole episode, it excludes nominal"):
            each.reset(options={"state": state, "nominal": True})
        with pytest.raises(ValueError, match="state: x has shape"):
            each.reset(options={"state": {**state, "x": state["x"][:2]}})
        for steps in (-1.0, 0.5, 1e7, np.nan):
            counted = state["memory"].copy()
            counted[..., 0] = steps
            with pytest.raises(
                ValueError, match=r"state: memory counts .* steps, should be whole numbers up to"
            ):
                each.set_state({**state, "memory": counted})
        counted[..., 0] = each.scene.simulation.steps
        with pytest.raises(ValueError, match=r"state: memory counts .* steps; after \d+ an episode is over"):
            each.set_state({**state, "memory": counted})
        for name in ("x", "memory", "parameters"):
            bad = state[name].copy()
            bad[..., -1] = np.nan
            with pytest.raises(ValueError, match=f"(?s)state: {name} .*should be finite numbers"):
                each.set_state({**state, name: bad})
        with pytest.raises(ValueError, match=r"(?s)state: x .*should be at most 1e"):
            each.set_state({**state, "x": state["x"] + 2e6})
        for seed in (-1, [1]):  # once with the episode's own state, once with another
            with pytest.raises((ValueError, gymnasium.error.Error), match=r"(?i)seed"):
                each.reset(seed=seed, options={"state": {**state, "x": state["x"] + 0.01}})
        assert_same(each.get_state(), state)
    for rows in ([3], [0, 0], [[True]], "x", True, [[0, 1]]):
        with pytest.raises(ValueError, match="rows: "):
            venv.get_state(rows)
    env.np_random = np.random.Generator(np.random.MT19937(0))
    with pytest.raises(ValueError, match="np_random: a MT19937, should be the PCG64"):
        env.get_state()


def test_what_has_not_begun_is_copied_too():
    for env in (DQSpaceArmEnv(DRAWN), DQSpaceArmVectorEnv(2, DRAWN)):
        copied = copy.deepcopy(env)
        with pytest.raises(ResetNeeded):
            copied.step(np.zeros(env.action_space.shape))
        assert_same(copied.reset(seed=1), env.reset(seed=1))


def test_copies_keep_generators():
    env = DQSpaceArmEnv(DRAWN)
    env.np_random = np.random.Generator(np.random.PCG64(1))
    assert_same(copy.deepcopy(env).reset(), env.reset())
    for env in (DQSpaceArmEnv(DRAWN), DQSpaceArmVectorEnv(2, DRAWN), DQSpaceArmGoalEnv(DRAWN)):
        env.reset(seed=1)
        env.action_space.seed(5)
        env.observation_space.seed(6)
        seed = env.np_random_seed
        copied = pickle.loads(pickle.dumps(env))
        assert copied.np_random_seed == seed
        assert_same(copied.action_space.sample(), env.action_space.sample())
        assert_same(copied.observation_space.sample(), env.observation_space.sample())
        assert_same(copied.reset(), env.reset())


@pytest.mark.parametrize("kind", ["path", "mapping"])
@pytest.mark.parametrize(
    "make",
    [DQSpaceArmEnv, DQSpaceArmGoalEnv, partial(DQSpaceArmVectorEnv, 2), partial(DQSpaceArmGoalVectorEnv, 2)],
)
def test_copies_fly_in_the_scene_that_was_loaded(make, kind, tmp_path):
    scene, file = short("planar", LENGTH), tmp_path / "mine.yaml"
    scene.to_yaml(file)
    given = file if kind == "path" else scene.model_dump()
    env = make(scene=given)
    file.unlink()
    if kind == "mapping":
        given["base"]["mass"] = 1000.0
    for again in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert again.scene == env.scene == scene


def test_a_planner_of_others_branches_an_episode():
    tau_ctrl = pytest.importorskip("tau_ctrl")
    env = gymnasium.make("DQSpaceArm-v0", scene=short("planar", 20).replace({"simulation.dt": 0.3}))
    planner = tau_ctrl.make("cem", env, horizon=12, n_samples=200)

    def cost(act):
        observation, _ = env.reset(seed=3)
        total, over = 0.0, False
        while not over:
            state = env.unwrapped.get_state()
            action = act(observation)
            assert_same(env.unwrapped.get_state(), state)
            observation, reward, over, *_ = env.step(np.clip(action, -1.0, 1.0))
            total -= reward
        return total

    assert cost(lambda observation: planner.predict(observation)[0]) < cost(lambda observation: np.zeros(6))
