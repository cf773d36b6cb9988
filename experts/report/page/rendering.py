"""The report as a self-contained HTML page, and as Markdown with its pictures beside it."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

from experts.report.page.sections import Section
from experts.report.tables import TextTable


class Heading(NamedTuple):
    """What stands at the top of a page.

    Attributes:
        title: Its title.
        all_well: Sentence where nothing falls short.
        complaint: What comes before the shortcomings.
    """

    title: str
    all_well: str
    complaint: str


REPORT = Heading(
    "DQ Space Arm: the numerical report",
    "Everything is as accurate as declared. Times are shown, never judged.",
    "Less accurate than declared",
)

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
.wide, pre { overflow-x: auto; }
pre { font-size: 0.75rem; line-height: 1.3; }
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


def html_page(sections: Sequence[Section], origin: Mapping[str, Any], heading: Heading = REPORT) -> str:
    """Write a page that needs no other file.

    Args:
        sections: What was measured.
        origin: Machine, versions and commit, from `provenance`.
        heading: What stands at its top.

    Returns:
        HTML text.
    """
    lines = ["<!DOCTYPE html>", '<html lang="en">', "<head>", '<meta charset="utf-8">']
    lines.append('<meta name="viewport" content="width=device-width, initial-scale=1">')
    lines += [f"<title>{escape(heading.title)}</title>", f"<style>{_STYLE}</style>", "</head>", "<body>"]
    lines.append(f"<h1>{escape(heading.title)}</h1>")
    lines += _html_table(origin_table(origin))
    lines += [f'<p class="{style}">{escape(text)}</p>' for style, text in _verdict(sections, heading)]
    links = (f'<li><a href="#{part.name}">{escape(part.title)}</a></li>' for part in sections)
    lines += ["<ul>", *links, "</ul>"]
    for section in sections:
        lines += _html_section(section)
    return "\n".join([*lines, "</body>", "</html>", ""])


def markdown_page(sections: Sequence[Section], origin: Mapping[str, Any], heading: Heading = REPORT) -> str:
    """Write the same as Markdown; each figure is a file of its name beside it.

    Args:
        sections: What was measured.
        origin: Machine, versions and commit, from `provenance`.
        heading: What stands at its top.

    Returns:
        Markdown text.
    """
    blocks = [f"# {heading.title}", *markdown_table(origin_table(origin))]
    blocks += [f"**{text}**" if style else text for style, text in _verdict(sections, heading)]
    for section in sections:
        blocks += [f"## {section.title}", section.caption]
        blocks += [f"**{sentence}**" for sentence in section.shortcomings]
        for figure in section.figures:
            blocks += [f"![{_cell(figure.caption)}]({figure.name}.png)", f"*{figure.caption}*"]
        for table in section.tables:
            blocks += markdown_table(table)
        if section.printed:
            blocks.append(f"```text\n{section.printed}\n```")
        blocks += section.notes
    return "\n\n".join(blocks) + "\n"


def origin_table(origin: Mapping[str, Any]) -> TextTable:
    """Show where a report comes from.

    Args:
        origin: From `provenance`.

    Returns:
        A row for date, commit, machine and versions.
    """
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


def _verdict(sections: Sequence[Section], heading: Heading) -> Iterator[tuple[str, str]]:
    """Style and sentence."""
    failures = [sentence for section in sections for sentence in section.shortcomings]
    if failures:
        yield "bad", f"{heading.complaint}: {' '.join(failures)}"
    else:
        yield "", heading.all_well


def _html_section(section: Section) -> Iterator[str]:
    yield f'<h2 id="{section.name}">{escape(section.title)}</h2>'
    yield f"<p>{escape(section.caption)}</p>"
    for sentence in section.shortcomings:
        yield f'<p class="bad">{escape(sentence)}</p>'
    for figure in section.figures:
        data = b64encode(figure.png).decode("ascii")
        yield f'<figure><img alt="{escape(figure.caption)}" src="data:image/png;base64,{data}">'
        yield f"<figcaption>{escape(figure.caption)}</figcaption></figure>"
    for table in section.tables:
        yield from _html_table(table)
    if section.printed:
        yield f"<pre>{escape(section.printed)}</pre>"
    for note in section.notes:
        yield f"<p>{escape(note)}</p>"


def _html_table(table: TextTable) -> Iterator[str]:
    title, _, explained = table.title.partition("\n")
    yield f'<div class="wide"><table><caption><b>{escape(title)}</b>'
    yield f"<br>{escape(explained)}</caption>" if explained else "</caption>"
    if any(table.headings):
        yield f"<thead><tr>{_html_cells('th', table.headings, table.right)}</tr></thead>"
    rows = (f"<tr>{_html_cells('td', row, table.right)}</tr>" for row in table.rows)
    yield from ("<tbody>", *rows, "</tbody></table></div>")


def _html_cells(tag: str, cells: Sequence[str], right: int | None) -> str:
    written = []
    for index, cell in enumerate(cells):
        style = ' class="right"' if right is not None and index >= right else ""
        # Browsers break lines at a hyphen, that of 1e-06 too.
        whole = re.sub(r"\d[\d.]*e-\d+", r'<span class="number">\g<0></span>', escape(cell))
        written.append(f"<{tag}{style}>{whole}</{tag}>")
    return "".join(written)


def markdown_table(table: TextTable) -> Iterator[str]:
    """Write a table as Markdown.

    Args:
        table: The table.

    Yields:
        Its title, and its lines.
    """
    title, _, explained = table.title.partition("\n")
    yield f"**{_cell(title)}**" + (f": {_cell(explained)}" if explained else "")
    rules = (
        "---:" if table.right is not None and index >= table.right else "---"
        for index in range(len(table.headings))
    )
    lines = [_markdown_row(table.headings), f"| {' | '.join(rules)} |"]
    yield "\n".join([*lines, *(_markdown_row(row) for row in table.rows)])


def _markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(_cell(cell) for cell in cells)} |"


def _cell(text: str) -> str:
    """Text on one line, without what would end a cell."""
    return " ".join(text.split()).replace("|", "\\|")
