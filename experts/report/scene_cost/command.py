"""What scenes leave out, as a command: what it prints and writes."""

from collections.abc import Sequence
from dataclasses import asdict

from dq_space_arm_env import load_scene
from experts.report.command import SUCCESS, Destination
from experts.report.provenance import provenance
from experts.report.scene_cost.measurement import FULL, QUICK, SceneCostReport, measure
from experts.report.scene_cost.records import report_record
from experts.report.scene_cost.tables import tables


def run(destination: Destination, *, quick: bool = False, scenes: Sequence[str] = ()) -> int:
    """Measure; `scene_cost.json` and `scene_cost.png` hold the numbers.

    Args:
        destination: Where results go.
        quick: Whether to measure little.
        scenes: Names or paths of scenes; all that are shipped, and the parts of scene paper, if there are
            none.

    Returns:
        Exit status.

    Raises:
        SceneError: If a scene cannot be loaded.
    """
    console = destination.console()
    effort = QUICK if quick else FULL
    chosen = [load_scene(name) for name in scenes]
    destination.folder.mkdir(parents=True, exist_ok=True)
    with console.status("Compiling and timing: a minute with --quick, some minutes without"):
        report = measure(effort, {scene.name: scene for scene in chosen} or None)
    for table in tables(report):
        console.print(table.for_terminal())
    record = {"effort": asdict(effort), **report_record(report), **provenance()}
    destination.save(console, "scene_cost", record, lambda: _picture(report))
    return SUCCESS


def _picture(report: SceneCostReport) -> bytes:
    from experts.report.figures.scene_cost import picture

    return picture(report)
