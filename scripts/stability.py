"""Try stiff and extreme cases on every formulation, integrator, precision, the environment and the expert.

Each case has a row: handled, with its error; refused, with the sentence that the user sees; not claimed, with
the limit of the method; or failed. The output folder gets stability.json and, with the extra `plots`,
stability.png. References with 50 digits need mpmath, of the extra `test`.
Exit status: 0; 1 if a case failed; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from experts.report.command import guarded, judge, parser_of, save, table_console
from experts.report.provenance import provenance


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
    if find_spec("mpmath") is None:
        raise ModuleNotFoundError('the references need mpmath: pip install "dq-space-arm[test]"')
    from experts.report.stability import FULL, GROUPS, QUICK, Row, run_cases
    from experts.report.stability.records import record
    from experts.report.stability.tables import failures, print_rows

    # Some hundred scenes are compiled; which, the rows say.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    console = table_console(width=160)
    effort = FULL if options.full else QUICK

    def show(row: Row) -> None:
        if options.verbose:
            console.print(f"{row.seconds:6.1f} s  {row.group}: {row.name}, {row.subject}", markup=False)

    options.out.mkdir(parents=True, exist_ok=True)
    rows = run_cases(effort, options.group or GROUPS, show)
    print_rows(console, rows)

    def picture() -> bytes:
        from experts.report.figures.stability import picture as draw

        return draw(rows)

    drawn = picture if any(row.curve for row in rows) else None
    save(console, options, "stability", {**record(rows, effort), **provenance("mpmath")}, drawn)
    return judge(failures(rows))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "stability")
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument("--quick", action="store_true", help="no slow cases, fewer points (the default)")
    effort.add_argument("--full", action="store_true", help="every case: 1e7 steps, 20,000 stages")
    parser.add_argument("--group", action="append", help="only this group of cases; repeatable")
    parser.add_argument("--verbose", action="store_true", help="print each case as soon as it is done")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
