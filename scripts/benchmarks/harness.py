"""The one harness: rows, claims, tables, figures, files and exit status of every benchmark.

A benchmark yields tidy rows: plain dicts of JSON scalars whose key "table" names the table they belong to.
Rows of the table "claims" are judged. They have one schema in all benchmarks, see `claim`. Rows of the table
"notes" are sentences below the tables. From the rows alone, one renderer makes the tables on the terminal,
a JSON file and figures for each benchmark, and one page for all of them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console

from dq_space_arm_env.common.console import FAILURE, INTERRUPTED, SUCCESS, complain
from dq_space_arm_env.common.files import json_value, to_json, write_atomically
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Page, Section
from dq_space_arm_env.common.tables import Column, tabulate
from experts.report.timing import three_digits
from scripts.benchmarks.effort import Effort

Row = dict[str, Any]
CLAIMS, NOTES = "claims", "notes"
_LONGEST_NOTE = 240
_LOG = logging.getLogger(__name__)


class Status(StrEnum):
    """Outcome of a claim."""

    HANDLED = "handled"  # the error is a finite number and at most the bound
    REFUSED = "refused"  # in the sentence of the note, as it should be
    NOT_CLAIMED = "not claimed"  # beyond a documented limit of the method
    FAILED = "failed"


@dataclass(frozen=True)
class Table:
    """A table of the rows of one name; with `by`, one for each value of this column."""

    name: str
    title: str  # a format string of the first row's columns; text after a line break explains
    columns: tuple[Column | str, ...]
    by: tuple[str, ...] = ()


@dataclass(frozen=True)
class Picture:
    """A figure of the rows of one table, drawn by `experts.figures.plots.Plot`."""

    name: str
    table: str
    caption: str
    plot: Mapping[str, Any]  # arguments of Plot
    where: Callable[[Row], bool] = lambda row: True


@dataclass(frozen=True)
class Benchmark:
    """A measurement, and the specification of its tables and figures."""

    name: str
    title: str
    caption: str
    measure: Callable[[Effort], Iterator[Row]]
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    packages: tuple[str, ...] = ()  # whose versions matter


def claim(
    group: str,
    name: str,
    subject: str,
    error: float | None,
    bound: float | None,
    *,
    unit: str = "",
    note: str = "",
    status: Status | None = None,
    **others: Any,
) -> Row:
    """Declare a bound on an error; without a status, NaN and errors above the bound fail."""
    if status is None:
        assert bound is not None
        status = Status.HANDLED
        if error is None or not math.isfinite(error):
            status, note = Status.FAILED, f"the error is not finite. {note}".strip()
        elif error > bound:
            sentence = f"the error {error:.1e} is above {bound:.3g} {unit}".strip()
            status, note = Status.FAILED, f"{sentence}. {note}".strip()
    labels = {"table": CLAIMS, "group": group, "name": name, "subject": subject, "status": str(status)}
    return {**labels, "error": error, "bound": bound, "unit": unit, "note": note, **others}


def note(sentence: str) -> Row:
    """A sentence below the tables, shown once however often it is yielded."""
    return {"table": NOTES, "note": sentence}


def select(rows: Iterable[Row], **wanted: object) -> list[Row]:
    """Rows with these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def shortcomings(rows: Iterable[Row]) -> list[str]:
    """A sentence for each claim that failed."""
    return [
        f"{row['group']}: {row['name']}, {row['subject']}: {row['note']}"
        for row in select(rows, table=CLAIMS, status=str(Status.FAILED))
    ]


def section_of(benchmark: Benchmark, rows: Sequence[Row], effort: Effort) -> Section:
    """Show the rows of a benchmark."""
    section = Section(benchmark.name, benchmark.title, benchmark.caption)
    for spec in (*benchmark.tables, _CLAIMS_TABLE):
        found = select(rows, table=spec.name)
        for key in dict.fromkeys(tuple(row[column] for column in spec.by) for row in found):
            own = [row for row in found if tuple(row[column] for column in spec.by) == key]
            section.tables.append(tabulate(spec.title.format(**own[0]), own, spec.columns))
    section.notes += dict.fromkeys(row["note"] for row in select(rows, table=NOTES))
    claims = select(rows, table=CLAIMS)
    counts = {status: len(select(claims, status=str(status))) for status in Status}
    listed = ", ".join(f"{count} {status.value}" for status, count in counts.items())
    section.notes.append(f"{len(claims)} claims: {listed}.")
    section.shortcomings = shortcomings(rows)
    for picture in benchmark.pictures:
        drawn = [row for row in select(rows, table=picture.table) if picture.where(row)]
        if drawn:
            section.add_figure(picture.name, picture.caption, lambda p=picture, d=drawn: _draw(p, d))  # type: ignore[misc]
    section.record = {"effort": asdict(effort), "counts": counts, "rows": json_value(list(rows))}
    return section


def _draw(picture: Picture, rows: Sequence[Row]) -> bytes:
    from experts.figures.plots import Plot  # matplotlib is optional

    return Plot(**picture.plot).png(rows)


def _verdict(sections: Iterable[Section]) -> str:
    """The sentence where no claim failed."""
    claimed = sum(sum(section.record["counts"].values()) for section in sections)
    judged = f"All of {claimed:,} claims are as declared." if claimed else "Nothing was claimed."
    return f"{judged} Times are shown, never judged."


def time_column(key: str, heading: str | None = None) -> Column:
    return Column(key, heading, three_digits)


def _error(value: float) -> str:
    return f"{value:.2g}"


def _shortened(sentence: str) -> str:
    line = " ".join(sentence.split())
    return line if len(line) <= _LONGEST_NOTE else f"{line[: _LONGEST_NOTE - 2]} …"


_CLAIMS_TABLE = Table(
    CLAIMS,
    "Claims, {group}",
    (
        Column("name", "case"),
        Column("subject", "applied to"),
        Column("status", "", lambda status: status.upper() if status == Status.FAILED else status),
        Column("error", format=_error, missing=""),
        Column("bound", format=_error, missing=""),
        Column("unit"),
        Column("note", format=_shortened),
    ),
    by=("group",),
)


def one_by_one(subject: str, rows: Iterable[Row]) -> Iterator[Row]:
    """The rows of one scene or part; an error ends these with a failed claim, not those of the others."""
    try:
        yield from rows
    except Exception as error:
        _LOG.exception(subject)
        yield _failure(subject, f"ended by {type(error).__name__}: {error}")


def collect(
    benchmark: Benchmark, effort: Effort, console: Console, *, alone: bool = True
) -> tuple[list[Row], bool]:
    """Measure; an interrupt keeps the rows so far, and is the second result.

    An error is a failed claim, but for one before the first row of the only benchmark, which loses nothing:
    unusable input.
    """
    rows: list[Row] = []
    with console.status(f"Measuring: {benchmark.name}") as status:
        try:
            for row in benchmark.measure(effort):
                rows.append(row)
                labels = [row[key] for key in ("group", "scene", "name", "subject") if row.get(key)]
                status.update(f"Measuring: {benchmark.name}: {row['table']} {', '.join(map(str, labels))}")
        except KeyboardInterrupt:
            return rows, True
        except Exception as error:
            if alone and not rows:
                raise
            console.print_exception()
            rows.append(_failure(benchmark.name, f"ended by {type(error).__name__}: {error}"))
    return rows or [_failure(benchmark.name, "nothing was measured: no case fits the settings")], False


def _failure(subject: str, sentence: str) -> Row:
    """A claim that a run has not met."""
    return claim("run", "to the end", subject, None, None, note=sentence, status=Status.FAILED)


def run(benchmarks: Sequence[Benchmark], effort: Effort, folder: Path, console: Console) -> int:
    """Measure, print, and write a JSON file for each benchmark and the page `report` after each.

    A benchmark that an error ends does not end the others.

    Returns the exit status: 0; 1 if a claim failed; 130 if interrupted.
    """
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)  # hundreds of scenes are compiled
    folder.mkdir(parents=True, exist_ok=True)
    packages = dict.fromkeys(name for benchmark in benchmarks for name in benchmark.packages)
    page = Page(
        "DQ Space Arm: benchmarks",
        [],
        provenance(*packages),
        complaint="Not as declared",
    )
    for benchmark in benchmarks:
        started = perf_counter()
        rows, interrupted = collect(benchmark, effort, console, alone=len(benchmarks) == 1)
        section = section_of(benchmark, rows, effort)
        if interrupted:
            section.shortcomings.append(f"{benchmark.name}: interrupted, the rest is not measured")
        page.sections.append(section)
        page.all_well = _verdict(page.sections)
        record = {**section.record, "shortcomings": section.shortcomings, **page.origin}
        write_atomically(folder / f"{benchmark.name.replace('-', '_')}.json", to_json(json_value(record)))
        page.save(folder)
        section.print(console)  # last: nobody may be there to read it
        console.print(f"{benchmark.title}: {perf_counter() - started:.0f} s", markup=False)
        if interrupted:
            console.print("Interrupted: the measurements so far are saved.")
            return INTERRUPTED
    console.print(f"{folder}: report.html, report.md, and JSON of each benchmark", markup=False)
    for sentence in page.shortcomings:
        complain(sentence, label="")
    return FAILURE if page.shortcomings else SUCCESS
