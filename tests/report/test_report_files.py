"""`summary.json` is JSON whatever happened."""

import dataclasses
import json
import math

import pytest

from dq_space_arm_env.common.files import to_json
from experts.report import ManeuverRun, summarize


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
