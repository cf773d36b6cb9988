"""Reports: sections of tables and figures, written as one HTML page, as Markdown and as JSON.

A measurement yields rows (`tables.Row`); `Section.add_rows` shows them in a table and keeps them
for the JSON.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from dq_space_arm_env.common.files import (
    json_value,
    to_json,
    write_atomically,
)
from dq_space_arm_env.common.tables import (
    Column,
    Row,
    TextTable,
    one_line,
    tabulate,
)

NO_PICTURE = 'No picture: it needs matplotlib (pip install "dq-space-arm[plots]").'

_STYLE = """
body { font: 16px/1.5 Georgia, serif; color: #111; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 3rem; border-bottom: 1px solid #bbb; }
table { border-collapse: collapse; margin: 1.5rem 0; font-size: 0.9rem; }
caption { text-align: left; margin-bottom: 0.3rem; }
th { border-bottom: 1px solid #111; vertical-align: bottom; white-space: pre-line; }
th, td { padding: 0.15rem 0.7rem; text-align: left; }
tr:nth-child(even) td { background: #f4f4f4; }
.right { text-align: right; font-variant-numeric: tabular-nums; }
.number { white-space: nowrap; }
.wide { overflow-x: auto; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; }
figcaption { font-size: 0.9rem; color: #333; }
.bad { color: #b00000; font-weight: bold; }
:root { color-scheme: light dark; }
@media (prefers-color-scheme: dark) {
  body { color: #ddd; background: #161616; }
  h2 { border-color: #555; }
  th { border-color: #ddd; }
  tr:nth-child(even) td { background: #222; }
  figcaption { color: #bbb; }
  a { color: #8ab4f8; }
  .bad { color: #ff6b6b; }
}
"""


@dataclass(frozen=True)
class Figure:
    """A picture, as the content of a PNG file."""

    name: str  # of its file, without the extension
    caption: str
    png: bytes


@dataclass
class Section:
    """One part of a report."""

    name: str  # in file names and JSON
    title: str
    caption: str
    tables: list[TextTable] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # sentences below the tables
    figures: list[Figure] = field(default_factory=list)
    shortcomings: list[str] = field(default_factory=list)  # sentences, shown at the top of the page too
    record: dict[str, Any] = field(default_factory=dict)  # JSON values

    def add_rows(
        self,
        name: str,
        rows: Iterable[Row],
        columns: Iterable[Column | str] | None = None,
        title: str | None = None,
    ) -> None:
        """Show rows as a table, and keep them in the record.

        Args:
            name: Key of the rows in the record.
            rows: The rows.
            columns: Columns of the table in order; all keys of the rows by default.
            title: Title of the table; the name in words by default.
        """
        rows = [dict(row) for row in rows]
        self.record[name] = json_value(rows)
        title = name.replace("_", " ").capitalize() if title is None else title
        self.tables.append(tabulate(title, rows, columns))

    def add_figure(self, name: str, caption: str, draw: Callable[[], bytes]) -> None:
        """Add a picture, or a note where Matplotlib is missing.

        Args:
            name: Name of its file without the extension.
            caption: Caption.
            draw: Draws it, as PNG; imports Matplotlib only when called.
        """
        if find_spec("matplotlib") is not None:
            self.figures.append(Figure(name, caption, draw()))
        elif NO_PICTURE not in self.notes:
            self.notes.append(NO_PICTURE)

    def print(self, console: Console) -> None:
        """Print tables and notes."""
        for table in self.tables:
            console.print(table.for_terminal())
        for note in self.notes:
            console.print(note, markup=False)

    def html(self) -> Iterator[str]:
        """The section as lines of HTML."""
        yield f'<h2 id="{self.name}">{escape(self.title)}</h2>'
        yield f"<p>{escape(self.caption)}</p>"
        for sentence in self.shortcomings:
            yield f'<p class="bad">{escape(sentence)}</p>'
        for figure in self.figures:
            data = b64encode(figure.png).decode("ascii")
            yield f'<figure><img alt="{escape(figure.caption)}" src="data:image/png;base64,{data}">'
            yield f"<figcaption>{escape(figure.caption)}</figcaption></figure>"
        for table in self.tables:
            yield from table.html()
        for note in self.notes:
            yield f"<p>{escape(note)}</p>"

    def markdown(self) -> Iterator[str]:
        """Blocks of Markdown; each figure is a file of its name beside it."""
        yield from (f"## {one_line(self.title)}", one_line(self.caption))
        for sentence in self.shortcomings:
            yield f"**{one_line(sentence)}**"
        for figure in self.figures:
            yield from (f"![{one_line(figure.caption)}]({figure.name}.png)", f"*{one_line(figure.caption)}*")
        for table in self.tables:
            yield from table.markdown()
        yield from map(one_line, self.notes)


@dataclass
class Page:
    """A report: sections, and where they come from."""

    title: str
    sections: list[Section]
    origin: Mapping[str, Any]  # from `provenance`
    all_well: str = ""  # sentence where nothing falls short
    complaint: str = "Shortcomings"  # introduces those of the sections

    @property
    def shortcomings(self) -> list[str]:
        """Those of all sections."""
        return [sentence for section in self.sections for sentence in section.shortcomings]

    @property
    def record(self) -> dict[str, Any]:
        """JSON values: the record of each section, shortcomings and origin."""
        parts = {section.name: section.record for section in self.sections}
        return {"title": self.title, "parts": parts, "shortcomings": self.shortcomings, **self.origin}

    def save(self, folder: Path, name: str = "report") -> list[str]:
        """Write the page as HTML, Markdown and JSON, and its figures, into an existing folder.

        Args:
            folder: The folder.
            name: Name of the files without extensions.

        Returns:
            Names of the files.
        """
        files: dict[str, str | bytes] = {
            f"{name}.html": self.html(),
            f"{name}.md": self.markdown(),
            f"{name}.json": to_json(json_value(self.record)),
        }
        for section in self.sections:
            files |= {f"{figure.name}.png": figure.png for figure in section.figures}
        for file, content in files.items():
            write_atomically(folder / file, content)
        return list(files)

    def html(self) -> str:
        """The page as HTML that needs no other file."""
        lines = ["<!DOCTYPE html>", '<html lang="en">', "<head>", '<meta charset="utf-8">']
        lines.append('<meta name="viewport" content="width=device-width, initial-scale=1">')
        lines += [f"<title>{escape(self.title)}</title>", f"<style>{_STYLE}</style>", "</head>", "<body>"]
        lines += [f"<h1>{escape(self.title)}</h1>", *origin_table(self.origin).html()]
        style = ' class="bad"' if self.shortcomings else ""
        lines.append(f"<p{style}>{escape(self._verdict())}</p>")
        links = (f'<li><a href="#{part.name}">{escape(part.title)}</a></li>' for part in self.sections)
        lines += ["<ul>", *links, "</ul>"]
        for section in self.sections:
            lines += section.html()
        return "\n".join([*lines, "</body>", "</html>", ""])

    def markdown(self) -> str:
        """The page as Markdown; each figure is a file of its name beside it."""
        verdict = one_line(self._verdict())
        verdict = f"**{verdict}**" if self.shortcomings else verdict
        blocks = [f"# {one_line(self.title)}", *origin_table(self.origin).markdown(), verdict]
        for section in self.sections:
            blocks += section.markdown()
        return "\n\n".join(block for block in blocks if block) + "\n"

    def _verdict(self) -> str:
        return f"{self.complaint}: {' '.join(self.shortcomings)}" if self.shortcomings else self.all_well


def origin_table(origin: Mapping[str, Any]) -> TextTable:
    """Show date, commit, machine and versions of `provenance`."""
    commit, machine = origin["commit"], origin["machine"]
    described = "not known"
    if commit is not None:
        described = commit["hash"] + (", with changes" if commit["modified"] else "")
    versions = (f"{name} {version}" for name, version in origin["versions"].items() if version is not None)
    rows = (
        ("date", origin["date"]),
        ("commit", described),
        ("machine", f"{machine['processor_name']}, {machine['system']}"),
        ("versions", ", ".join(versions)),
    )
    return TextTable("Where this comes from", ("", ""), rows)
