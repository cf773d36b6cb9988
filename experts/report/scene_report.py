"""The report of a scene: measured part by part, and written after each one."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

from rich.console import Console

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.progress import ProgressDisplay, Status
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Page, Section
from dq_space_arm_env.scene import Scene
from experts.demonstrations.settings import source_hash
from experts.report import expert_trials, integrator_precision, part_costs, stability_envelope
from experts.report.effort import FULL, QUICK, Effort

PARTS: dict[str, ModuleType] = {
    "precision": integrator_precision,
    "stability": stability_envelope,
    "parts": part_costs,
    "expert": expert_trials,
}
"""Parts in order; each has `measure(scene, effort, announce)`, whose rows `section(scene, rows)` shows."""
NAME = "report"


def report(scene: Scene, folder: Path, console: Console, *, quick: bool = False) -> Page:
    """Measure a scene and write report.html, report.md and report.json after each part.

    An interrupted report of the same scene, effort and source, on a machine of the same kind, resumes: its
    parts are kept.

    Args:
        scene: The scene.
        folder: Gets the files; it must exist.
        console: Shows progress, tables, and where the files are.
        quick: Whether to measure less.

    Returns:
        The page.

    Raises:
        KeyboardInterrupt: If interrupted; the files of the finished parts are complete.
        OSError: If the folder cannot be written to.
    """
    # Progress says enough about the many variants that are compiled.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    effort, origin = QUICK if quick else FULL, provenance()
    request = {
        "scene": scene.model_dump(mode="json"),
        "quick": quick,
        "versions": origin["versions"],
        "commit": origin["commit"],
        "source": source_hash(without=()),  # a commit does not tell which of its files were changed
    }
    found = _unfinished(folder / f"{NAME}.json", {"request": request, "machine": origin["machine"]})
    if found:
        console.print(f"Resuming: {', '.join(found)} are kept from an interrupted report.", markup=False)
    page = Page(
        f"Report of scene {scene.name}",
        [],
        {**origin, "request": request},
        complaint="Not everything is measured",
    )
    # All of them before the first file is written: an interrupt must not lose those that come later.
    kept = {name: _kept_section(PARTS[name], name, scene, rows, console) for name, rows in found.items()}
    sections = {name: section for name, section in kept.items() if section is not None}
    for name, part in PARTS.items():
        if name not in sections:
            sections[name] = _section(part, name, scene, _measured(name, scene, effort, console))
        page.sections = [sections[each] for each in PARTS if each in sections]
        files = page.save(folder, NAME)
        console.print(sections[name].title, style="bold", markup=False)
        sections[name].print(console)
    console.print(f"{folder}: {', '.join(files)}", markup=False)
    return page


def _measured(name: str, scene: Scene, effort: Effort, console: Console) -> dict[str, Any]:
    """Rows of a part as JSON values; shows progress, and how long it took."""
    began = perf_counter()
    with ProgressDisplay(console) as progress:

        def announce(what: str, done: int, total: int) -> None:
            progress.update(Status(done, total, f"{name}: {what}"))

        try:
            rows: dict[str, Any] = json_value(PARTS[name].measure(scene, effort, announce))
        except ValueError as error:  # for example, the environment refuses actuators without a limit
            rows = {"refused": str(error)}
    if "refused" in rows:
        console.print(f"{name}: NOT measured: {rows['refused']}", markup=False)
    else:
        console.print(f"{name}: measured in {perf_counter() - began:.0f} s", markup=False)
    return rows


def _section(part: ModuleType, name: str, scene: Scene, found: dict[str, Any]) -> Section:
    if "refused" in found:
        sentence = f"{name} is not measured: {found['refused']}"
        section = Section(name, name.capitalize(), "Not measured.", shortcomings=[sentence])
    else:
        section = part.section(scene, found)
        section.name = name  # by which a resumed report finds its rows
    section.record = {**found, **section.record}
    return section


def _kept_section(
    part: ModuleType, name: str, scene: Scene, found: dict[str, Any], console: Console
) -> Section | None:
    """The section of rows that a file held; None if they are not what this part measures."""
    try:
        return _section(part, name, scene, found)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        console.print(f"{name}: the kept rows are damaged, and measured again", markup=False)
        return None


def _unfinished(file: Path, wanted: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Parts of an interrupted report of the same request and machine; none if there is none."""
    try:
        record = read_mapping(file)
    except UnreadableError:
        return {}
    parts, asked = record.get("parts"), {name: record.get(name) for name in wanted}
    if not isinstance(parts, dict) or not all(isinstance(part, dict) for part in parts.values()):
        return {}
    same = asked == json.loads(json.dumps(json_value(wanted)))
    return parts if same and parts.keys() < PARTS.keys() else {}
