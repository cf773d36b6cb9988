"""`info --speed`: rows of times, beside the reference, as a table and as JSON."""

import json

import pytest
from click.testing import CliRunner

from dq_space_arm_env.command_line import info
from experts.report import machine_speed


@pytest.mark.slow
def test_a_machine_is_measured(monkeypatch):
    monkeypatch.setattr(machine_speed, "_REPEATS", 1)
    monkeypatch.setattr(machine_speed, "_SOLVES", 1)
    rows = list(machine_speed.machine_speed())
    assert [row["measured"] for row in rows] == list(machine_speed.REFERENCE)
    for row in rows:
        assert row["seconds"] > 0.0
        assert row["ratio"] == row["seconds"] / machine_speed.REFERENCE[row["measured"]]
        assert row["per_second"] == 1.0 / row["seconds"]


def test_speeds_are_shown_as_a_table_and_as_json(monkeypatch):
    row = {
        "measured": "a step",
        "seconds": 2.5e-6,
        "reference_seconds": 5e-6,
        "ratio": 0.5,
        "per_second": 4e5,
    }
    monkeypatch.setattr(info, "entry_points", lambda group: {"x": group})
    monkeypatch.setattr(info, "load", lambda reference: lambda: [row])
    shown = CliRunner().invoke(info.info, ["--speed"], catch_exceptions=False).output
    for text in ("a step", "2.5 us", "5 us", "0.50", "400,000"):
        assert text in shown
    record = json.loads(CliRunner().invoke(info.info, ["--speed", "--json"], catch_exceptions=False).output)
    assert record["speed"] == [row]
    assert record["machine"]["processor_name"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(1.074e-7, "107 ns"), (2.5e-6, "2.5 us"), (0.0098, "9.8 ms"), (3.2, "3.2 s"), (2e4, "2e+04 s")],
)
def test_durations_have_a_fitting_unit(seconds, text):
    assert info._duration(seconds) == text
