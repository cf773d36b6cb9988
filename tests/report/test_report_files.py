"""Files are written whole, and `summary.json` is JSON whatever happened."""

import dataclasses
import json
import math
import os
from pathlib import Path

import pytest

from experts.report import ManeuverRun, summarize, to_json, write_atomically


def test_file_is_replaced_and_nothing_is_left_over(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    write_atomically(file, "old")
    write_atomically(file, "Δt")
    assert file.read_text(encoding="utf-8") == "Δt"
    write_atomically(file, b"\x00\xff")
    assert file.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [file]


def test_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.txt"
    file.write_text("old")

    def full(self: Path, data: bytes) -> int:
        self.open("wb").close()
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space"):
        write_atomically(file, "new")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
def test_others_may_read_the_file(tmp_path: Path) -> None:
    file, usual = tmp_path / "a.txt", tmp_path / "usual.txt"
    usual.touch()
    write_atomically(file, "text")
    assert file.stat().st_mode == usual.stat().st_mode


def test_summary_has_the_numbers_of_the_run(short_run: ManeuverRun) -> None:
    summary = json.loads(to_json(summarize(short_run)))
    result = summary["result"]
    assert result["cost"] == short_run.solution.cost
    assert result["initial_attitude_error_deg"] == pytest.approx(60.0)
    assert result["final_position_error_m"] == pytest.approx(short_run.maneuver.distance[-1])
    assert result["converged"] is True
    assert summary["replay"]["return"] == pytest.approx(-result["cost"], rel=1e-12)
    assert summary["actuators"]["joint_torque"]["limits"] == [0.5]
    assert summary["resolved_scene"] == short_run.scene.model_dump(mode="json")
    assert set(summary["versions"]) >= {"dq-space-arm", "python", "numpy", "numba", "casadi"}
    assert summary["machine"]["processor"]


def test_efforts_in_the_summary_add_up(short_run: ManeuverRun) -> None:
    summary = summarize(short_run)
    efforts = sum(actuator["cost"] for actuator in summary["actuators"].values())
    assert efforts == pytest.approx(summary["result"]["cost_terms"]["cost_control"], rel=1e-9)


def test_what_is_not_finite_becomes_null(short_run: ManeuverRun) -> None:
    solution = dataclasses.replace(short_run.solution, cost=math.inf)
    run = dataclasses.replace(short_run, solution=solution, finer_errors=(math.nan, 0.5))
    assert not run.is_finite
    summary = json.loads(to_json(summarize(run)))
    assert summary["result"]["cost"] is None
    assert summary["finer_integration"] == {"final_attitude_error_deg": None, "final_position_error_m": 0.5}
