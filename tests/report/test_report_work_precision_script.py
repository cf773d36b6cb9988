"""The script that measures error against run time: what it writes, how it ends."""

import importlib.util
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from dq_space_arm_env.integrators import INTEGRATORS
from experts.report.command import INACCURATE, INTERRUPTED, UNUSABLE
from experts.report.work_precision import benchmark
from experts.report.work_precision.effort import QUICK

SCRIPT = Path(__file__).parents[2] / "scripts" / "work_precision.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("work_precision", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    timing = replace(QUICK.timing, repeats=1)
    module.__dict__["QUICK"] = replace(QUICK, duration=1.0, most_steps=400, states=2, timing=timing)
    return module


def numbers(value: Any) -> Iterator[float | None]:
    """All numbers of a JSON value, and None where there is one."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)
    elif value is None or isinstance(value, float | int):
        yield value


@pytest.mark.slow
def test_script_writes_record_and_picture(script: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "deep" / "out"
    arguments = ["--quick", "--case", "body", "--case", "maneuver", "--case", "formulations"]
    names = ["rk4", "paper_projected"]
    for name in names:
        arguments += ["--integrator", name]
    assert script.main([*arguments, "--out", str(out)]) == 0
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


def test_every_integrator_is_an_option(script: ModuleType) -> None:
    for name in INTEGRATORS:
        assert script._parse(["--integrator", name]).integrator == [name]


@pytest.mark.slow
def test_what_is_less_accurate_than_declared_fails(
    script: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(benchmark, "LIMITS", {"float64": 1e-30, "float32": 1.0})
    arguments = ["--quick", "--case", "formulations", "--out", str(tmp_path), "--no-picture"]
    assert script.main(arguments) == INACCURATE
    assert "minimal coordinates in float64: relative error" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "work_precision.json").read_text())["shortcomings"]) == 5
    assert not (tmp_path / "work_precision.png").exists()


def test_an_interrupt_and_a_missing_package_end_in_one_sentence(
    script: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    arguments = ["--quick", "--case", "formulations", "--out", str(tmp_path)]
    monkeypatch.setattr(benchmark, "measure_formulations", interrupted)
    assert script.main(arguments) == INTERRUPTED
    assert "nothing is saved" in capsys.readouterr().out
    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)
    assert script.main(arguments) == UNUSABLE
    assert "not installed" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
