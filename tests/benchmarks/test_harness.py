"""The harness of the benchmarks: claims, rows, files, exit status, and the levels of effort."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from dq_space_arm_env.common.console import FAILURE, INTERRUPTED, SUCCESS, UNUSABLE
from dq_space_arm_env.common.files import json_value
from scripts.benchmarks import __main__ as command
from scripts.benchmarks.effort import QUICK, STANDARD, Effort, Sampling
from scripts.benchmarks.harness import (
    Benchmark,
    Picture,
    Row,
    Status,
    Table,
    claim,
    note,
    one_by_one,
    run,
    section_of,
)


@pytest.mark.parametrize(
    ("error", "status"),
    [(0.5, "handled"), (1.0, "handled"), (1.5, "failed"), (math.nan, "failed"), (math.inf, "failed")],
)
def test_a_claim_holds_up_to_its_bound(error: float, status: str) -> None:
    assert claim("group", "name", "subject", error, 1.0)["status"] == status


def benchmark(rows: list[Row], *, ends: BaseException | None = None) -> Benchmark:
    def measure(effort: Effort) -> Iterator[Row]:
        yield from rows
        if ends is not None:
            raise ends

    times = Table("times", "Times, {engine}\nin ns", ("way", "ns"), by=("engine",))
    plot: dict[str, Any] = {"x": "ns", "y": "ns", "color": "way"}
    return Benchmark(
        "made-up", "Made up", "Caption.", measure, (times,), (Picture("p", "times", "P.", plot),)
    )


ROWS: list[Row] = [
    {"table": "times", "engine": "ours", "way": "a", "ns": 1.0},
    {"table": "times", "engine": "ours", "way": "b", "ns": math.inf},
    {"table": "times", "engine": "theirs", "way": "a", "ns": 3.0},
    note("Said once."),
    note("Said once."),
    claim("g", "n", "s", 0.1, 1.0),
    claim("g", "refused", "s", None, None, status=Status.REFUSED, note="two\nlines"),
]


def test_a_section_has_a_table_for_each_value_and_sentences_once() -> None:
    section = section_of(benchmark(ROWS), ROWS, QUICK)
    titles = [table.title.partition("\n")[0] for table in section.tables]
    assert titles == ["Times, ours", "Times, theirs", "Claims, g"]
    assert section.notes[0] == "Said once."
    assert section.notes[1] == "2 claims: 1 handled, 1 refused, 0 not claimed, 0 failed."
    assert section.tables[2].rows[1][-1] == "two lines"
    assert section.record["rows"][1]["ns"] is None  # JSON has no infinity


@pytest.mark.parametrize(
    ("rows", "ends", "expected"),
    [
        (ROWS, None, SUCCESS),
        ([*ROWS, claim("g", "bad", "s", 2.0, 1.0)], None, FAILURE),
        (ROWS, KeyboardInterrupt(), INTERRUPTED),
        (ROWS, ZeroDivisionError("no mass"), FAILURE),
        ([], None, FAILURE),
    ],
)
def test_files_and_exit_status(
    tmp_path: Path, rows: list[Row], ends: BaseException | None, expected: int
) -> None:
    console = Console(file=StringIO(), width=120)
    assert run([benchmark(rows, ends=ends)], QUICK, tmp_path, console) == expected
    found = json.loads((tmp_path / "made_up.json").read_text(encoding="utf-8"))
    assert found["rows"][: len(rows)] == json_value(rows)
    added = [row["note"] for row in found["rows"][len(rows) :]]
    failures = ["ended by ZeroDivisionError: no mass"] if isinstance(ends, ZeroDivisionError) else []
    assert added == (failures if rows else ["nothing was measured: no case fits the settings"])
    assert found["effort"]["name"] == "quick"
    assert found["machine"]["processor_name"]
    assert "Made up" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_an_error_ends_neither_the_other_benchmarks_nor_the_other_scenes(tmp_path: Path) -> None:
    def refuse() -> Iterator[Row]:
        yield note("Begun.")
        raise ValueError("no such joint")

    def measure(effort: Effort) -> Iterator[Row]:
        yield from one_by_one("scene odd", refuse())
        yield from ROWS

    refused = benchmark([], ends=ValueError("spherical"))
    chosen = [refused, replace(refused, name="other", measure=measure)]
    assert run(chosen, QUICK, tmp_path, Console(file=StringIO(), width=120)) == FAILURE
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["shortcomings"] == [
        "run: to the end, made-up: ended by ValueError: spherical",
        "run: to the end, scene odd: ended by ValueError: no such joint",
    ]
    assert found["parts"]["other"]["counts"]["handled"] == 1
    with pytest.raises(ValueError, match="spherical"):  # alone: unusable input
        run([refused], QUICK, tmp_path, Console(file=StringIO(), width=120))


@pytest.mark.parametrize(
    ("rows", "ends", "said"),
    [
        (ROWS, None, "All of 2 claims are as declared. Times are shown, never judged."),
        (ROWS[:4], None, "Nothing was claimed. Times are shown, never judged."),
        (ROWS, KeyboardInterrupt(), "made-up: interrupted, the rest is not measured"),
    ],
)
def test_the_verdict_tells_how_much_was_judged(
    tmp_path: Path, rows: list[Row], ends: BaseException | None, said: str
) -> None:
    run([benchmark(rows, ends=ends)], QUICK, tmp_path, Console(file=StringIO(), width=120))
    assert said in (tmp_path / "report.md").read_text(encoding="utf-8")
    found = json.loads((tmp_path / "made_up.json").read_text(encoding="utf-8"))
    assert found["shortcomings"] == ([] if ends is None else [said])


class Unread(StringIO):
    """Output that nobody reads any more."""

    def write(self, text: str) -> int:
        if text:
            raise BrokenPipeError
        return 0


@pytest.mark.parametrize("ends", [None, KeyboardInterrupt()])
def test_what_nobody_reads_is_measured_all_the_same(tmp_path: Path, ends: BaseException | None) -> None:
    with pytest.raises((SystemExit, BrokenPipeError)):
        run([benchmark(ROWS, ends=ends)], QUICK, tmp_path, Console(file=Unread(), width=120))
    found = json.loads((tmp_path / "made_up.json").read_text(encoding="utf-8"))
    assert found["rows"] == json_value(ROWS)
    assert "Made up" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_settings_override_the_effort() -> None:
    changed = STANDARD.changed(
        ("starts=3", "only=[masses, poses]", "scenes=payload", "duration=2", "peers=false")
    )
    assert (changed.starts, changed.only, changed.scenes) == (3, ("masses", "poses"), ("payload",))
    assert (changed.duration, changed.peers, changed.name) == (2, False, "standard")
    assert STANDARD.changed(("seed=0", "compared_starts=0", "only=[]")) == replace(
        STANDARD, compared_starts=0
    )
    assert STANDARD.changed(("kernel_timing=[3, 0.1]",)).kernel_timing == Sampling(3, 0.1)
    assert QUICK.changed(("maneuvers=payload", "tolerances=[1, 1e-3]")).tolerances == (1, 1e-3)


@pytest.mark.parametrize(
    "setting",
    [
        "starts",
        "start=3",
        "starts=many",
        "starts=-1",
        "duration=-1.0",
        "duration=.nan",
        "kernel_timing=[1]",
        "kernel_timing=[many, 0.1]",
        "peers=3",
        "starts=true",
        "batch_sizes=[8, many]",
        "mass_ratios=[-1.0]",
        "scenes=[3]",
        "only=[",
        "batch_sizes=[]",
        "horizons=[]",
        "samples=0",
        "starts=0",
        "kernel_timing=[3, 0.0]",
    ],
)
def test_a_wrong_setting_is_named(setting: str) -> None:
    with pytest.raises(ValueError, match=f"setting '?{setting.partition('=')[0]}"):
        STANDARD.changed((setting,))


def test_an_unknown_benchmark_or_group_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["stabilty"])
    assert "choose from work-precision, stability" in capsys.readouterr().err
    pytest.importorskip("mpmath")
    assert command.main(["stability", "--set", "only=mass", "--out", str(tmp_path)]) == UNUSABLE
    assert "choose from masses" in capsys.readouterr().err
