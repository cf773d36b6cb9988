"""Files are written whole, and `summary.json` is JSON whatever happened."""

import dataclasses
import json
import math
import os
from pathlib import Path

import pytest

from dq_space_arm_env.common.files import to_json, write_atomically
from experts.report import ManeuverRun, summarize


def test_file_is_replaced_and_nothing_is_left_over(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    for content in ("old", "Δt", b"\x00\xff"):
        write_atomically(file, content)
        assert file.read_bytes() == (content if isinstance(content, bytes) else content.encode())
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
    assert summary["replay"]["return"] == pytest.approx(-result["cost"], rel=1e-12)
    efforts = sum(actuator["cost"] for actuator in summary["actuators"].values())
    assert efforts == pytest.approx(result["cost_terms"]["cost_control"], rel=1e-9)
    assert summary["resolved_scene"] == short_run.scene.model_dump(mode="json")
    assert set(summary["versions"]) >= {"dq-space-arm", "python", "numpy", "numba", "casadi"}


def test_what_is_not_finite_becomes_null(short_run: ManeuverRun) -> None:
    solution = dataclasses.replace(short_run.solution, cost=math.inf)
    run = dataclasses.replace(short_run, solution=solution, finer_errors=(math.nan, 0.5))
    assert not run.is_finite
    summary = json.loads(to_json(summarize(run)))
    assert summary["result"]["cost"] is None
    assert summary["finer_integration"] == {"final_attitude_error_deg": None, "final_position_error_m": 0.5}
