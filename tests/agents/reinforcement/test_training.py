"""Every algorithm trains, saves, resumes and exports, and acts the same way each time."""

import io
import json
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import FlattenExtractor

from agents import DQSpaceArmVecEnv, ExportedPolicy, evaluate
from agents.configuration import ConfigurationError, load_configuration
from agents.reinforcement.callback import TrainingCallback
from agents.reinforcement.checkpoint import read_checkpoint
from agents.reinforcement.networks import export_policy
from agents.reinforcement.reinforcement_training import make_environment, make_learner
from agents.run_folder import DivergedError, RunFolder, RunFolderError, reserved, validate
from agents.training import train
from agents.zoo.finding import as_policy, read_policy
from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main

pytestmark = pytest.mark.agents

PAPER = load_scene("paper")
STEPS, REPEAT, COPIES = 40, 4, 4
EVERY = {"evaluate_every": 1600, "checkpoint_every": 1600}
OFF_POLICY = {"batch_size": 32, "learning_starts": 200, "buffer_size": 2000, "gradient_steps": 2}
FALLING_ENTROPY = {"target_entropy": 3.0, "final_target_entropy": -9.0}
ALGORITHMS = {
    "PPO": {"name": "PPO", "n_steps": 10, "batch_size": 40, "n_epochs": 2},
    "SAC": {"name": "SAC", **OFF_POLICY, **FALLING_ENTROPY},
    "TQC": {"name": "TQC", **OFF_POLICY, **FALLING_ENTROPY, "layer_norm": True},
    "TD3": {"name": "TD3", **OFF_POLICY, "layer_norm": True, "action_noise": 0.3, "final_action_noise": 0.1},
    "HER": {"name": "SAC", **OFF_POLICY, "hindsight": {"n_sampled_goal": 2}},
}


def configuration(algorithm, scene_file, total_steps=3200, **changes):
    return load_configuration(
        {
            "name": algorithm.lower(),
            "scene": str(scene_file),
            "environment": {
                "copies": COPIES,
                "action_repeat": REPEAT,
                "action_scale": {"base_force": 0.001, "base_torque": 0.2},
                "reward_scale": 1.0 if algorithm == "HER" else 0.01,
            },
            "network": {"hidden": [16, 16], "activation": "tanh" if algorithm == "PPO" else "relu"},
            "algorithm": ALGORITHMS[algorithm],
            "schedule": {"total_steps": total_steps, "evaluation_episodes": 4, **EVERY},
            **changes,
        }
    )


def observations(model, count=50):
    """As far apart as those of the environment, or twice as far; as the model takes them, and joined."""
    policy = export_policy(model, {})
    deviation = np.where(policy.scale > 0.0, 1.0 / np.maximum(policy.scale, 1e-9), 0.0)
    noise = np.random.default_rng(0).normal(0.0, 1.5, (count, policy.n_observation))
    joined = (policy.mean + deviation * noise).astype(np.float32)
    spaces = getattr(model.observation_space, "spaces", None)
    if spaces is None:
        return joined, joined
    ends = np.cumsum([spaces[name].shape[0] for name in sorted(spaces)])[:-1]
    return dict(zip(sorted(spaces), np.split(joined, ends, axis=1), strict=True)), joined


def state_of(model):
    """Parameters and the state of every optimizer, as a flat list of arrays."""
    tensors = []

    def collect(value):
        if isinstance(value, dict):
            value = [value[key] for key in sorted(value, key=str)]
        if isinstance(value, (list, tuple)):
            for item in value:
                collect(item)
        elif isinstance(value, torch.Tensor):
            tensors.append(value.detach().numpy())
        elif isinstance(value, float):
            tensors.append(np.array(value))

    collect(model.get_parameters())
    return tensors


@pytest.fixture(scope="module")
def trained(scene_file, tmp_path_factory):
    """Each algorithm, trained for some thousand steps."""
    folder = tmp_path_factory.mktemp("runs")
    runs = {}

    def get(algorithm):
        if algorithm not in runs:
            runs[algorithm] = train(configuration(algorithm, scene_file), folder / algorithm)
        return runs[algorithm]

    return get


@pytest.mark.sampled
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_training_learns_for_as_many_steps_as_it_was_asked_for(algorithm, trained, scene_file):
    run = trained(algorithm)
    assert run.model.num_timesteps * REPEAT == 3200
    settings = configuration(algorithm, scene_file)
    untrained = make_learner(settings, make_environment(settings, load_scene(scene_file)))
    weights = zip(export_policy(untrained, {}).weights, run.policy.weights, strict=True)
    assert all(np.abs(after - before).max() > 1e-4 for before, after in weights)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_saved_and_exported_policies_act_like_the_model(algorithm, trained):
    run = trained(algorithm)
    seen, joined = observations(run.model)
    expected, _ = run.model.predict(seen, deterministic=True)
    expected = np.clip(expected, -1.0, 1.0)  # what the environment does
    loaded = read_policy(run.folder / "model.zip")
    np.testing.assert_allclose(loaded(joined), expected, rtol=0.0, atol=1e-6)
    exported = ExportedPolicy.load(run.folder / "policy.npz")
    np.testing.assert_allclose(exported(joined), expected, rtol=0.0, atol=1e-6)
    single = np.array([exported(observation) for observation in joined])
    np.testing.assert_allclose(single, expected, rtol=0.0, atol=1e-6)
    assert np.ptp(expected, axis=0).min() > 0.0
    assert exported.metadata["training"]["environment_steps"] == 3200
    assert exported.metadata["observation"] == ("goal" if algorithm == "HER" else "plain")


@pytest.mark.sampled
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_resumes_with_optimizer_and_buffer(algorithm, trained, scene_file, tmp_path):
    """Killed after its first checkpoint: what a new process reads there is what was written.

    It ends with the very weights of a run that was not killed.
    """
    settings = configuration(algorithm, scene_file)
    kept = {}

    def kill(advance):
        if advance.environment_steps > 1600:
            raise KeyboardInterrupt

    def remember(path, model, progress):
        kept.update(state=[array.copy() for array in state_of(model)], steps=model.num_timesteps)
        if hasattr(model, "replay_buffer"):
            kept.update(actions=model.replay_buffer.actions.copy(), position=model.replay_buffer.pos)
        write(path, model, progress)

    from agents.reinforcement import callback

    write = callback.write_checkpoint
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callback, "write_checkpoint", remember)
        with pytest.raises(KeyboardInterrupt):
            train(settings, tmp_path / "run", report=kill)
    checkpoint = RunFolder(tmp_path / "run", settings).checkpoint()
    environment = make_environment(settings, load_scene(scene_file))
    model = make_learner(settings, environment, blank=True)
    progress = read_checkpoint(checkpoint, model)
    assert progress.environment_steps == kept["steps"] * REPEAT == 1600
    for actual, expected in zip(state_of(model), kept["state"], strict=True):
        np.testing.assert_array_equal(actual, expected)
    if "actions" in kept:
        np.testing.assert_array_equal(model.replay_buffer.actions, kept["actions"])
        assert model.replay_buffer.pos == kept["position"]
    torch.manual_seed(7)  # as in another process
    np.random.seed(7)  # noqa: NPY002
    whole = trained(algorithm)
    run = train(settings, tmp_path / "run")
    assert run.model.num_timesteps * REPEAT == 3200
    for actual, expected in zip(state_of(run.model), state_of(whole.model), strict=True):
        np.testing.assert_array_equal(actual, expected)
    if "actions" in kept:
        for name in ("observations", "actions", "rewards", "dones"):
            columns = (getattr(each.model.replay_buffer, name) for each in (run, whole))
            np.testing.assert_equal(*columns)
    curve = [json.loads(line) for line in (tmp_path / "run" / "evaluations.jsonl").read_text().splitlines()]
    assert [line["environment_steps"] for line in curve] == [1600, 3200]
    assert len(json.loads((tmp_path / "run" / "provenance.json").read_text())) == 3
    again = train(settings, tmp_path / "run")  # nothing is left to do
    for actual, expected in zip(state_of(again.model), state_of(run.model), strict=True):
        np.testing.assert_array_equal(actual, expected)


@pytest.mark.sampled
@pytest.mark.parametrize("algorithm", ["SAC", "TQC"])
def test_the_target_entropy_goes_linearly_to_its_end(algorithm, trained, monkeypatch):
    model = trained(algorithm).model
    done = model.num_timesteps / 800  # decisions
    assert done > 0.95
    # The last update follows the last decision of all copies.
    assert model.target_entropy == pytest.approx(3.0 - 12.0 * done, abs=1e-9)
    assert trained("HER").model.target_entropy == -model.action_space.shape[0]
    monkeypatch.setattr(model, "target_entropy", model.target_entropy)  # put back afterwards, as the next
    monkeypatch.setattr(model, "_current_progress_remaining", -0.6)  # beyond the schedule
    model._update_learning_rate([])
    assert model.target_entropy == -9.0


@pytest.mark.sampled
def test_exploration_noise_goes_linearly_to_its_end(trained):
    model = trained("TD3").model
    chosen = model.policy.scale_action(model.predict(model._last_obs)[0])
    for left in (1.0, 0.5, 0.0, -0.6):  # negative beyond the schedule
        model._current_progress_remaining = left
        explored = [model._sample_action(0, n_envs=COPIES)[1] for _ in range(100)]
        noise = (np.array(explored) - chosen)[:, np.abs(chosen) < 0.2]
        assert noise.size > 500
        assert noise.std() == pytest.approx(0.1 + 0.2 * max(left, 0.0), rel=0.1)


@pytest.mark.sampled
@pytest.mark.parametrize(("algorithm", "outputs"), [("TQC", 25), ("TD3", 1)])
def test_critics_are_layer_normalized_and_optimized(algorithm, outputs, trained):
    critic = trained(algorithm).model.critic
    hidden = [torch.nn.Linear, torch.nn.LayerNorm, torch.nn.ReLU]
    for network in critic.q_networks:
        assert [type(layer) for layer in network] == [*hidden, *hidden, torch.nn.Linear]
        assert network[-1].out_features == outputs
        assert all(np.abs(network[layer].weight.detach().numpy() - 1.0).max() > 1e-5 for layer in (1, 4))
    assert len(list(critic.parameters())) == 2 * (3 * 2 + 2 * 2)


@pytest.mark.parametrize("algorithm", ["HER", "SAC"])
def test_a_run_resumes_in_the_middle_of_episodes(algorithm, scene_file, tmp_path):
    schedule = {"total_steps": 1920, "evaluation_episodes": 4, **EVERY, "checkpoint_every": 1296}
    settings = configuration(algorithm, scene_file, schedule=schedule)

    def kill(advance):
        if advance.environment_steps > 1500:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(settings, tmp_path / "run", report=kill)
    state = np.load(RunFolder(tmp_path / "run", settings).checkpoint() / "arrays.npz")
    assert 0 < state["environment.memory"][0, 0] < STEPS  # steps taken of the episode
    resumed, whole = (train(settings, tmp_path / name) for name in ("run", "whole"))
    for actual, expected in zip(state_of(resumed.model), state_of(whole.model), strict=True):
        np.testing.assert_array_equal(actual, expected)
    for name in ("ep_start", "ep_length", "dones") if algorithm == "HER" else ("dones",):
        np.testing.assert_array_equal(*(getattr(run.model.replay_buffer, name) for run in (resumed, whole)))


class Bomb:
    """Unpickling this creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_resuming_executes_nothing_that_a_checkpoint_holds(scene_file, tmp_path):
    settings, bomb = configuration("SAC", scene_file), Bomb(tmp_path / "executed")
    train(configuration("SAC", scene_file, total_steps=1600), tmp_path / "run")
    checkpoint = RunFolder(tmp_path / "run", settings).checkpoint()
    names = {path.name for path in checkpoint.iterdir()}
    contents = {path: path.read_bytes() for path in checkpoint.iterdir()}
    for name in names | {"model.zip", "replay_buffer.pkl"}:
        for armed in (pickle.dumps(bomb), tensors({"parameters": bomb}), b"", b"{}"):
            (checkpoint / name).write_bytes(armed)
            if name in names:
                with pytest.raises(RunFolderError, match=r"checkpoint .* is damaged"):
                    train(settings, tmp_path / "run")
        for path, content in contents.items():
            path.write_bytes(content)
    (checkpoint / "state.json").unlink()
    with pytest.raises(RunFolderError, match=r"earlier version, whose pickles are not read"):
        train(settings, tmp_path / "run")
    assert not (tmp_path / "executed").exists()


def tensors(value):
    content = io.BytesIO()
    torch.save(value, content)
    return content.getvalue()


def test_networks_see_the_goals_of_hindsight_although_the_target_never_varies(trained):
    """Goals are in units of what is achieved."""
    extractor = trained("HER").model.actor.features_extractor
    achieved, desired = slice(0, 8), slice(8, 16)
    assert (extractor.scale[desired] > 0.0).any()
    assert torch.equal(extractor.scale[desired], extractor.scale[achieved])
    assert torch.equal(extractor.mean[desired], extractor.mean[achieved])


def test_an_unfinished_checkpoint_is_none(scene_file, tmp_path):
    folder = RunFolder(tmp_path, configuration("PPO", scene_file))
    (tmp_path / "checkpoints" / "somebody's").mkdir()

    def fail(path):
        (path / "model.zip").write_bytes(b"half of it")
        raise OSError("the disk is full")

    folder.add_checkpoint(10, lambda path: (path / "model.zip").touch())
    with pytest.raises(OSError, match="full"):
        folder.add_checkpoint(20, fail)
    assert folder.checkpoint().name == f"{10:012d}"
    folder.add_checkpoint(30, lambda path: (path / "model.zip").touch())
    left = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert left == {"somebody's", f"{30:012d}"}
    with pytest.raises(OSError, match="full"):
        folder.add_checkpoint(40, fail)
    folder.add_checkpoint(30, fail)  # it is there: a kill while it is replaced would leave none
    assert (folder.checkpoint() / "model.zip").read_bytes() == b""


def test_a_folder_is_for_one_configuration_and_scene_but_may_get_more_time(scene_file, tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_bytes(scene_file.read_bytes())
    for changes in ({}, {"description": "the same in other words"}, {"total_steps": 6400}):
        RunFolder(tmp_path / "run", configuration("PPO", path, **changes)).write_evaluations([])
    with pytest.raises(RunFolderError, match="total_steps: 6400, which may become larger, not 3200"):
        RunFolder(tmp_path / "run", configuration("PPO", path))
    with pytest.raises(RunFolderError, match="seed is 0 there and 1 here"):
        RunFolder(tmp_path / "run", configuration("PPO", path, seed=1))
    PAPER.replace(name="short", simulation={"dt": 0.01, "steps": STEPS}).to_yaml(path)
    with pytest.raises(RunFolderError, match="started with another version of scene"):
        RunFolder(tmp_path / "run", configuration("PPO", path, total_steps=6400))


def test_a_damaged_file_of_a_folder_is_named(scene_file, tmp_path):
    settings = configuration("PPO", scene_file)
    for name in ("evaluations.jsonl", "provenance.json"):
        folder = tmp_path / f"with damaged {name}"
        RunFolder(folder, settings)
        (folder / name).write_text('{"half')
        with pytest.raises(RunFolderError, match=f"{name} is damaged"):
            RunFolder(folder, settings).evaluations()


RESERVE = "import sys, pathlib; from agents.run_folder import reserved\n"
RESERVE += "with reserved(pathlib.Path(sys.argv[1])): print('reserved', flush=True); sys.stdin.read()"


def test_two_processes_do_not_train_in_one_folder(scene_file, tmp_path):
    command = [sys.executable, "-c", RESERVE, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=Path(__file__).parents[3], **pipes) as other:
        assert other.stdout.readline() == "reserved\n"
        with pytest.raises(RunFolderError, match="another process trains in"):
            train(configuration("PPO", scene_file), tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {".lock"}
        other.kill()
    with reserved(tmp_path):  # a killed process keeps nothing
        pass


@pytest.mark.slow
def test_the_policy_is_written_last(scene_file, tmp_path, monkeypatch):
    """With it a run counts as finished: killed before, it resumes and writes the model too."""

    def fail(path, content):
        raise OSError("no space left")

    monkeypatch.setattr("agents.reinforcement.reinforcement_training.write_atomically", fail)
    with pytest.raises(OSError, match="no space left"):
        train(configuration("PPO", scene_file), tmp_path)
    assert not (tmp_path / "policy.npz").exists()


def test_a_run_whose_time_is_up_is_left_as_it_is(scene_file, tmp_path):
    settings = configuration("PPO", scene_file, total_steps=10**6).model_dump(exclude_none=True)
    settings["schedule"]["minutes"] = 1e-6
    first = train(settings, tmp_path)
    curve = (tmp_path / "evaluations.jsonl").read_text()
    assert first.model.num_timesteps * REPEAT < 10**6
    again = train(settings, tmp_path)
    assert again.model.num_timesteps == first.model.num_timesteps
    assert (tmp_path / "evaluations.jsonl").read_text() == curve


def test_a_run_whose_time_is_up_resumes_to_the_same_weights(trained, scene_file, tmp_path, monkeypatch):
    """It stops between two rollouts, and throws none away."""
    over = property(lambda callback: callback.progress.environment_steps >= 1920)
    monkeypatch.setattr(TrainingCallback, "is_time_up", over)
    settings = configuration("PPO", scene_file)
    assert train(settings, tmp_path).model.num_timesteps * REPEAT == 1920
    monkeypatch.undo()
    run = train(settings, tmp_path)
    for actual, expected in zip(state_of(run.model), state_of(trained("PPO").model), strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_flights_are_no_training(scene_file, tmp_path, monkeypatch):
    flown = [0.0]

    def slow(*arguments):
        flown[0] += 1e6
        return validate(*arguments)

    monkeypatch.setattr("agents.reinforcement.callback.validate", slow)
    monkeypatch.setattr("agents.reinforcement.callback.perf_counter", lambda: perf_counter() + flown[0])
    train(configuration("PPO", scene_file), tmp_path)
    curve = [json.loads(line) for line in (tmp_path / "evaluations.jsonl").read_text().splitlines()]
    assert len(curve) > 1
    assert 0.0 < curve[-1]["seconds"] < 1e6


def test_a_run_whose_time_is_up_where_it_evaluates_does_so_once(scene_file, tmp_path, monkeypatch):
    over = property(lambda callback: callback.progress.environment_steps >= 1600)
    monkeypatch.setattr(TrainingCallback, "is_time_up", over)
    assert train(configuration("PPO", scene_file), tmp_path).model.num_timesteps * REPEAT == 1600
    curve = [json.loads(line) for line in (tmp_path / "evaluations.jsonl").read_text().splitlines()]
    assert [line["environment_steps"] for line in curve] == [1600]


@pytest.mark.parametrize(
    ("algorithm", "part", "changes", "sentence"),
    [
        ("PPO", "environment", {"action_repeat": STEPS + 1}, "action_repeat = 41: must be at most 40"),
        ("HER", "algorithm", {"learning_starts": 39}, "algorithm.learning_starts = 39: must be at least 40"),
        (
            "HER",
            "algorithm",
            {"learning_starts": 40, "buffer_size": 79},
            "algorithm.buffer_size = 79: must be at least 80, two",
        ),
    ],
)
def test_lengths_that_do_not_fit_the_scene_are_named(algorithm, part, changes, sentence, scene_file):
    content = configuration(algorithm, scene_file).model_dump(exclude_none=True)
    content[part] |= changes
    with pytest.raises(ConfigurationError, match=sentence):
        make_environment(load_configuration(content), load_scene(scene_file))


def test_wheels_are_scaled_where_the_scene_has_them(scene_file):
    content = configuration("PPO", scene_file).model_dump(exclude_none=True)
    content["environment"]["action_scale"] = {"base_force": 0.5, "wheel_torque": 0.25}
    checked = load_configuration(content)
    high = make_environment(checked, load_scene("wheels")).action_space.high
    assert high.min() == 0.25
    with pytest.raises(ConfigurationError, match=r"action_scale\.wheel_torque = 0\.25: must be left out"):
        make_environment(checked, load_scene(scene_file))


def test_the_same_seed_gives_the_same_agent(scene_file, tmp_path):
    runs = [train(configuration("PPO", scene_file, total_steps=800), tmp_path / name) for name in "ab"]
    other = train(configuration("PPO", scene_file, total_steps=800, seed=1), tmp_path / "c")
    first, second, third = (run.policy.weights[0] for run in (*runs, other))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - third).max() > 1e-3


def test_a_training_leaves_no_thread(scene_file, tmp_path):
    before = set(threading.enumerate())
    train(configuration("PPO", scene_file, total_steps=160), tmp_path)
    assert set(threading.enumerate()) <= before


def test_trainings_of_consecutive_seeds_begin_elsewhere(scene_file, tmp_path, monkeypatch):
    def begin(model, *others):
        starts.append(model.get_env().reset())
        raise RuntimeError("begun")

    starts = []
    monkeypatch.setattr("agents.reinforcement.reinforcement_training._learn", begin)
    for seed in (0, 1):
        with pytest.raises(RuntimeError, match="begun"):
            train(configuration("PPO", scene_file, seed=seed), tmp_path / str(seed))
    settings = configuration("PPO", scene_file)
    environment = make_environment(settings, load_scene(scene_file))
    environment.seed(0)
    np.testing.assert_array_equal(starts[0], environment.reset())
    assert not (starts[0][:, None] == starts[1][None]).all(axis=-1).any()


@pytest.mark.parametrize("algorithm", ["PPO", "HER"])
def test_models_folders_and_exports_fly_alike(algorithm, trained, scene_file):
    run = trained(algorithm)
    ways = [run.model, run.folder / "model.zip", run.policy, run.folder]
    costs = [evaluate(way, scene_file, 6, expert=False).flights.cost for way in ways]
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-5)
    np.testing.assert_allclose(costs[2], costs[0], rtol=1e-5)
    np.testing.assert_array_equal(costs[2], costs[3])


class Doubled(FlattenExtractor):
    """Observations that are not what they were."""

    def forward(self, observations):
        return 2.0 * super().forward(observations)


@pytest.mark.parametrize(
    ("kind", "policy", "options", "message"),
    [
        (PPO, "MlpPolicy", {"activation_fn": torch.nn.ELU}, "activations ELU"),
        (PPO, "MlpPolicy", {"features_extractor_class": Doubled}, "observations go through Doubled"),
        (RecurrentPPO, "MlpLstmPolicy", {}, "RecurrentActorCriticPolicy has a memory"),
    ],
)
def test_what_the_arrays_cannot_hold_is_not_exported(kind, policy, options, message):
    odd = kind(policy, DQSpaceArmVecEnv(2, PAPER), device="cpu", policy_kwargs=options)
    with pytest.raises(ValueError, match=message):
        export_policy(odd, {})


def test_a_plain_model_of_stable_baselines3_is_exported_and_evaluated(tmp_path):
    model = PPO("MlpPolicy", DQSpaceArmVecEnv(2, PAPER), device="cpu", seed=0)
    seen, joined = observations(model)
    expected = np.clip(model.predict(seen, deterministic=True)[0], -1.0, 1.0)
    np.testing.assert_allclose(export_policy(model, {})(joined), expected, rtol=0.0, atol=1e-6)
    model.save(tmp_path / "model.zip")
    np.testing.assert_allclose(as_policy(tmp_path / "model.zip").act(joined), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("squash", [False, True])
def test_actions_under_state_dependent_exploration_are_exported(squash):
    """Those that are squashed, too."""
    options = {"squash_output": squash}
    model = PPO(
        "MlpPolicy", DQSpaceArmVecEnv(2, PAPER), device="cpu", seed=0, use_sde=True, policy_kwargs=options
    )
    with torch.no_grad():
        model.policy.action_net.bias.fill_(0.5)
    seen, joined = observations(model)
    expected = model.predict(seen, deterministic=True)[0]
    np.testing.assert_allclose(export_policy(model, {})(joined), expected, rtol=0.0, atol=1e-6)


def test_the_command_trains_and_names_what_is_wrong(scene_file, tmp_path, capsys, monkeypatch):
    path, out = tmp_path / "ppo.yaml", str(tmp_path / "run")
    content = configuration("PPO", scene_file).model_dump(mode="json", exclude_none=True)
    path.write_text(json.dumps(content))  # JSON is YAML
    assert main(["train", "--config", str(path), "--out", out, "--total-steps", "800"]) == 0
    assert "800 of 800 steps" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        patched.setattr("agents.training.train", lambda *_, **__: pytest.fail("trained again"))
        assert main(["train", "--config", str(path), "--out", out, "--total-steps", "800"]) == 0
    assert "finished before" in capsys.readouterr().out
    assert main(["train", "pppo", "--out", out]) == 2
    assert "did you mean 'ppo'" in capsys.readouterr().err


@pytest.mark.parametrize(("algorithm", "rate"), [("PPO", 1e3), ("PPO", 1e18), ("TD3", 1e18)])
def test_a_training_that_diverges_ends_in_one_sentence(algorithm, rate, scene_file, tmp_path, monkeypatch):
    monkeypatch.setitem(ALGORITHMS, algorithm, {**ALGORITHMS[algorithm], "learning_rate": rate})
    with pytest.raises(DivergedError, match=r"diverged before step .*learning_rate below 1"):
        train(configuration(algorithm, scene_file), tmp_path)
    assert not (tmp_path / "policy.npz").exists()


def test_a_network_of_no_numbers_is_not_kept(scene_file, tmp_path, monkeypatch):
    """What was written before stays: one checkpoint, in which all weights are numbers."""
    learn = PPO.train

    def spoil(self):
        learn(self)
        if self.num_timesteps * REPEAT >= 2400:
            next(self.policy.mlp_extractor.value_net.parameters()).data.fill_(np.nan)

    monkeypatch.setattr(PPO, "train", spoil)
    checked = configuration("PPO", scene_file)
    with pytest.raises(DivergedError, match=r"the checkpoint at 1,600 is kept"):
        train(checked, tmp_path)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [f"{1600:012d}"]
    environment = make_environment(checked, load_scene(scene_file))
    checkpoint = RunFolder(tmp_path, checked).checkpoint()
    model = make_learner(checked, environment, blank=True)
    read_checkpoint(checkpoint, model)
    assert all(torch.isfinite(weights).all() for weights in model.policy.parameters())
