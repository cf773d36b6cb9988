"""Models trained in VecNormalize, or with rescaled actions, fly as they were trained, or are refused."""

import pickle
import tracemalloc
from pathlib import Path

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from gymnasium import wrappers
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorWrapper
from gymnasium.wrappers.vector import NormalizeReward, RescaleAction, TransformAction
from gymnasium.wrappers.vector import TransformReward as VectorTransformReward
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from agents import DQSpaceArmVecEnv, SB3VecEnv, compare, evaluate, export_policy
from agents.policies.pickled_arrays import PickledError, as_array, read_pickled
from agents.wrappers import ShrinkActionSpace as SingleShrinkActionSpace
from agents.wrappers.vector import ShrinkActionSpace
from agents.zoo.finding import PolicyError, as_policy
from dq_space_arm_env.command_line import main

pytestmark = pytest.mark.agents

SMALL = {"net_arch": [16, 16]}


def trained(environment, kind=PPO, **options):
    """A model after some steps, with a policy that tells observations apart."""
    options |= {"n_steps": 8, "batch_size": 8} if kind is PPO else {"buffer_size": 100, "learning_starts": 4}
    model = kind("MlpPolicy", environment, seed=0, device="cpu", policy_kwargs=dict(SMALL), **options)
    return model.learn(16)


@pytest.fixture(scope="module")
def normalized(small_scene, tmp_path_factory):
    """A model in memory, its file, and that of its statistics."""
    folder = tmp_path_factory.mktemp("normalized")
    environment = VecNormalize(DQSpaceArmVecEnv(2, small_scene), clip_obs=3.0)
    model = trained(environment)
    model.save(folder / "model.zip")
    environment.save(folder / "vecnormalize.pkl")
    return model, folder / "model.zip", folder / "vecnormalize.pkl"


def test_wrappers_of_single_environments_that_a_model_does_not_note_are_refused(small_scene):
    def model_in(*wrap):
        env = gymnasium.make("DQSpaceArm-v0", scene=small_scene)
        for each in wrap:
            env = each(env)
        return PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu", policy_kwargs=dict(SMALL))

    def rescaled(env):
        return wrappers.RescaleAction(env, -1, 1)

    small = model_in(lambda env: SingleShrinkActionSpace(env, 0.1), rescaled)
    seen = model_in(wrappers.NormalizeObservation)
    tenfold = model_in(
        lambda env: wrappers.TransformObservation(env, lambda x: 10 * x, env.observation_space)
    )
    for model, said in (
        (small, "actions pass RescaleAction of a single"),
        (seen, "pass Gymnasium's Normalize"),
        (tenfold, "observations pass TransformObservation, which only its environment applies"),
    ):
        with pytest.raises(ValueError, match=said):
            export_policy(model)
        with pytest.raises(PolicyError, match=said):
            as_policy(model)
    plain = DQSpaceArmVecEnv(2, small_scene)
    model = trained(plain)
    plain.close()
    as_policy(model)
    assert export_policy(model_in(rescaled)).action_scale.tolist() == [1.0] * 6  # which changes nothing
    as_policy(model_in(wrappers.FlattenObservation))


class Negated(VecEnvWrapper):
    """A wrapper of one's own for Stable-Baselines3, which changes observations."""

    def reset(self):
        return -self.venv.reset()

    def step_wait(self):
        seen, *rest = self.venv.step_wait()
        return -seen, *rest


class NegatedSingle(gymnasium.Wrapper):
    """Likewise for a single environment, without saying that it is a wrapper of observations."""

    def reset(self, **options):
        seen, info = self.env.reset(**options)
        return -seen, info

    def step(self, action):
        seen, *rest = self.env.step(action)
        return -seen, *rest


class NegatedVector(VectorWrapper):
    """Likewise for a vector environment."""

    reset, step = NegatedSingle.reset, NegatedSingle.step


class Twofold(gymnasium.RewardWrapper):
    """A wrapper of one's own that changes rewards alone."""

    def reward(self, reward):
        return 2.0 * reward


def single_in(scene, *wrap):
    env = gymnasium.make("DQSpaceArm-v0", scene=scene)
    for each in wrap:
        env = each(env)
    return env


def odd(env):
    return wrappers.TransformAction(env, lambda action: action**3, env.action_space)  # the ends stay


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda scene: Negated(DQSpaceArmVecEnv(2, scene)), "Negated"),
        (lambda scene: VecCheckNan(Negated(DQSpaceArmVecEnv(2, scene))), "Negated"),
        (lambda scene: VecFrameStack(DQSpaceArmVecEnv(2, scene), 2), "VecFrameStack"),
        (lambda scene: single_in(scene, NegatedSingle), "NegatedSingle"),
        (lambda scene: single_in(scene, odd), "TransformAction"),
        (lambda scene: wrapped(scene, NegatedVector), "NegatedVector"),
        (lambda scene: held_by_processes(scene, NegatedSingle), "wrappers in other processes"),
    ],
)
def test_wrappers_that_are_not_known_to_be_harmless_are_refused(make, name, small_scene):
    environment = make(small_scene)
    model = PPO("MlpPolicy", environment, n_steps=8, batch_size=8, device="cpu", policy_kwargs=dict(SMALL))
    for way in (export_policy, as_policy):
        with pytest.raises(ValueError, match=rf"the model's (observations or )?actions (may )?pass {name}"):
            way(model)
    model.get_env().close()


@pytest.mark.parametrize(
    "make",
    [
        lambda scene: VecCheckNan(VecMonitor(DummyVecEnv([lambda: single_in(scene)]))),
        lambda scene: single_in(scene, Twofold, wrappers.RecordEpisodeStatistics),
        lambda scene: wrapped(scene, lambda env: VectorTransformReward(env, np.tanh), NormalizeReward),
        lambda scene: held_by_processes(scene, wrappers.RecordEpisodeStatistics),
    ],
    ids=["Stable-Baselines3", "single", "vector", "processes"],
)
def test_wrappers_that_are_known_to_be_harmless_pass(make, small_scene):
    environment = make(small_scene)
    model = PPO("MlpPolicy", environment, n_steps=8, batch_size=8, device="cpu", policy_kwargs=dict(SMALL))
    export_policy(model)
    as_policy(model)
    model.get_env().close()


def held_by_processes(scene, *wrap):
    """Environments in other processes, of which Gymnasium notes nothing."""
    mode = AutoresetMode.SAME_STEP
    return SB3VecEnv(AsyncVectorEnv([lambda: single_in(scene, *wrap)] * 2, autoreset_mode=mode))


@pytest.mark.slow
def test_processes_of_stable_baselines3_tell_which_wrappers_they_have(small_scene):
    environment = SubprocVecEnv([lambda: single_in(small_scene, Twofold)] * 2)
    model = PPO("MlpPolicy", environment, n_steps=8, batch_size=8, device="cpu")
    as_policy(model)
    environment.close()
    environment = SubprocVecEnv([lambda: single_in(small_scene, NegatedSingle)])
    with pytest.raises(PolicyError, match="pass wrappers in other processes"):
        as_policy(PPO("MlpPolicy", environment, n_steps=8, batch_size=8, device="cpu"))
    environment.close()


@pytest.mark.parametrize("mode", ["sync", "async", pytest.param("subprocesses", marks=pytest.mark.slow)])
@pytest.mark.parametrize("wrapper", [wrappers.NormalizeObservation, None])
def test_wrappers_of_single_environments_are_seen_in_many(mode, wrapper, small_scene):
    single = [] if wrapper is None else [wrapper]
    if mode == "subprocesses":
        make = {"env_kwargs": {"scene": small_scene}, "wrapper_class": wrapper}
        environment = make_vec_env("DQSpaceArm-v0", 2, vec_env_cls=SubprocVecEnv, **make)
    else:
        modes = {"vectorization_mode": mode, "vector_kwargs": {"autoreset_mode": AutoresetMode.SAME_STEP}}
        environment = SB3VecEnv(
            gymnasium.make_vec("DQSpaceArm-v0", 2, scene=small_scene, wrappers=single, **modes)
        )
    model = PPO("MlpPolicy", environment, n_steps=8, batch_size=8, device="cpu", policy_kwargs=dict(SMALL))
    if wrapper is None:
        export_policy(model)
    else:
        with pytest.raises(PolicyError, match=r"observations (pass|or actions pass)"):
            as_policy(model)
    environment.close()
    if mode == "subprocesses":
        with pytest.raises(PolicyError, match="are closed, so that their wrappers cannot be seen"):
            as_policy(model)
    elif wrapper is None:
        as_policy(model)


def observations(scene):
    env = gymnasium.make_vec("DQSpaceArm-v0", 50, scene=scene)
    env.reset(seed=3)
    env.action_space.seed(0)
    return np.concatenate([env.step(env.action_space.sample())[0] for _ in range(4)])


def test_a_model_in_memory_of_another_scene_is_refused_before_the_expert_begins(normalized):
    with pytest.raises(
        PolicyError, match="PPO maps 14 observations to 6 inputs; scene 'paper' has 24 and 12"
    ):
        evaluate(normalized[0], "paper", 1)


def test_every_way_to_fly_a_normalized_model_normalizes(normalized, small_scene):
    model, file, statistics = normalized
    seen = observations(small_scene)
    environment = model.get_vec_normalize_env()
    expected = model.predict(environment.normalize_obs(seen.astype(np.float32)), deterministic=True)[0]
    raw = np.clip(model.predict(seen, deterministic=True)[0], -1.0, 1.0)
    assert np.abs(raw - expected).max() > 0.01
    for acting in (as_policy(model), as_policy(export_policy(model)), as_policy(file, normalize=statistics)):
        np.testing.assert_allclose(acting.act(seen), expected, rtol=0.0, atol=2e-6)


def test_a_policy_that_is_ready_to_fly_takes_no_statistics(normalized):
    _, file, statistics = normalized
    acting = as_policy(file, normalize=statistics)
    with pytest.raises(PolicyError, match="normalize: the policy is ready to fly"):
        as_policy(acting, normalize=statistics)


def test_a_normalized_model_is_refused_without_its_statistics(normalized, small_file, tmp_path, capsys):
    _, file, statistics = normalized
    with pytest.raises(PolicyError, match=r"normalized by VecNormalize.*normalize=FILE"):
        evaluate(file, small_file, 2, expert=False)
    words = ["evaluate", str(file), "--scene", str(small_file), "-n", "2", "--no-expert"]
    assert main(words) == 2
    assert "--normalize FILE" in capsys.readouterr().err
    assert main([*words, "--normalize", str(statistics)]) == 0
    assert main([*words, str(file), "--normalize", str(statistics)]) == 2
    assert "belongs to one model (.zip), and there are 2" in capsys.readouterr().err


def test_a_model_that_was_loaded_lacks_its_statistics_until_they_are_given(normalized, small_scene):
    _, file, statistics = normalized
    seen = observations(small_scene)
    expected = as_policy(file, normalize=statistics).act(seen)
    plain = DQSpaceArmVecEnv(2, small_scene)
    for loaded in (PPO.load(file), PPO.load(file, env=plain)):
        for way in (as_policy, export_policy):
            with pytest.raises(ValueError, match=r"normalized by VecNormalize.*normalize=FILE"):
                way(loaded)
        exported = export_policy(loaded, normalize=statistics)
        for acting in (as_policy(exported), as_policy(loaded, normalize=statistics)):
            np.testing.assert_allclose(acting.act(seen), expected, rtol=0.0, atol=2e-6)
    with pytest.raises(PolicyError, match="the policy already holds its normalization"):
        as_policy(exported, normalize=statistics)
    with pytest.raises(PolicyError, match="is for models"):
        as_policy(lambda batch: batch, normalize=statistics)
    with pytest.raises(ValueError, match="in memory: leave normalize out"):
        export_policy(normalized[0], normalize=statistics)


def test_a_file_is_no_model_to_export(normalized):
    with pytest.raises(TypeError, match=r"should be a model of Stable-Baselines3: load a file first"):
        export_policy(str(normalized[1]))


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_a_model_of_plain_observations_takes_no_statistics(kind, normalized, small_scene, tmp_path):
    environment = DQSpaceArmVecEnv(2, small_scene)
    model, file = trained(environment, kind), tmp_path / "plain.zip"
    with np.printoptions(precision=3, suppress=True):  # bounds of the spaces are in the file as text, too
        model.save(file)
    for way in (model, file, kind.load(file)):
        as_policy(way)
        with pytest.raises(PolicyError, match="was trained on plain observations"):
            as_policy(way, normalize=normalized[2])
    elsewhere = kind.load(file, env=environment)
    if kind is SAC:  # which keeps as much of plain observations as of normalized ones
        with pytest.raises(PolicyError, match=r"does not tell whether .* load it without env"):
            as_policy(elsewhere)
        elsewhere.learn(16)
    export_policy(elsewhere)


@pytest.mark.parametrize("verb", ["simulate", "replay", pytest.param("compare", marks=pytest.mark.slow)])
def test_every_verb_takes_the_statistics_of_a_model(verb, normalized, small_file, tmp_path, capsys):
    file, statistics = (str(each) for each in normalized[1:])
    out = ["--out", str(tmp_path / "out")]
    words = {
        "simulate": ["simulate", str(small_file), "--policy", file, *out],
        "replay": ["replay", "zero", f"agent={file}", "--scene", str(small_file), *out],
        "compare": ["compare", file, "--scene", str(small_file), "-n", "2", "--controller", "none", *out],
    }[verb]
    assert main(words) == 2
    assert "--normalize FILE" in capsys.readouterr().err
    assert main([*words, "--normalize", str(tmp_path / "missing.pkl")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main([*words, "--normalize", statistics]) == 0
    others = ["zero" if word.endswith(file) else word for word in words]
    assert main([*others, "--normalize", statistics]) == 2
    assert "belongs to one model (.zip), and there are 0" in capsys.readouterr().err


def test_a_simulated_flight_of_a_normalized_model_is_that_of_the_model(normalized, small_file, tmp_path):
    model, file, statistics = normalized
    words = ["simulate", str(small_file), "--policy", str(file), "--normalize", str(statistics)]
    assert main([*words, "--seed", "3", "--out", str(tmp_path / "flight.npz")]) == 0
    env = gymnasium.make("DQSpaceArm-v0", scene=str(small_file))
    observation, _ = env.reset(seed=3)
    action = as_policy(model).act(observation[None])[0]
    with np.load(tmp_path / "flight.npz") as flight:
        limits = env.unwrapped.kernels.layout.to_control(np.clip(action, -1.0, 1.0))
        np.testing.assert_allclose(flight["controls"][0], limits, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_compared_flights_of_a_normalized_model_are_those_of_the_model(normalized, small_file, tmp_path):
    model, file, statistics = normalized
    with pytest.raises(ValueError, match=r"normalize: other\.zip is not among the policies"):
        compare([file], small_file, 1, controllers=(), normalize={"other.zip": statistics})
    given = {str(file): statistics}
    (row,) = compare([file], small_file, 1, controllers=(), normalize=given, out=tmp_path).rows
    expected = evaluate(model, small_file, 1, expert=False).flights.cost
    np.testing.assert_allclose(row.evaluation.flights.cost, expected, rtol=1e-6)
    assert f"--normalize {statistics}" in row.facts["evaluation_command"]
    other = tmp_path / "other.pkl"
    environment = VecNormalize(DQSpaceArmVecEnv(2, small_file))
    environment.save(other)  # a kept row is that of its statistics alone
    (row,) = compare([file], small_file, 1, controllers=(), normalize={str(file): other}, out=tmp_path).rows
    assert abs(row.evaluation.flights.cost[0] / expected[0] - 1.0) > 1e-6


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_a_model_whose_rewards_alone_are_normalized_flies(kind, small_scene, tmp_path):
    environment = VecNormalize(DQSpaceArmVecEnv(2, small_scene), norm_obs=False)
    model = trained(environment, kind)
    model.save(tmp_path / "model.zip")
    environment.save(tmp_path / "statistics.pkl")
    seen = observations(small_scene)
    expected = as_policy(model).act(seen)
    for options in ({}, {"normalize": tmp_path / "statistics.pkl"}):
        acting = as_policy(tmp_path / "model.zip", **options)
        np.testing.assert_allclose(acting.act(seen), np.clip(expected, -1.0, 1.0), rtol=0.0, atol=2e-6)


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no VecNormalize"),
        (b"\x80\x04N.", "no VecNormalize"),
        (pickle.dumps({("a", "b"): 1}), "a key that is no text"),
        (pickle.dumps(Path("a")), "no VecNormalize"),
        (None, "no such file"),
    ],
)
def test_other_files_are_no_statistics(content, message, normalized, tmp_path):
    file = tmp_path / "statistics.pkl"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(PolicyError, match=f"normalize: .*{message}"):
        as_policy(normalized[1], normalize=file)


def test_statistics_execute_nothing(normalized, tmp_path):
    _, file, statistics = normalized
    saved = pickle.loads(statistics.read_bytes())
    saved.venv = saved.class_attributes = saved.returns = None
    saved.clip_obs = Bomb(tmp_path / "executed")
    (tmp_path / "armed.pkl").write_bytes(pickle.dumps(saved))
    with pytest.raises(PolicyError, match="normalize"):
        as_policy(file, normalize=tmp_path / "armed.pkl")
    assert not (tmp_path / "executed").exists()


def test_statistics_of_another_scene_are_refused(normalized, tmp_path):
    environment = VecNormalize(DQSpaceArmVecEnv(1, "paper"))
    environment.save(tmp_path / "statistics.pkl")
    with pytest.raises(PolicyError, match="statistics of 24 observations, should be 14"):
        as_policy(normalized[1], normalize=tmp_path / "statistics.pkl")


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_arrays_are_read_from_pickles(protocol):
    for array in (np.arange(6.0).reshape(2, 3), np.arange(6, dtype=np.float32).reshape(2, 3).T, np.zeros(())):
        found = as_array(read_pickled(pickle.dumps({"here": array}, protocol=protocol))["here"])
        np.testing.assert_array_equal(found, array)
    assert as_array(read_pickled(pickle.dumps(np.array([None])))) is None


class Zeros:
    """Pickles as an array over a number, of which `bytes` would make as many zeros."""

    def __init__(self, count):
        self.count = count

    def __reduce__(self):
        make = np.zeros(0).__reduce_ex__(5)[0]  # `_frombuffer`, under NumPy's own name
        return make, (self.count, np.dtype(np.float64), (self.count // 8,), "C")


@pytest.mark.parametrize("content", [b"\x80\x05\x96%b.", None], ids=["bytes", "array"])
def test_a_pickle_cannot_claim_memory_that_it_does_not_have(content):
    claimed = 2**27
    if content is not None:  # BYTEARRAY8, with a length alone
        content = content.replace(b"%b", claimed.to_bytes(8, "little"))
    tracemalloc.start()
    try:
        if content is None:
            assert as_array(read_pickled(pickle.dumps(Zeros(claimed)))) is None
        else:
            with pytest.raises(PickledError, match="claims more bytes than it has"):
                read_pickled(content)
        assert tracemalloc.get_traced_memory()[1] < claimed / 8
    finally:
        tracemalloc.stop()


def wrapped(scene, *wrap):
    environment = gymnasium.make_vec("DQSpaceArm-v0", 2, scene=scene, autoreset_mode=AutoresetMode.SAME_STEP)
    for each in wrap:
        environment = each(environment)
    return SB3VecEnv(environment)


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_rescaled_actions_fly_at_their_scale(kind, small_scene, tmp_path):
    scale = {"base_force": 0.01, "base_torque": 0.1}
    rescale = [lambda env: ShrinkActionSpace(env, scale), lambda env: RescaleAction(env, -1, 1)]
    environment = wrapped(small_scene, *rescale)
    model = trained(environment, kind)
    model.save(tmp_path / "model.zip")
    seen = observations(small_scene)
    factors = environment.vector_env.env.single_action_space.high
    expected = model.predict(seen.astype(np.float32), deterministic=True)[0] * factors
    assert np.abs(expected).max() > 0.0
    for way in (model, export_policy(model), tmp_path / "model.zip"):
        np.testing.assert_allclose(as_policy(way).act(seen), expected, rtol=0.0, atol=2e-6)


def test_bounds_of_actions_do_not_depend_on_how_numbers_are_printed(small_scene, tmp_path):
    model = trained(wrapped(small_scene, lambda env: ShrinkActionSpace(env, 0.003)), SAC)
    with np.printoptions(precision=2, suppress=True):
        model.save(tmp_path / "model.zip")
    seen = observations(small_scene)
    expected = model.predict(seen.astype(np.float32), deterministic=True)[0]
    np.testing.assert_allclose(as_policy(tmp_path / "model.zip").act(seen), expected, rtol=0.0, atol=2e-9)


def test_actions_that_pass_unknown_wrappers_are_refused(small_scene, tmp_path):
    environment = wrapped(small_scene, lambda env: TransformAction(env, np.square))
    model = PPO("MlpPolicy", environment, device="cpu")
    model.save(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match="its actions pass 'TransformAction'"):
        as_policy(model)
    with pytest.raises(PolicyError, match="its actions pass 'TransformAction'"):
        as_policy(tmp_path / "model.zip")
