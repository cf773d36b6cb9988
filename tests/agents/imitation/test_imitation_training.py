"""A run by imitation, from a configuration to a policy: its folder, and that it may be killed."""

import io
import json

import numpy as np
import pytest
from rich.console import Console

torch = pytest.importorskip("torch")
pytest.importorskip("tensorboard")

import agents  # noqa: E402
from agents import ExportedPolicy  # noqa: E402
from agents.imitation.action_chunking import Chunks  # noqa: E402
from agents.imitation.trainer import TrainingAdvance  # noqa: E402
from agents.policies.chunking import load_exported  # noqa: E402
from agents.run_folder import RunFolderError, validate, validation_seeds  # noqa: E402
from agents.training import train  # noqa: E402
from dq_space_arm_env.command_line import main  # noqa: E402
from dq_space_arm_env.common.progress import ProgressDisplay  # noqa: E402

pytestmark = pytest.mark.agents

STEPS = {"batch_size": 64, "warm_up": 10}
CLONING = {"optimization": {"updates": 120, "learning_rate": 1e-2, **STEPS}, "validate_every": 40}
ALGORITHMS = {
    "cloning": {"name": "cloning", **CLONING},
    "act": {"name": "act", **CLONING, "chunk": 4, "spacing": 5, "width": 16, "layers": 1, "heads": 2},
    "dagger": {
        "name": "dagger",
        "cloning": CLONING,
        "rounds": 2,
        "episodes": 4,
        "labels": "gains",
        "optimization": {"updates": 30, "learning_rate": 1e-3, **STEPS},
    },
}


@pytest.fixture(scope="module")
def settings(demonstrations, small_file):
    def of(name, **changes):
        return {
            "name": name,
            "scene": str(small_file),
            "demonstrations": {"folder": str(demonstrations.path)},
            "network": {"hidden": [16, 16]},
            "algorithm": ALGORITHMS[name],
            "curve": {"every": 80, "episodes": 3},
            **changes,
        }

    return of


@pytest.fixture(scope="module")
def runs(settings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {name: train(settings(name), folder / name) for name in ALGORITHMS}


def curve(folder):
    lines = (folder / "evaluations.jsonl").read_text().splitlines()
    return [{**json.loads(line), "seconds": None} for line in lines]


def test_the_folder_says_what_was_done(runs, demonstrations):
    run = runs["cloning"]
    assert {path.name for path in run.folder.iterdir()} >= {"config.yaml", "provenance.json", "tensorboard"}
    assert agents.configuration.load_configuration(run.folder / "config.yaml").name == "cloning"
    assert [line["updates"] for line in curve(run.folder)] == [80, 120]
    policy = ExportedPolicy.load(run.folder / "policy.npz")
    found = validate(policy, demonstrations.scene, validation_seeds(3))
    assert found["median_cost"] == pytest.approx(curve(run.folder)[-1]["median_cost"], rel=1e-6)
    assert policy.metadata["configuration"]["algorithm"]["optimization"]["updates"] == 120
    assert policy.metadata["provenance"]["versions"]
    training = policy.metadata["training"]
    assert (training["environment_steps"], training["updates"]) == (0, 120)
    assert training["expert_solves"] == training["demonstrations"] == len(demonstrations)
    assert training["seconds"] > 0.0


def test_a_learning_curve_of_another_kind_is_refused_before_the_training(settings, tmp_path):
    """As one of reinforcement learning, whose lines have no updates."""
    line = '{"environment_steps": 40, "seconds": 1.0, "success_rate": 0.0, "median_cost": 2.0}\n'
    (tmp_path / "evaluations.jsonl").write_text(line)
    with pytest.raises(RunFolderError, match=r"jsonl is damaged .* lacks a number of .*, updates"):
        train(settings("cloning"), tmp_path)
    assert not list((tmp_path / "checkpoints").iterdir())


def test_corrections_go_on_where_cloning_ends(runs):
    run = runs["dagger"]
    lines = curve(run.folder)
    assert lines[:2] == curve(runs["cloning"].folder)
    assert [line["updates"] for line in lines] == [80, 120, 150, 180]
    assert [line["environment_steps"] for line in lines] == [0, 0, 600, 1200]
    training = ExportedPolicy.load(run.folder / "policy.npz").metadata["training"]
    assert (training["environment_steps"], training["updates"]) == (1200, 180)


@pytest.mark.parametrize("algorithm", ["cloning", "dagger"])
def test_the_exported_policy_acts_like_the_network(algorithm, runs, demonstrations):
    observations = np.concatenate([each.observations for each in demonstrations])
    expected = runs[algorithm].network.act(observations)
    policy = ExportedPolicy.load(runs[algorithm].folder / "policy.npz")
    np.testing.assert_allclose(policy(observations), expected, rtol=0.0, atol=1e-6)


def test_a_transformer_learns_chunks_that_fly(runs, demonstrations, small_file, capsys):
    run = runs["act"]
    lines = curve(run.folder)
    assert [line["updates"] for line in lines] == [80, 120]
    assert lines[-1]["validation_action"] < 0.6  # of the spread; 0.8 for the mean action
    observations = np.concatenate([each.observations for each in demonstrations])
    policy = load_exported(run.folder / "policy.npz")
    np.testing.assert_allclose(
        policy.chunks(observations), run.network.act(observations), rtol=0.0, atol=1e-6
    )
    found = validate(policy, demonstrations.scene, validation_seeds(3))
    assert found["median_cost"] == pytest.approx(lines[-1]["median_cost"], rel=1e-6)
    assert policy.metadata["configuration"]["algorithm"]["chunk"] == 4
    assert main(["simulate", str(small_file), "--policy", str(run.folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 150


def test_chunks_are_the_actions_that_follow(demonstrations):
    source = Chunks(demonstrations, 4, 50)
    (batch,) = source.batches(10**6, (), seed=1)
    assert batch.arrays["actions"].shape == (24 * 150, 4, demonstrations[0].actions.shape[1])
    assert len({*zip(batch.demonstration, batch.stage, strict=True)}) == 24 * 150
    for row in range(0, len(batch.stage), 97):
        shown, stage = demonstrations[int(batch.demonstration[row])], int(batch.stage[row])
        np.testing.assert_allclose(batch.arrays["observations"][row], shown.observations[stage], rtol=1e-6)
        # Behind the end, stage 149, the last action repeats.
        wanted = shown.actions[[min(stage + ahead, 149) for ahead in (0, 50, 100, 150)]]
        np.testing.assert_allclose(batch.arrays["actions"][row], wanted, rtol=1e-6)
    assert [len(each.stage) for each in source.batches(1700, (), seed=1)] == [1700, 1700, 200]


@pytest.mark.parametrize(("algorithm", "stop"), [("cloning", 100), ("act", 100), ("dagger", 150)])
def test_a_killed_run_ends_as_if_nothing_had_happened(algorithm, stop, runs, settings, tmp_path):
    done = []

    def interrupt(advance):
        if isinstance(advance, TrainingAdvance):
            done.append(advance.done)
            before = 120 if "round" in advance.part else 0
            if before + advance.done + 30 * (advance.part == "round 2") >= stop:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(settings(algorithm), tmp_path, report=interrupt)
    assert not (tmp_path / "policy.npz").exists()
    resumed = train(settings(algorithm), tmp_path)
    weights, expected = (each.network.state_dict() for each in (resumed, runs[algorithm]))
    assert all(torch.equal(weights[name], expected[name]) for name in expected)
    assert curve(tmp_path) == curve(runs[algorithm].folder)
    assert len(json.loads((tmp_path / "provenance.json").read_text())) == 2


def test_the_command_trains_and_refuses(settings, tmp_path, capsys):
    path = tmp_path / "small.yaml"
    content = settings("cloning", algorithm={"name": "cloning", "optimization": {"updates": 5, **STEPS}})
    path.write_text(json.dumps(content))  # JSON is YAML
    assert main(["train", "--config", str(path), "--out", str(tmp_path / "run"), "--seed", "3"]) == 0
    assert "policy.npz" in capsys.readouterr().out
    assert ExportedPolicy.load(tmp_path / "run" / "policy.npz").metadata["configuration"]["seed"] == 3
    assert main(["train", "--config", str(path), "--minutes", "3"]) == 2
    assert "--minutes is for reinforcement learning" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    path.write_text(json.dumps({**content, "demonstrations": {"folder": str(tmp_path / "empty")}}))
    assert main(["train", "--config", str(path), "--out", str(tmp_path / "other")]) == 1
    assert "holds no demonstrations" in capsys.readouterr().err


def test_a_terminal_shows_a_bar_and_a_file_the_first_and_last_line():
    stream = io.StringIO()
    with ProgressDisplay(Console(file=stream, width=200)) as progress:
        for done in range(0, 101, 10):
            progress.update(TrainingAdvance(100, done, 50.0, {}))
    lines = stream.getvalue().splitlines()
    assert [line.split(",")[0] for line in lines] == ["0 of 100 updates", "100 of 100 updates"]
    stream = io.StringIO()
    with ProgressDisplay(Console(file=stream, width=200, force_terminal=True)) as progress:
        progress.update(TrainingAdvance(100, 50, 50.0, {"action": 0.25}))
    assert "50 of 100 updates, action loss 2.50e-01" in stream.getvalue()
