"""The script that measures the expert: what it writes, how it ends."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.command_line import main
from dq_space_arm_env import Scene
from experts.report.command import INTERRUPTED, UNUSABLE
from experts.report.solvers import benchmark, command
from experts.report.solvers.effort import PARTS, QUICK, Effort
from experts.report.solvers.ours import GUIDED, TITLES
from experts.report.solvers.random_starts import RandomStart, StartSolve

SHORT = replace(QUICK, piece_repeats=1, horizons=(10,), compared_starts=0, starts=1)


def run(arguments: Sequence[str]) -> int:
    return main(["report", "expert", *arguments])


@pytest.fixture
def scene_file(spread_scene: Scene, tmp_path: Path) -> str:
    file = tmp_path / "short.yaml"
    file.write_text(spread_scene.to_yaml())
    return str(file)


def numbers(value: Any) -> Iterator[float | None]:
    """All numbers of a JSON value, and None where there is one."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)
    elif value is None or isinstance(value, float | int):
        yield value


def test_script_writes_record_and_picture(scene_file: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "deep" / "out"
    assert run(["--quick", "--scene", scene_file, "--out", str(out)]) == 0
    record = json.loads((out / "expert.json").read_text(encoding="utf-8"))
    assert record["interrupted"] is False
    assert [costs["integrator"] for costs in record["iterations"]] == ["symplectic_euler", "rk4"]
    comparisons = record["time_to_accuracy"]
    assert [(comparison["integrator"], comparison["start"]) for comparison in comparisons] == [
        ("symplectic_euler", "nominal start"),
        ("rk4", "nominal start"),
        ("rk4", "random start 0"),
    ]
    assert [solver["solver"] for solver in comparisons[2]["solvers"]] == [*TITLES.values(), GUIDED]
    (random_starts,) = record["random_starts"]
    assert len(random_starts["starts"]) == QUICK.starts
    assert len(random_starts["summaries"]) == 3
    assert len(record["receding_horizon"]) == 3
    assert record["machine"]["processor_name"]
    assert "crocoddyl" in record["versions"]
    for solver in (solver for comparison in comparisons for solver in comparison["solvers"]):
        assert len(solver["costs"]) == len(solver["seconds"]) == solver["iterations"] + 1
        del solver["seconds_to_gap"]  # None where it was not reached
    measured = ("iterations", "time_to_accuracy", "random_starts", "receding_horizon")
    assert None not in [number for part in measured for number in numbers(record[part])]
    assert (out / "expert.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("part", PARTS)
def test_parts_are_measured_alone(
    scene_file: str, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "QUICK", SHORT)
    arguments = ["--quick", "--part", part, "--scene", scene_file, "--out", str(tmp_path), "--no-picture"]
    assert run(arguments) == 0
    record = json.loads((tmp_path / "expert.json").read_text(encoding="utf-8"))
    measured = ("iterations", "time_to_accuracy", "random_starts", "receding_horizon")
    assert [bool(record[name]) for name in measured] == [name == part for name in PARTS]
    assert not (tmp_path / "expert.png").exists()


def test_an_interrupt_keeps_what_is_done(
    scene_file: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*arguments: Any) -> Iterator[RandomStart]:
        yield RandomStart(0, (StartSolve("made up", 100.0, 3, 1.0, True, True),), 100.0, True)
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmark, "solve_random_starts", interrupted)
    arguments = ["--quick", "--part", "starts", "--part", "horizon", "--scene", scene_file]
    assert run([*arguments, "--out", str(tmp_path)]) == INTERRUPTED
    record = json.loads((tmp_path / "expert.json").read_text(encoding="utf-8"))
    assert record["interrupted"] is True
    assert len(record["random_starts"][0]["starts"]) == 1
    assert record["receding_horizon"] == []
    output = capsys.readouterr().out
    assert "1 random start" in output
    assert "Interrupted" in output


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--scene", "papr"], "did you mean 'paper'?"),
        (["--starts", "0"], "--starts is 0; it must be at least 1"),
        (["--seed", "-1"], "--seed is -1"),
    ],
)
def test_unusable_input_is_one_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert run([*arguments, "--out", str(out)]) == UNUSABLE
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_a_scene_without_limits_is_refused_before_anything_is_measured(
    spread_scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "unlimited.yaml"
    actuators = {"base_torque": {"limit": float("inf")}}
    file.write_text(spread_scene.replace(actuators=actuators).to_yaml())
    assert run(["--quick", "--scene", str(file), "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "no finite limit" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_efforts_follow_the_options(monkeypatch: pytest.MonkeyPatch) -> None:
    def effort(*arguments: str) -> Effort:
        asked: list[Effort] = []
        monkeypatch.setattr(command, "run", lambda destination, effort, **_: asked.append(effort))
        assert run(arguments) == 0
        return asked[0]

    assert effort() == Effort()
    assert effort("--starts", "7", "--slow-peers", "--no-peers") == replace(
        Effort(), starts=7, slow_peers=True, peers=False
    )
    assert effort("--full").starts == 200
    assert not effort("--quick").peers
