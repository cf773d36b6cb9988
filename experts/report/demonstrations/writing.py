"""The files of the summary, in the folder of the data."""

from __future__ import annotations

from pathlib import Path

from experts.demonstrations import Demonstrations
from experts.files import write_atomically
from experts.report.demonstrations.card import data_card
from experts.report.demonstrations.facts import gather
from experts.report.demonstrations.sections import heading, sections
from experts.report.page.rendering import html_page, markdown_page
from experts.report.provenance import provenance

SUMMARY, CARD = "summary", "README.md"


def write_summary(demonstrations: Demonstrations) -> list[Path]:
    """Write the data card README.md, which follows from the data alone, and the page in `summary/`.

    Args:
        demonstrations: All demonstrations of a folder.

    Returns:
        The files.
    """
    facts = gather(demonstrations)
    made, top, origin = sections(facts), heading(facts), provenance()
    folder = demonstrations.path / SUMMARY
    folder.mkdir(exist_ok=True)
    content: dict[Path, str | bytes] = {
        demonstrations.path / CARD: data_card(facts),
        folder / "summary.html": html_page(made, origin, top),
        folder / "summary.md": markdown_page(made, origin, top),
    }
    for section in made:
        content |= {folder / f"{figure.name}.png": figure.png for figure in section.figures}
    for path, text in content.items():
        write_atomically(path, text)
    return list(content)
