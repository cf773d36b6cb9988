"""Measure error against run time: every integrator on motions with a reference, and the formulations.

Motions: a tumbling body (30 digits), the paper's maneuver, a fast spin, a stiff joint without and with a
damper, a chain of eight joints (SciPy's DOP853 on Pinocchio's dynamics). For each the tables name the
cheapest method and step that reach 1e-3, 1e-6 and 1e-9 m and rad, and the integrator that a scene should
have. What the expert's solvers cost for which gap is in scripts/benchmark_expert.py.
Accelerations: the paper's system, its Schur complement, minimal coordinates and an articulated-body
algorithm, in two precisions, against 50 digits.
The output folder gets work_precision.json and, with the extra `plots`, work_precision.png.
Exit status: 0; 1 if something is less accurate than declared; 2 if the input is unusable or a package is
missing; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import SceneError
from experts.report import to_json, write_atomically
from experts.report.provenance import provenance
from experts.report.work_precision.benchmark import FORMULATIONS, WorkPrecision, measure, shortcomings
from experts.report.work_precision.cases import CASES
from experts.report.work_precision.effort import FULL, QUICK
from experts.report.work_precision.methods import method_names
from experts.report.work_precision.records import report_record
from experts.report.work_precision.tables import notes, tables

SUCCESS, INACCURATE, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    # A file or a pipe has no width of its own; the tables are made for this one.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        effort = QUICK if options.quick else FULL
        with console.status("") as status:
            found = measure(
                effort, options.case, options.integrator, lambda name: status.update(f"Measuring: {name}")
            )
        for table in tables(found):
            console.print(table.for_terminal())
        for sentence in notes(found):
            console.print(sentence, markup=False)
        files = _write(console, options, found)
    except (SceneError, ModuleNotFoundError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    failures = shortcomings(found)
    for sentence in failures:
        Console(stderr=True, highlight=False).print(sentence, style="red", markup=False)
    return INACCURATE if failures else SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case",
        action="append",
        choices=(*CASES, FORMULATIONS),
        help="what to measure; repeatable (default: all; with --quick: the first few)",
    )
    parser.add_argument(
        "--integrator",
        action="append",
        choices=method_names(),
        help="method to measure; repeatable (default: all, and the paper's form on the maneuver)",
    )
    parser.add_argument("--quick", action="store_true", help="three short motions, few steps, short samples")
    parser.add_argument("--out", type=Path, default=Path("results/work_precision"), help="output folder")
    parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    return parser.parse_args(arguments)


def _write(console: Console, options: argparse.Namespace, found: WorkPrecision) -> list[str]:
    """Write the files; their names."""
    record = {**report_record(found), **provenance("mpmath", "pin", "scipy")}
    write_atomically(options.out / "work_precision.json", to_json(record))
    if not options.picture:
        return ["work_precision.json"]
    if find_spec("matplotlib") is None:
        console.print('No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False)
        return ["work_precision.json"]
    from experts.report.figures.work_precision import picture

    write_atomically(options.out / "work_precision.png", picture(found))
    return ["work_precision.json", "work_precision.png"]


if __name__ == "__main__":
    sys.exit(main())
