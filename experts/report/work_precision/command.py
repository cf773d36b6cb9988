"""Error against run time as a command: what it prints, writes, and how it ends."""

from collections.abc import Sequence

from experts.report.command import Destination, judge
from experts.report.provenance import provenance
from experts.report.work_precision.benchmark import FORMULATIONS, SCENES, WorkPrecision, measure, shortcomings
from experts.report.work_precision.cases import CASES
from experts.report.work_precision.effort import FULL, QUICK
from experts.report.work_precision.records import report_record
from experts.report.work_precision.tables import notes, tables

MEASURED = (*CASES, SCENES, FORMULATIONS)
"""What can be measured: motions, what scenes need, formulations."""


def run(
    destination: Destination,
    *,
    quick: bool = False,
    cases: Sequence[str] = (),
    integrators: Sequence[str] = (),
) -> int:
    """Measure; `work_precision.json` and `work_precision.png` hold the curves.

    Args:
        destination: Where results go.
        quick: Whether to measure little.
        cases: Out of `MEASURED`; all if there are none, or, if quick, the first few.
        integrators: Methods to measure; all if there are none.

    Returns:
        Exit status: 0, or 1 if something is less accurate than declared.

    Raises:
        ModuleNotFoundError: If a package that references come from is not installed.
    """
    console = destination.console(width=120)
    destination.folder.mkdir(parents=True, exist_ok=True)
    with console.status("") as status:
        found = measure(
            QUICK if quick else FULL,
            list(cases) or None,
            list(integrators) or None,
            lambda name: status.update(f"Measuring: {name}"),
        )
    for table in tables(found):
        console.print(table.for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    record = {**report_record(found), **provenance("mpmath", "pin", "scipy")}
    drawn = found.cases or found.formulations is not None
    destination.save(console, "work_precision", record, (lambda: _picture(found)) if drawn else None)
    return judge(shortcomings(found))


def _picture(found: WorkPrecision) -> bytes:
    from experts.report.figures.work_precision import picture

    return picture(found)
