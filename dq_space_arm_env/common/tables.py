"""Tables: rows of measurements, or plain text, for a terminal, Markdown and HTML."""

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from numbers import Real
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, ConsoleRenderable
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

_UNBOUNDED = 10_000  # width at which tables are measured

Row = Mapping[str, Any]
"""One observation: JSON values by column, units in the names of the columns, NaN where unknown."""


@dataclass(frozen=True)
class Column:
    """A column of a table of rows: key, heading, and format of its values."""

    key: str
    heading: str | None = None  # the key in words by default
    format: str | Callable[[Any], str] = ".3g"  # format specification of floats, or a function of any value
    missing: str = "-"  # in place of None and NaN

    @property
    def title(self) -> str:
        """The heading."""
        return self.key.replace("_", " ") if self.heading is None else self.heading

    def cell(self, row: Row) -> str:
        """The text of a row in this column."""
        value = row.get(self.key)
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return self.missing
        if callable(self.format):
            return self.format(value)
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, float):
            return format(value, self.format)
        return f"{value:,}" if isinstance(value, int) else str(value)

    def is_numeric(self, rows: Sequence[Row]) -> bool:
        """Whether all known values are numbers, which stand flush right."""
        values = [row.get(self.key) for row in rows]
        known = [value for value in values if value is not None]
        return all(isinstance(value, Real) and not isinstance(value, bool) for value in known)


@dataclass(frozen=True)
class TextTable:
    """A table of plain text."""

    title: str  # text after a line break explains
    headings: tuple[str, ...]  # not shown if all are empty
    rows: tuple[tuple[str, ...], ...]
    right: int | Collection[int] | None = None  # columns flush right: those named, or from this one on

    def is_right(self, index: int) -> bool:
        """Whether a column is flush right."""
        if self.right is None:
            return False
        return index >= self.right if isinstance(self.right, int) else index in self.right

    def for_terminal(self) -> ConsoleRenderable:
        """The table as `rich` prints it; brackets in the cells are no markup.

        Where it is too wide, parts of it stand below each other, each with the first column.
        """
        return _OnTerminal(self)

    def markdown(self) -> Iterator[str]:
        """Title and table as blocks of Markdown."""
        title, _, explained = self.title.partition("\n")
        yield f"**{one_line(title)}**" + (f": {one_line(explained)}" if explained else "")
        rules = ("---:" if self.is_right(index) else "---" for index in range(len(self.headings)))
        lines = [_markdown_row(self.headings), f"| {' | '.join(rules)} |"]
        yield "\n".join([*lines, *(_markdown_row(row) for row in self.rows)])

    def html(self) -> Iterator[str]:
        """Lines of HTML."""
        title, _, explained = self.title.partition("\n")
        yield f'<div class="wide"><table><caption><b>{escape(title)}</b>'
        yield f"<br>{escape(explained)}</caption>" if explained else "</caption>"
        if any(self.headings):
            yield f"<thead><tr>{self._html_cells('th', self.headings)}</tr></thead>"
        rows = (f"<tr>{self._html_cells('td', row)}</tr>" for row in self.rows)
        yield from ("<tbody>", *rows, "</tbody></table></div>")

    def _html_cells(self, tag: str, cells: Sequence[str]) -> str:
        written = []
        for index, cell in enumerate(cells):
            style = ' class="right"' if self.is_right(index) else ""
            # Browsers break lines at a hyphen, even in 1e-06.
            whole = re.sub(r"\d[\d.]*e-\d+", r'<span class="number">\g<0></span>', escape(cell))
            written.append(f"<{tag}{style}>{whole}</{tag}>")
        return "".join(written)


@dataclass(frozen=True)
class _OnTerminal:
    """A table as wide as the terminal."""

    table: TextTable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        wide, columns = options.update_width(_UNBOUNDED), range(len(self.table.headings))

        def measured(part: Table) -> Measurement:
            return Measurement.get(console, wide, part)

        whole = self._part(columns)
        if measured(whole).maximum <= options.max_width:
            yield whole
            return
        part, title = [*columns[:1]], True
        for index in columns[1:]:
            longer = self._part([*part, index], title, narrow=True)
            if len(part) > 1 and measured(longer).minimum > options.max_width:
                yield self._part(part, title, narrow=True)
                part, title = [*columns[:1]], False
            part.append(index)
        yield self._part(part, title, narrow=True)

    def _part(self, columns: Sequence[int], title: bool = True, narrow: bool = False) -> Table:
        """Some columns; where narrow, numbers are whole all the same, and their headings wrap at words."""
        table = Table(
            title=Text(self.table.title) if title else None,
            title_justify="left",
            title_style="bold",
            box=SIMPLE_HEAD,
            show_header=any(self.table.headings),
        )
        for index in columns:
            heading, is_right = self.table.headings[index], self.table.is_right(index)
            cells = [line for row in self.table.rows for line in row[index].splitlines()]
            width = max(map(cell_len, [*heading.split(), *cells]), default=0)
            table.add_column(
                Text(heading),
                overflow="fold",
                justify="right" if is_right else "left",
                width=width if narrow and is_right else None,
            )
        for row in self.table.rows:
            table.add_row(*(Text(row[index]) for index in columns))
        return table


def tabulate(title: str, rows: Iterable[Row], columns: Iterable[Column | str] | None = None) -> TextTable:
    """Write rows as a table; numbers stand flush right.

    Args:
        title: Title above the table; text after a line break explains.
        rows: The rows.
        columns: Columns in order, a key or a `Column` each; all keys of the rows by default.

    Returns:
        The table.
    """
    rows = list(rows)
    if columns is None:
        columns = dict.fromkeys(key for row in rows for key in row)
    shown = [Column(column) if isinstance(column, str) else column for column in columns]
    return TextTable(
        title,
        tuple(column.title for column in shown),
        tuple(tuple(column.cell(row) for column in shown) for row in rows),
        right=frozenset(index for index, column in enumerate(shown) if column.is_numeric(rows)),
    )


def plain_table(title: str, headings: Iterable[str], rows: Iterable[Iterable[str]]) -> ConsoleRenderable:
    """Make a table of plain text for the terminal."""
    return TextTable(title, tuple(headings), tuple(tuple(row) for row in rows)).for_terminal()


def one_line(text: str) -> str:
    """Text on one line of Markdown, fit for a cell; names from files make neither markup nor links."""
    line = " ".join(text.split()).replace("|", "\\|")
    return line.replace("<", "&lt;").replace("](", "]\\(")


def _markdown_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(one_line(cell) for cell in cells)} |"
