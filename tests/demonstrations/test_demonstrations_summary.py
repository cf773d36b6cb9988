"""The summary of a data set: the page shows its numbers and failures, and the card follows from the data."""

import json
import math
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.environment.rollouts import Rollout
from experts import generate_demonstrations, load_demonstrations
from experts.command_line.recorded_demonstrations import read_demonstration
from experts.demonstrations import Demonstrations, SerialExecutor, shard
from experts.demonstrations import facts as tables
from experts.demonstrations.data_card import MEANINGS, data_card
from experts.demonstrations.facts import Facts, gather, read_log
from experts.demonstrations.shard import PARAMETERS, SUMMARIES, TRAJECTORIES
from experts.problems.shooting_problem import FloatArray
from experts.report.data_set_summary import sections, shortcomings, write_summary


@pytest.fixture(scope="module")
def facts(whole: Demonstrations) -> Facts:
    return gather(whole)


@pytest.fixture
def failing(quick_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Demonstrations:
    """Some of four problems fail, the others do not."""
    honest = shard.replay

    def strict(scene: Scene, seeds: list[int], actions: FloatArray) -> Rollout:
        episodes = honest(scene, seeds, actions)
        episodes.is_success[episodes.cost >= 40.0] = False
        return episodes

    monkeypatch.setattr(shard, "replay", strict)
    made = generate_demonstrations(quick_scene, 4, tmp_path / "data", shard_size=2, executor=SerialExecutor())
    assert made is not None
    assert 0 < len(made) < 4
    return made


def test_quantities_are_those_of_the_data(facts: Facts, whole: Demonstrations):
    cost = facts.quantity("cost J").values
    np.testing.assert_array_equal(cost, [demonstration.cost for demonstration in whole])
    attitude, start = (
        facts.quantity("attitude error at the end"),
        facts.quantity("position error at the start"),
    )
    np.testing.assert_array_equal(attitude.values, whole.column("final_errors")[:, 0])
    np.testing.assert_array_equal(start.values, whole.column("start_errors")[:, 1])
    assert attitude.bound == 3.0
    assert facts.quantity("clamped share").values.max() == 100.0 * whole.column("clamped_share").max()
    assert facts.replayed == 18
    assert facts.return_gap < 1e-12
    assert shortcomings(facts) == []
    rows = {row[0]: row[1:] for row in tables.distributions(facts).rows}
    assert rows["cost J"][0] == tables.number(cost.min())
    assert rows["cost J"][2] == tables.number(float(np.median(cost)))
    assert rows["attitude error at the end [°]"][-1] == "3"
    assert sum(int(row[1]) for row in tables.guesses(facts).rows) == 18
    assert sum(int(row[1]) for row in tables.ends(facts).rows) == 18


def test_numbers_have_three_digits_or_all_before_the_point():
    values = (0.0123456, 12.3456, 999.4, 999.6, 1000.4, 123456.7, 2e6)
    shown = ["0.0123", "12.3", "999", "1000", "1000", "123457", "2e+06"]
    assert [tables.number(value) for value in values] == shown
    assert tables.number(-999.6) == "-1000"


def test_the_log_counts_each_shard_once(folder: Path):
    log = next((folder / "log").glob("*.jsonl"))
    first, *lines = log.read_text().splitlines()
    run = {**json.loads(first), "host": "another"}
    again = {**json.loads(lines[0]), "host": "another", "solve_seconds": [2.0] * 4}
    again["seconds"] = {"solves": 8.0}
    log.write_text("\n".join([first, *lines, json.dumps(run), json.dumps(again), lines[1][:30]]))
    found = gather(load_demonstrations(folder)).log
    assert found.shards == 5
    processor = run["run"]["machine"]["processor_name"]
    assert len(found.machines) == 2
    assert f"another ({processor})" in found.machines
    assert found.solve_seconds[:4].tolist() == [2.0] * 4
    assert len(found.solve_seconds) == 18
    rest = sum(json.loads(line)["seconds"]["solves"] for line in lines[1:])
    assert found.seconds["solves"] == pytest.approx(8.0 + rest)


@pytest.mark.parametrize(
    ("seconds", "solves"), [({}, []), ({"solves": 0.0}, [0.0]), ({"solves": 1.0}, [math.nan])]
)
def test_a_log_without_times_is_none(folder: Path, seconds: dict[str, float], solves: list[float]):
    log = next((folder / "log").glob("*.jsonl"))
    entry = {"shard": 0, "host": "host", "seconds": seconds, "solve_seconds": solves}
    log.write_text(json.dumps(entry))
    assert read_log(load_demonstrations(folder)).shards == 0


@pytest.mark.slow
def test_without_a_log_times_are_not_known(folder: Path):
    shutil.rmtree(folder / "log")
    solves = sections(gather(load_demonstrations(folder)))[1]
    assert solves.notes == ["Times are unknown: the folder has no log."]


@pytest.mark.slow
def test_the_page_holds_numbers_and_pictures(folder: Path):
    pytest.importorskip("matplotlib")
    files = write_summary(load_demonstrations(folder))
    assert sorted(path.relative_to(folder).as_posix() for path in files) == [
        "README.md",
        "summary/distributions.png",
        "summary/samples.png",
        "summary/summary.html",
        "summary/summary.md",
    ]
    html, text = (
        (folder / "summary" / f"summary.{kind}").read_text(encoding="utf-8") for kind in ("html", "md")
    )
    facts = gather(load_demonstrations(folder))
    for page in (html, text):
        assert "Demonstrations of scene quick" in page
        assert "All 18 problems are demonstrations" in page
        assert tables.number(float(np.median(facts.quantity("cost J").values))) in page
        assert "What failed" not in page
    assert html.count("data:image/png;base64,") == 2
    for name in ("distributions.png", "samples.png"):
        assert f"({name})" in text
        assert (folder / "summary" / name).read_bytes().startswith(b"\x89PNG")
    assert len(load_demonstrations(folder, verify=True)) == 18


@pytest.mark.slow
def test_failures_are_shown_with_their_reasons(failing: Demonstrations):
    count = len(failing.failures()["index"])
    facts = gather(failing)
    write_summary(failing)
    page = (failing.path / "summary" / "summary.md").read_text(encoding="utf-8")
    sentence = f"{count} of 4 problems failed ({count} replay_differs)."
    assert f"**Not all is well: {sentence}**" in page.split("## ")[0]
    assert "## What failed" in page
    for seed in failing.failures()["seed"].tolist():
        assert f"| {seed} | replay_differs |" in page
    assert len(facts.failures["start_errors"]) == count
    assert f"{count} of 4 problems did not ({count} replay_differs)" in data_card(facts)


def test_errors_of_failed_starts_are_those_at_a_reset(failing: Demonstrations):
    from dq_space_arm_env import DQSpaceArmEnv

    environment, facts = DQSpaceArmEnv(failing.scene), gather(failing)
    for seed, errors in zip(facts.failures["seed"].tolist(), facts.failures["start_errors"], strict=True):
        _, info = environment.reset(seed=seed)
        assert errors == pytest.approx([info["attitude_error"], info["position_error"]], rel=1e-9)


def test_a_data_set_without_demonstrations_has_a_page_and_no_flight(
    quick_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shard, "REPLAY_TOLERANCE", -1.0)
    made = generate_demonstrations(quick_scene, 2, tmp_path, shard_size=2, executor=SerialExecutor())
    assert made is not None
    files = write_summary(made)
    assert not [path for path in files if path.suffix == ".png"]
    page = (tmp_path / "summary" / "summary.html").read_text(encoding="utf-8")
    assert "There are no demonstrations: all 2 problems failed." in page
    assert "There are no demonstrations." in (tmp_path / "README.md").read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="holds no demonstration: all of its problems failed"):
        read_demonstration(str(tmp_path), None)


def test_what_should_not_be_stands_at_the_top(facts: Facts):
    far = replace(facts.quantity("position error at the end"), values=np.array([0.05, 0.2]))
    found = shortcomings(replace(facts, return_gap=1e-3, quantities=(far,)))
    assert found == [
        "A return differs from -J by a relative 1.0e-03.",
        "The position error at the end of a demonstration exceeds 0.1 m.",
    ]


def test_the_card_follows_from_the_data_alone(facts: Facts, folder: Path):
    card = data_card(facts)
    shutil.rmtree(folder / "log")
    assert data_card(gather(load_demonstrations(folder))) == card
    assert card.startswith("---\npretty_name: ")
    assert "$" not in card
    assert set(MEANINGS) == {*TRAJECTORIES, *SUMMARIES, PARAMETERS}
    assert "parameters" not in card
    assert facts.demonstrations.settings["source"] in card
    assert "| `feedback_gains` | (150, 6, 12) |" in card


def test_the_card_names_every_tolerance(facts: Facts, monkeypatch: pytest.MonkeyPatch):
    assert "(3 deg, 0.1 m), and its actions" in data_card(facts)
    monkeypatch.setattr(facts.demonstrations, "scene", load_scene("capture-and-detumble"))
    assert "(10 deg, 0.2 m, 0.2 deg/s, 0.005 m/s), has caught the payload, and its" in data_card(facts)


def test_what_the_card_tells_to_do_works(
    facts: Facts, whole: Demonstrations, monkeypatch: pytest.MonkeyPatch
):
    blocks = re.findall(r"```python\n(.*?)```", data_card(facts), re.DOTALL)
    assert len(blocks) == 1
    monkeypatch.chdir(whole.path)
    names: dict[str, object] = {}
    exec(blocks[0], names)
    assert names["batch"].arrays["feedback_gains"].shape == (256, 6, 12)
    assert names["deviations"].shape == (1, 12)


def run(arguments: Sequence[str]) -> int:
    return main(["demonstrations", "generate", *arguments])


@pytest.mark.slow
def test_the_script_writes_it_unless_told_not_to(quick_scene: Scene, tmp_path: Path):
    quick_scene.to_yaml(tmp_path / "quick.yaml")
    arguments = [
        "--scene",
        str(tmp_path / "quick.yaml"),
        "-n",
        "2",
        "--workers",
        "1",
        "--out",
        str(tmp_path / "data"),
    ]
    assert run([*arguments, "--no-summary"]) == 0
    assert not (tmp_path / "data" / "summary").exists()
    assert run(arguments) == 0
    assert (tmp_path / "data" / "summary" / "summary.html").is_file()
    assert (tmp_path / "data" / "README.md").is_file()
