"""Seeds side by side: what single trainings give, resumed after kills, none lost to another's failure."""

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("threadpoolctl")

from agents import train
from agents.configuration import AgentConfiguration, ConfigurationError, load_configuration
from agents.experiments import training_task as training_task_module
from agents.experiments.many_trainings import (
    Overview,
    seed_summaries,
    train_seeds,
    training_executor,
    training_task,
)
from agents.experiments.shared_demonstrations import SharedDemonstrations, _link
from agents.experiments.training_task import PROGRESS
from agents.policies import ExportedPolicy
from agents.run_folder import DivergedError, learned
from agents.training import is_trained
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common import worker_process
from dq_space_arm_env.common.console import FAILURE, SUCCESS, UNUSABLE
from dq_space_arm_env.common.progress import Status
from experts.demonstrations import SerialExecutor
from experts.executors import ProcessExecutor

pytestmark = pytest.mark.agents


def weights(folder: Path) -> list[np.ndarray]:
    return list(ExportedPolicy.load(folder / "policy.npz").weights)


@pytest.mark.slow
def test_runs_are_those_of_single_trainings_and_finished_ones_are_kept(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[Status] = []
    rows = train_seeds([configuration], 2, tmp_path / "all", first=3, report=lines.append)
    assert [(row["agent"], row["seed"], row["outcome"]) for row in rows] == [
        ("quick", 3, "trained"),
        ("quick", 4, "trained"),
    ]
    for row in rows:
        alone = train(configuration.model_copy(update={"seed": row["seed"]}), tmp_path / str(row["seed"]))
        for one, other in zip(alone.policy.weights, weights(Path(row["folder"])), strict=True):
            np.testing.assert_array_equal(one, other)
        last = learned(alone.folder)[-1]
        assert {name: last[name] for name in ("success_rate", "median_cost", "environment_steps")} == {
            name: row[name] for name in ("success_rate", "median_cost", "environment_steps")
        }
    assert lines[-1].line == "2 of 2 trainings, 100%"

    def refuse(*arguments, **options):
        raise AssertionError("is trained already")

    monkeypatch.setattr(training_task_module, "train", refuse)
    again = train_seeds([configuration], 2, tmp_path / "all", first=3, executor=SerialExecutor())
    assert again == rows


def test_one_failure_is_a_row_and_the_others_are_trained(
    configuration_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    real = train

    def diverge(configuration, folder, report):
        if configuration.seed == 1:
            raise DivergedError("training diverged: the network yields NaN")
        if configuration.seed == 2:
            raise ZeroDivisionError("a bug")
        return real(configuration, folder, report=report)

    monkeypatch.setattr(training_task_module, "train", diverge)
    command = ["train", str(configuration_file), "--seeds", "4", "--out", str(tmp_path / "runs")]
    assert main([*command, "--workers", "1"]) == FAILURE
    captured = capsys.readouterr()
    assert "Failed: quick, seed 1: training diverged: the network yields NaN" in captured.err
    assert "Failed: quick, seed 2: ZeroDivisionError: a bug" in captured.err
    runs = json.loads((tmp_path / "runs" / "runs.json").read_text())
    assert [row["outcome"] for row in runs["runs"]] == ["trained", "failed", "failed", "trained"]
    assert "diverge" in runs["runs"][2]["traceback"]
    assert runs["seeds"][0]["seeds"] == 2
    monkeypatch.undo()
    assert main([*command, "--workers", "1", "--json"]) == SUCCESS
    document = json.loads(capsys.readouterr().out)
    assert [row["outcome"] for row in document["runs"]] == 4 * ["trained"]
    assert [row for row in document["runs"] if row["seed"] in (0, 3)] == [
        row for row in runs["runs"] if row["seed"] in (0, 3)
    ]


def test_runs_are_written_where_nothing_can_be_printed(
    configuration_file: Path, tmp_path: Path, fill_output: Callable[[], None]
) -> None:
    fill_output()
    words = [str(configuration_file), "--seeds", "1", "--workers", "1", "--out", str(tmp_path / "runs")]
    assert main(["train", *words]) == FAILURE
    assert len(json.loads((tmp_path / "runs" / "runs.json").read_text())["runs"]) == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux")
def test_a_killed_process_resumes_its_training_to_the_bit(settings: dict, tmp_path: Path) -> None:
    long = load_configuration(settings | {"algorithm": settings["algorithm"] | {"updates": 400}})
    whole = train(long, tmp_path / "whole")
    killed: list[int] = []

    def kill() -> None:
        while not list((tmp_path / "runs" / "quick-0" / "checkpoints").glob("0*20")):
            time.sleep(0.01)
        children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
        for pid in map(int, children):
            if b"worker_process" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    killer = threading.Thread(target=kill)
    killer.start()
    (row,) = train_seeds([long], 1, tmp_path / "runs", executor=ProcessExecutor(1))
    killer.join()
    assert killed
    assert row["outcome"] == "trained"
    assert len(json.loads((Path(row["folder"]) / "provenance.json").read_text())) == 2
    for one, other in zip(whole.policy.weights, weights(Path(row["folder"])), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_training_whose_processes_end_again_and_again_is_a_failed_row(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "BEGIN", "import os, sys; sys.stdin.buffer.read(1); os._exit(1)")
    rows = train_seeds([configuration], 2, tmp_path, executor=ProcessExecutor(2))
    assert [row["outcome"] for row in rows] == ["failed", "failed"]
    assert rows[1]["failure"] == (
        "4 processes in a row ended without finishing quick, seed 1, perhaps out of memory: use fewer than 2 "
        "workers"
    )


def test_a_missing_extra_ends_all_with_its_sentence(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(*arguments: object, **options: object) -> None:
        raise ImportError('training needs torch: pip install "dq-space-arm[agents]"')

    monkeypatch.setattr("agents.experiments.training_task.train", train)
    with pytest.raises(ImportError, match=r"training needs torch: pip install"):
        train_seeds([configuration], 2, tmp_path, executor=SerialExecutor())


def test_a_machine_without_the_folder_says_so(configuration: AgentConfiguration, tmp_path: Path) -> None:
    row = training_task(configuration, tmp_path / "nowhere").run()
    assert row["outcome"] == "failed"
    assert "trainings on a cluster need a file system that all of its machines share" in row["failure"]


def test_a_file_in_the_place_of_a_run_folder_stops_no_other_training(
    configuration: AgentConfiguration, tmp_path: Path
) -> None:
    (tmp_path / "quick-0").touch()
    rows = train_seeds([configuration], 2, tmp_path, executor=SerialExecutor())
    assert [row["outcome"] for row in rows] == ["failed", "trained"]
    assert "quick-0 is a file, it should be a folder" in rows[0]["failure"]


def test_a_policy_of_another_configuration_is_not_taken_for_this_training(
    configuration: AgentConfiguration, tmp_path: Path
) -> None:
    train_seeds([configuration], 1, tmp_path, executor=SerialExecutor())
    task = training_task(configuration, tmp_path)
    assert is_trained(configuration, task.folder)
    assert is_trained(configuration.model_copy(update={"description": "same"}), task.folder)
    network = configuration.network.model_copy(update={"hidden": (9,)})
    wider = configuration.model_copy(update={"network": network})
    (task.folder / "evaluations.jsonl").unlink()
    assert "evaluations.jsonl is missing" in task.run()["failure"]
    assert not is_trained(wider, task.folder)
    row = task._replace(configuration=wider).run()
    assert row["outcome"] == "failed"
    assert "was started with another configuration: network.hidden" in row["failure"]


@pytest.mark.slow
@pytest.mark.agents
def test_a_clone_is_trained_once(small_file: Path, tmp_path: Path) -> None:
    """Its folder has the seed of its demonstrations, which the configuration leaves to the run."""
    pytest.importorskip("torch")
    content = {"name": "clone", "scene": str(small_file), "demonstrations": {"problems": 4}}
    algorithm = {"name": "cloning", "optimization": {"updates": 3, "batch_size": 4}, "validate_every": 3}
    task = training_task(load_configuration({**content, "algorithm": algorithm}), tmp_path)
    task.folder.mkdir()
    row = task.run()
    assert row["outcome"] == "trained", row["failure"]
    assert is_trained(task.configuration, task.folder)


def test_progress_is_that_of_all(configuration: AgentConfiguration, tmp_path: Path) -> None:
    overview, task = Overview(4), training_task(configuration, tmp_path)
    assert overview.status().line == "0 of 4 trainings, 0%"
    overview.begin(task)
    assert overview.status().line == "0 of 4 trainings, 0%; quick, seed 0: not begun"
    task.folder.mkdir()
    (task.folder / PROGRESS).write_text(json.dumps({"done": 30, "total": 60, "line": "half of it"}))
    done, total, line = overview.status()
    assert done / total == 0.125
    assert line.startswith("0 of 4 trainings, 12%, about ")
    assert line.endswith(" left; quick, seed 0: half of it")
    overview.end({"folder": str(task.folder), "outcome": "failed"})
    assert "1 of 4 trainings, 25%, 1 failed" in overview.status().line


def test_the_time_left_does_not_count_what_earlier_calls_have_done(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One training of four was finished before, another came half way; an eighth of all took ten seconds."""
    clock = [0.0]
    monkeypatch.setattr("agents.experiments.many_trainings.perf_counter", lambda: clock[0])
    finished, begun = (
        training_task(configuration.model_copy(update={"seed": seed}), tmp_path) for seed in (0, 1)
    )
    finished.folder.mkdir()
    assert finished.run()["outcome"] == "trained"
    begun.folder.mkdir()
    progress = begun.folder / PROGRESS
    progress.write_text(json.dumps({"done": 30, "total": 60, "line": ""}))
    overview = Overview(4)
    overview.begin(finished)
    overview.end({"folder": str(finished.folder), "outcome": "trained"})
    overview.begin(begun)
    clock[0] = 10.0
    assert "left" not in overview.status().line  # nothing is done in this call
    progress.write_text(json.dumps({"done": 60, "total": 60, "line": ""}))
    assert "50%, about 0:00:40 left" in overview.status().line


def test_seeds_are_summarized_without_failures() -> None:
    rows = [
        {"agent": "a", "outcome": "trained", "success_rate": rate, "median_cost": cost, "seconds": 2.0}
        for rate, cost in ((0.5, 100.0), (1.0, 300.0), (0.9, 200.0), (0.8, 1e6))
    ]
    failed = {"agent": "a", "outcome": "failed", "success_rate": None, "median_cost": None, "seconds": None}
    (summary,) = seed_summaries([*rows, failed, {**rows[0], "agent": "b"}])
    assert summary["seeds"] == 4
    assert summary["success_rate"] == pytest.approx(0.8)
    assert (summary["lowest"], summary["highest"]) == (0.5, 1.0)
    assert summary["median_cost"] == 250.0  # without the lowest and the highest quarter


def test_demonstrations_are_generated_once_and_linked(
    small_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"name": "clone", "scene": str(small_file), "demonstrations": {"problems": 2, "seed": 0}}
    configuration = load_configuration({**settings, "algorithm": {"name": "cloning"}})
    other = load_configuration(
        {**settings, "name": "few", "demonstrations": {"problems": 1}, "algorithm": {"name": "cloning"}}
    )
    reports: list[Status] = []
    shared = SharedDemonstrations(SerialExecutor(), reports.append)
    for each in (configuration, configuration.model_copy(update={"seed": 1}), other):
        shared.provided(training_task(each, tmp_path))
    (first,), (second,), (third,) = (
        list((tmp_path / name / "demonstrations" / "shards").iterdir())
        for name in ("clone-0", "clone-1", "few-0")
    )
    assert first.samefile(second)
    assert first.name != third.name
    assert not (tmp_path / "clone-0" / "demonstrations" / "manifest.json").samefile(
        tmp_path / "clone-1" / "demonstrations" / "manifest.json"
    )

    def fail(source: Path, target: Path) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("agents.experiments.shared_demonstrations._link", fail)
    alone = training_task(configuration.model_copy(update={"seed": 2}), tmp_path)
    assert shared.provided(alone) is alone  # its training says what is wrong, if it still is
    assert not list(alone.folder.iterdir())


def test_two_runs_may_link_the_same_demonstrations_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    source.mkdir()
    (source / "manifest.json").write_text("{}")
    copy = shutil.copytree

    def copy_as_another_does(here: Path, there: Path, **options: Any) -> None:
        copy(here, there, **options)
        copy(here, target)

    monkeypatch.setattr("agents.experiments.shared_demonstrations.shutil.copytree", copy_as_another_does)
    _link(source, target)
    assert {path.name for path in tmp_path.iterdir()} == {"source", "target"}


def test_threads_count_in_the_number_of_processes(
    configuration: AgentConfiguration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.experiments.many_trainings.processors", lambda: 8)
    threaded = configuration.model_copy(update={"threads": 3})
    assert training_executor([configuration]).workers == 8
    assert training_executor([configuration, threaded]).workers == 2
    assert training_executor([threaded], 5).workers == 5


def test_two_configurations_of_one_name_are_refused(
    configuration: AgentConfiguration, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match="two configurations are named 'quick'"):
        train_seeds([configuration, configuration], 1, tmp_path)
    with pytest.raises(ConfigurationError, match="seeds: 0, should be a whole number"):
        train_seeds([configuration], 0, tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["apg", "--workers", "2"], "--workers and --ray are for several runs: give --seeds"),
        (["apg", "--seeds", "2", "--workers", "2", "--ray"], "--workers and --ray exclude each other"),
        (["apg", "--seeds", "2", "--workers", "0"], "workers: 0, should be at least 1"),
        (["apg", "--config", "apg"], "two configurations are named 'apg'"),
        (["apg", "apgg", "--seeds", "2"], "no configuration is named 'apgg'; did you mean 'apg'?"),
        (["apg", "--seeds", "two"], "'two' is not a valid integer"),
    ],
)
def test_wrong_options_end_with_a_sentence(
    options: list[str], message: str, capsys: pytest.CaptureFixture
) -> None:
    assert main(["train", *options]) == UNUSABLE
    assert message in capsys.readouterr().err
