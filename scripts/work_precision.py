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

from experts.report.command import guarded, judge, parser_of, save, table_console
from experts.report.provenance import provenance
from experts.report.work_precision.benchmark import FORMULATIONS, SCENES, WorkPrecision, measure, shortcomings
from experts.report.work_precision.cases import CASES
from experts.report.work_precision.effort import FULL, QUICK
from experts.report.work_precision.methods import method_names
from experts.report.work_precision.records import report_record
from experts.report.work_precision.tables import notes, tables


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
    console = table_console(width=120)
    options.out.mkdir(parents=True, exist_ok=True)
    with console.status("") as status:
        found = measure(
            QUICK if options.quick else FULL,
            options.case,
            options.integrator,
            lambda name: status.update(f"Measuring: {name}"),
        )
    for table in tables(found):
        console.print(table.for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    record = {**report_record(found), **provenance("mpmath", "pin", "scipy")}
    drawn = found.cases or found.formulations is not None
    save(console, options, "work_precision", record, (lambda: _picture(found)) if drawn else None)
    return judge(shortcomings(found))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "work_precision")
    parser.add_argument(
        "--case",
        action="append",
        choices=(*CASES, SCENES, FORMULATIONS),
        help="what to measure; repeatable (default: all; with --quick: the first few)",
    )
    parser.add_argument(
        "--integrator",
        action="append",
        choices=method_names(),
        help="method to measure; repeatable (default: all, and the paper's form on the maneuver)",
    )
    parser.add_argument("--quick", action="store_true", help="three short motions, few steps, short samples")
    return parser.parse_args(arguments)


def _picture(found: WorkPrecision) -> bytes:
    from experts.report.figures.work_precision import picture

    return picture(found)


if __name__ == "__main__":
    sys.exit(main())
