"""The report as a command: what it prints, writes, and how it ends."""

import logging
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console

from experts.report import to_json, write_atomically
from experts.report.command import Destination, judge
from experts.report.page.parts import PARTS
from experts.report.page.rendering import html_page, markdown_page
from experts.report.page.sections import Section
from experts.report.provenance import provenance


def run(destination: Destination, *, parts: Sequence[str] = (), quick: bool = False) -> int:
    """Measure, and write `report.html`, `report.md` and a JSON file of each part, after each of them.

    Args:
        destination: Where results go.
        parts: Out of `PARTS`; all if there are none.
        quick: Whether to measure little of each.

    Returns:
        Exit status: 0, or 1 if something is less accurate than declared.
    """
    # Some hundred scenes are compiled on the way.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    console = destination.console()
    destination.folder.mkdir(parents=True, exist_ok=True)
    sections: list[Section] = []
    origin = provenance("crocoddyl", "mpmath", "mujoco", "pin", "scipy")
    for name in dict.fromkeys(parts or PARTS):
        sections.append(_measured(console, name, quick=quick))
        _write(destination.folder, sections, origin)
    console.print(f"{destination.folder}: report.html, report.md, and JSON of each part", markup=False)
    shortcomings = [sentence for section in sections for sentence in section.shortcomings]
    records = {section.name: section.record for section in sections}
    destination.print({"parts": records, "shortcomings": shortcomings, **origin})
    return judge(shortcomings)


def _measured(console: Console, name: str, *, quick: bool) -> Section:
    """Measure a part, show what is under way, and say how long it took."""
    began = perf_counter()
    with console.status(f"Measuring: {name}") as status:
        section = PARTS[name](quick=quick, announce=lambda what: status.update(f"Measuring: {name}: {what}"))
    console.print(f"{section.title}: {perf_counter() - began:.0f} s", markup=False)
    return section


def _write(out: Path, sections: Sequence[Section], origin: dict[str, Any]) -> None:
    """Write the pages of what is measured so far, and the files of the last part."""
    last = sections[-1]
    write_atomically(out / f"{last.name}.json", to_json({**last.record, **origin}))
    for figure in last.figures:
        write_atomically(out / f"{figure.name}.png", figure.png)
    write_atomically(out / "report.md", markdown_page(sections, origin))
    write_atomically(out / "report.html", html_page(sections, origin))
