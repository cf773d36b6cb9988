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
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import SceneError, load_scene
from experts.report import to_json, write_atomically
from experts.report.provenance import provenance
from experts.report.scene_cost.measurement import FULL, QUICK, Effort, SceneCostReport, measure
from experts.report.scene_cost.records import report_record
from experts.report.scene_cost.tables import tables

SUCCESS, UNUSABLE, INTERRUPTED = 0, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    # A file or a pipe has no width of its own; the tables are made for this one.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
    effort = QUICK if options.quick else FULL
    try:
        chosen = [load_scene(name) for name in options.scene or ()]
        options.out.mkdir(parents=True, exist_ok=True)
        with console.status("Compiling and timing: a minute with --quick, some minutes without"):
            report = measure(effort, {scene.name: scene for scene in chosen} or None)
        for table in tables(report):
            console.print(table.for_terminal())
        files = _write(console, options, effort, report)
    except (SceneError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene",
        action="append",
        help="name of a shipped scene, or path of a YAML file; repeatable (default: all shipped scenes, and "
        "the parts of scene paper)",
    )
    parser.add_argument("--quick", action="store_true", help="three scenes, short samples")
    parser.add_argument("--out", type=Path, default=Path("results/scene_cost"), help="output folder")
    parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    return parser.parse_args(arguments)


def _write(
    console: Console, options: argparse.Namespace, effort: Effort, report: SceneCostReport
) -> list[str]:
    """Write the files; their names."""
    record = {"effort": asdict(effort), **report_record(report), **provenance()}
    write_atomically(options.out / "scene_cost.json", to_json(record))
    if not options.picture:
        return ["scene_cost.json"]
    if find_spec("matplotlib") is None:
        console.print('No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False)
        return ["scene_cost.json"]
    from experts.report.figures.scene_cost import picture

    write_atomically(options.out / "scene_cost.png", picture(report))
    return ["scene_cost.json", "scene_cost.png"]


if __name__ == "__main__":
    sys.exit(main())
