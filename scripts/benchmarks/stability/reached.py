"""The errors that the cases once reached: a case fails that loses a digit, however wide its claim.

A claim is a sentence about the method, such as "within 1e-3 rad"; what is reached lies often far below. The
table beside this file keeps it for the quick and the standard level. After a change that is meant to move
errors, take the table anew from a report, and read the difference:

    python -m scripts.benchmarks stability --quick
    python -m scripts.benchmarks.stability results/benchmarks/stability.json
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

from scripts.benchmarks.effort import QUICK, STANDARD, Effort
from scripts.benchmarks.harness import CLAIMS, Status, select

TABLE = Path(__file__).with_name("reached.csv")
MARGIN = 10.0  # other processors and libraries round otherwise
LEAST = {False: 1e-15, True: 1e-7}  # by single precision: errors of a few roundings, or none
_KEY, _LEVELS = ("group", "name", "subject"), (QUICK, STANDARD)
_Table = dict[tuple[str, ...], dict[str, str]]


def largest(effort: Effort, group: str, name: str, subject: str) -> float:
    """The error that a case may have, by what it reached; infinite for a case or workload without record."""
    level = replace(effort, only=(), scenes=())
    entry = table().get((group, name, subject), {}).get(effort.name) if level in _LEVELS else None
    return MARGIN * max(float(entry), LEAST["float32" in subject]) if entry else math.inf


@cache
def table() -> _Table:
    """The lines of the table, by group, name and subject of the case."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {tuple(row[part] for part in _KEY): row for row in csv.DictReader(file)}


def record(report: Path) -> int:
    """Take the errors of a report of one level into the table; returns the number of cases."""
    content = json.loads(report.read_text(encoding="utf-8"))
    level = content["effort"]["name"]
    if level not in [effort.name for effort in _LEVELS]:
        raise ValueError(f"{report}: level {level!r}, must be quick or standard")
    entries = dict(table())
    rows = select(content["rows"], table=CLAIMS, status=str(Status.HANDLED))
    for row in rows:
        key = tuple(row[part] for part in _KEY)
        entries[key] = {
            **entries.get(key, {}),
            **dict(zip(_KEY, key, strict=True)),
            level: f"{row['error']:.1e}",
        }
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [*_KEY, *(effort.name for effort in _LEVELS)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(entries.values())
    table.cache_clear()
    return len(rows)
