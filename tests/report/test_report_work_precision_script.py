"""The script that measures error against run time: what it writes, how it ends."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.command_line import main
from dq_space_arm_env.integrators import INTEGRATORS
from experts.report.command import INACCURATE, INTERRUPTED, UNUSABLE
from experts.report.work_precision import benchmark, command
from experts.report.work_precision.effort import QUICK


@pytest.fixture(autouse=True)
def little(monkeypatch: pytest.MonkeyPatch) -> None:
    timing = replace(QUICK.timing, repeats=1)
    quick = replace(QUICK, duration=1.0, most_steps=400, states=2, timing=timing)
    monkeypatch.setattr(command, "QUICK", quick)


def run(arguments: Sequence[str]) -> int:
    return main(["report", "work-precision", *arguments])


def numbers(value: Any) -> Iterator[float | None]:
    """All numbers of a JSON value, and None where there is one."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)
    elif value is None or isinstance(value, float | int):
        yield value


@pytest.mark.slow
def test_script_writes_record_and_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "deep" / "out"
    arguments = ["--quick", "--case", "body", "--case", "maneuver", "--case", "formulations"]
    names = ["rk4", "paper_projected"]
    for name in names:
        arguments += ["--integrator", name]
    assert run([*arguments, "--out", str(out)]) == 0
    record = json.loads((out / "work_precision.json").read_text(encoding="utf-8"))
    body, maneuver = record["cases"]
    assert [method["method"] for method in body["methods"]] == ["rk4"]
    assert [method["method"] for method in maneuver["methods"]] == names
    assert [choice["error"] for choice in body["cheapest"]] == [1e-3, 1e-6, 1e-9]
    assert body["default"]["method"] == maneuver["default"]["method"] == "rk4"
    for case in record["cases"]:
        for method in case["methods"]:
            errors = [point["tip_position_error_m"] for point in method["points"]]
            assert errors[0] > errors[-1]
            for each in method["points"]:
                assert each.pop("tolerance") is None
                assert None not in list(numbers(each))
    assert None not in list(numbers(record["formulations"]))
    assert record["shortcomings"] == []
    assert record["machine"]["processor_name"]
    assert record["versions"]["scipy"]
    assert (out / "work_precision.png").read_bytes().startswith(b"\x89PNG")


def test_every_integrator_is_an_option(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(command, "run", lambda destination, *, integrators, **_: asked.append(integrators))
    for name in INTEGRATORS:
        assert run(["--integrator", name]) == 0
    assert asked == [(name,) for name in INTEGRATORS]


@pytest.mark.slow
def test_what_is_less_accurate_than_declared_fails(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(benchmark, "LIMITS", {"float64": 1e-30, "float32": 1.0})
    arguments = ["--quick", "--case", "formulations", "--out", str(tmp_path), "--no-picture"]
    assert run(arguments) == INACCURATE
    assert "minimal coordinates in float64: relative error" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "work_precision.json").read_text())["shortcomings"]) == 5
    assert not (tmp_path / "work_precision.png").exists()


def test_an_interrupt_and_a_missing_package_end_in_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    arguments = ["--quick", "--case", "formulations", "--out", str(tmp_path)]
    monkeypatch.setattr(benchmark, "measure_formulations", interrupted)
    assert run(arguments) == INTERRUPTED
    assert "nothing is saved" in capsys.readouterr().err
    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)
    assert run(arguments) == UNUSABLE
    assert 'pip install "dq-space-arm[test]"' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
