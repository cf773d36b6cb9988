"""`compare cloning`: what it writes, that it resumes, and what follows from its numbers."""

import importlib.util
import json

import pytest

pytest.importorskip("torch")

from agents.evaluation.data_efficiency import LINES, points, saving
from agents.evaluation.data_efficiency_command import _verdict as verdict
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import UNUSABLE
from experts import generate_demonstrations, load_demonstrations
from experts.demonstrations import SerialExecutor

pytestmark = pytest.mark.agents


@pytest.fixture(scope="module")
def arguments(demonstrations, small_scene, small_file, tmp_path_factory):
    """Of the command, but for the output folder."""
    folder = tmp_path_factory.mktemp("given")
    generate_demonstrations(small_scene, 4, folder / "tests", 9, executor=SerialExecutor())
    configuration = {
        "name": "small",
        "scene": str(small_file),
        "network": {"hidden": [16]},
        "algorithm": {"name": "cloning", "optimization": {"batch_size": 64, "learning_rate": 1e-2}},
    }
    (folder / "small.yaml").write_text(json.dumps(configuration))  # JSON is YAML
    given = {
        "--config": folder / "small.yaml",
        "--demonstrations": demonstrations.path,
        "--test-demonstrations": folder / "tests",
        "--updates": 20,
        "--seeds": 1,
    }
    return [str(part) for pair in given.items() for part in pair]


@pytest.mark.endurance
def test_it_measures_draws_and_goes_on(arguments, tmp_path, capsys):
    command = [*arguments, "--out", str(tmp_path), "--counts", "8", "3"]
    assert main(["compare", "cloning", *command]) == 0
    said = capsys.readouterr()
    assert "20 updates, flights from 4 starts" in said.out
    assert "6 of 6, with gains, 8 demonstrations: cloning: 20 of 20 updates" in said.err
    record = json.loads((tmp_path / "cloning.json").read_text())
    found = [(each["variant"], each["count"]) for each in record["points"]]
    assert found == [(v, n) for v in ("actions", "augmentation", "gains") for n in (3, 8)]
    assert all(0.0 <= each["low"] <= each["success"] <= each["high"] <= 1.0 for each in record["points"])
    if importlib.util.find_spec("matplotlib") is not None:
        assert (tmp_path / "cloning.png").read_bytes().startswith(b"\x89PNG")
    # Killed after the fourth training, it makes the rest anew, and the same.
    whole = (tmp_path / LINES).read_text().splitlines()
    assert len(whole) == 1 + 6
    (tmp_path / LINES).write_text("".join(line + "\n" for line in whole[:5]))
    assert main(["compare", "cloning", *command, "--no-picture"]) == 0
    again = (tmp_path / LINES).read_text().splitlines()
    assert again[:5] == whole[:5]
    for one, other in zip(again[5:], whole[5:], strict=True):
        assert {**json.loads(one), "seconds": 0} == {**json.loads(other), "seconds": 0}
    # Asked for less, it tells of that alone, and keeps the rest.
    assert main(["compare", "cloning", *command[:-1], "--no-picture"]) == 0
    assert {each["count"] for each in json.loads((tmp_path / "cloning.json").read_text())["points"]} == {8}
    assert (tmp_path / LINES).read_text().splitlines() == again


@pytest.mark.endurance
def test_each_seed_draws_its_own_demonstrations(arguments, tmp_path):
    own = [*arguments[:2], *arguments[4:-1], "2", "--counts", "3", "--out", str(tmp_path), "--no-picture"]
    assert main(["compare", "cloning", *own]) == 0
    first, second = (load_demonstrations(tmp_path / name) for name in ("demonstrations", "demonstrations-1"))
    assert [each.settings["seed"] for each in (first, second)] == [0, 1]
    assert not set(first.column("seed").tolist()) & set(second.column("seed").tolist())
    (row, *_) = json.loads((tmp_path / "cloning.json").read_text())["points"]
    assert (row["trainings"], row["count"]) == (2, 3)


@pytest.mark.slow
def test_what_cannot_be_measured_is_refused(arguments, demonstrations, tmp_path, capsys):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / LINES).write_text('{"updates": 7}\n')
    refused = (
        (["--counts", "100"], "100 demonstrations are requested, there are 24"),
        (["--config", "ppo"], "configuration 'ppo' clones no single actions: use cloning-with-gains"),
        (["--config", "act"], "configuration 'act' clones no single actions: use cloning-with-gains"),
        (["--test-demonstrations", str(demonstrations.path), "--counts", "3"], "share starts"),
        (["--out", str(tmp_path / "other"), "--counts", "3"], "is of another measurement"),
    )
    for changes, sentence in refused:
        assert main(["compare", "cloning", *arguments, "--out", str(tmp_path), *changes]) == UNUSABLE
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("option", ["counts", "seeds", "updates", "tests"])
def test_numbers_are_checked_before_demonstrations_are_generated(option, tmp_path, capsys):
    assert main(["compare", "cloning", f"--{option}", "0", "--out", str(tmp_path / "out")]) == UNUSABLE
    assert f"--{option}: 0, should be at least 1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_generated_demonstrations_may_be_a_few_less_than_asked_for(
    arguments, demonstrations, tmp_path, monkeypatch
):
    """One problem of 25 fails with one seed, and two with the other."""
    command, asked = "agents.evaluation.data_efficiency_command", []

    def prepare(source, scene, folder, progress):
        return demonstrations[: {"demonstrations": 24, "demonstrations-1": 23, "tests": 4}[folder.name]]

    def measure(configuration, effort, pools, tests, folder, progress):
        asked.append((effort.counts, [len(pool) for pool in pools]))
        return []

    monkeypatch.setattr(f"{command}.prepare_demonstrations", prepare)
    monkeypatch.setattr("agents.evaluation.data_efficiency.measure", measure)
    own = [*arguments[:2], "--seeds", "2", "--out", str(tmp_path), "--no-picture"]
    assert main(["compare", "cloning", *own, "--counts", "5", "24", "25"]) == 0
    assert asked == [((5, 23), [24, 23])]


def training(variant, count, seed, successes):
    named = {"variant": variant, "count": count, "seed": seed}
    reached = [int(flight < successes) for flight in range(100)]
    return {**named, "successes": reached, "gap": 0.1 * (seed + 1), "seconds": 2.0}


def test_points_put_seeds_together():
    given = [training("gains", 10, 0, 60), training("gains", 10, 1, 80), training("actions", 10, 0, 5)]
    plain, gains = points(given)
    assert (plain["variant"], plain["success"], plain["trainings"]) == ("actions", 0.05, 1)
    assert [gains[name] for name in ("success", "least", "most", "trainings")] == [0.7, 0.6, 0.8, 2]
    assert gains["low"] < 0.7 < gains["high"]
    assert gains["gap"] == pytest.approx(0.15)


def point(variant, count, success):
    return {"variant": variant, "count": count, "success": success}


def test_the_saving_is_counted_at_equal_success():
    plain = [point("actions", 10, 0.1), point("actions", 100, 0.4), point("actions", 1000, 0.5)]
    found = saving([*plain, point("gains", 10, 0.4), point("gains", 100, 0.45)], "gains")
    assert (found.point["count"], found.needed, found.ratio) == (10, 100, 10.0)
    # Better than plain cloning ever is: it would take more than the most.
    found = saving([*plain, point("gains", 20, 0.55), point("gains", 100, 0.9)], "gains")
    assert (found.point["count"], found.needed, found.ratio) == (20, None, 50.0)
    assert saving([*plain, point("gains", 1000, 0.4)], "gains") is None
    assert saving([point("gains", 10, 0.5)], "gains") is None


def test_a_bound_is_said_to_be_one():
    plain = [point("actions", 10, 0.1), point("actions", 1000, 0.5)]
    *_, last = verdict([*plain, point("gains", 20, 0.55), point("augmentation", 15, 0.1)])
    assert last.endswith("actions alone need more than 1000, more than 50 times as many.")
