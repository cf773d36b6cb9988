"""Measure what scenes leave out: what is not in a scene, not asked for or not used costs nothing.

For each scene, and for each part left out of the first one or added to it: sizes, operations, bytes, time per
step as a ratio to scene `paper`, and compile time; for each output what it costs who asks for it; for a new
process what it imports and compiles; and the megabytes on disk of the package and of each extra.
The output folder gets scene_cost.json and, with the extra `plots`, scene_cost.png.
Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict

from dq_space_arm_env import load_scene
from experts.report.command import SUCCESS, guarded, parser_of, save, table_console
from experts.report.provenance import provenance
from experts.report.scene_cost.measurement import FULL, QUICK, SceneCostReport, measure
from experts.report.scene_cost.records import report_record
from experts.report.scene_cost.tables import tables


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    return guarded(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    console = table_console()
    effort = QUICK if options.quick else FULL
    chosen = [load_scene(name) for name in options.scene or ()]
    options.out.mkdir(parents=True, exist_ok=True)
    with console.status("Compiling and timing: a minute with --quick, some minutes without"):
        report = measure(effort, {scene.name: scene for scene in chosen} or None)
    for table in tables(report):
        console.print(table.for_terminal())
    record = {"effort": asdict(effort), **report_record(report), **provenance()}
    save(console, options, "scene_cost", record, lambda: _picture(report))
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "scene_cost")
    parser.add_argument(
        "--scene",
        action="append",
        help="name of a shipped scene, or path of a YAML file; repeatable (default: all shipped scenes, and "
        "the parts of scene paper)",
    )
    parser.add_argument("--quick", action="store_true", help="three scenes, short samples")
    return parser.parse_args(arguments)


def _picture(report: SceneCostReport) -> bytes:
    from experts.report.figures.scene_cost import picture

    return picture(report)


if __name__ == "__main__":
    sys.exit(main())
