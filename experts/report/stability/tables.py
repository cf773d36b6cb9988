"""What became of the cases as tables on the terminal, one for each group."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.text import Text

from experts.report.stability.rows import Row, Status
from experts.report.tables import TextTable

_LONGEST = 240


def print_rows(console: Console, rows: Sequence[Row]) -> None:
    """Print rows, group by group, and how many ended in which way.

    Args:
        console: Where to print.
        rows: The rows.
    """
    for table in tables(rows):
        console.print(table.for_terminal())
    console.print(Text(summary(rows)))


def tables(rows: Sequence[Row]) -> list[TextTable]:
    """What became of the cases, a table for each group.

    Args:
        rows: The rows.

    Returns:
        The tables.
    """
    headings = ("case", "applied to", "", "error", "bound", "what is to be known")
    return [
        TextTable(
            group.capitalize(), headings, tuple(_cells(row) for row in rows if row.group == group), right=None
        )
        for group in dict.fromkeys(row.group for row in rows)
    ]


def failures(rows: Sequence[Row]) -> list[str]:
    """What failed.

    Args:
        rows: The rows.

    Returns:
        A sentence for each failed case.
    """
    return [
        f"{row.group}: {row.name}, {row.subject}: {row.sentence}"
        for row in rows
        if row.status is Status.FAILED
    ]


def summary(rows: Sequence[Row]) -> str:
    """How many cases ended in which way.

    Args:
        rows: The rows.

    Returns:
        A sentence.
    """
    counts = {status: sum(row.status is status for row in rows) for status in Status}
    listed = ", ".join(f"{count} {status.value}" for status, count in counts.items())
    return f"{len(rows)} cases: {listed}."


def _cells(row: Row) -> tuple[str, ...]:
    unit = "" if row.unit in ("", "1") else f" {row.unit}"
    error = "" if row.error is None else f"{row.error:.2g}{unit}"
    bound = "" if row.bound is None or row.error is None else f"{row.bound:.2g}"
    status = row.status.value.upper() if row.status is Status.FAILED else row.status.value
    return row.name, row.subject, status, error, bound, shortened(row.sentence)


def shortened(sentence: str) -> str:
    """A sentence in one line, cut where it would fill the table.

    Args:
        sentence: The sentence, perhaps of many lines.

    Returns:
        Its beginning.
    """
    line = " ".join(sentence.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 2]} …"
