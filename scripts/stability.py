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
from pathlib import Path

from rich.console import Console

from experts.report import to_json, write_atomically
from experts.report.provenance import provenance

SUCCESS, FAILURE, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    # A file or a pipe has no width of its own; the tables are made for this one.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
    errors = Console(stderr=True, highlight=False)
    if find_spec("mpmath") is None:
        errors.print('The references need mpmath: pip install "dq-space-arm[test]".', markup=False)
        return UNUSABLE
    # Some hundred scenes are compiled; which, the rows say.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    try:
        return _run(console, options)
    except (ValueError, OSError) as error:
        errors.print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED


def _run(console: Console, options: argparse.Namespace) -> int:
    """Try the cases, print them and write the files."""
    from experts.report.stability import FULL, GROUPS, QUICK, Row, Status, run_cases
    from experts.report.stability.records import record
    from experts.report.stability.tables import print_rows

    effort = FULL if options.full else QUICK

    def show(row: Row) -> None:
        console.print(f"{row.seconds:6.1f} s  {row.group}: {row.name}, {row.subject}", markup=False)

    progress = show if options.verbose else lambda row: None
    rows = run_cases(effort, options.group or GROUPS, progress)
    print_rows(console, rows)
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomically(
        options.out / "stability.json", to_json({**record(rows, effort), **provenance("mpmath")})
    )
    files = ["stability.json"]
    if options.picture and any(row.curve for row in rows):
        if find_spec("matplotlib") is None:
            console.print(
                'No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False
            )
        else:
            from experts.report.figures.stability import picture

            write_atomically(options.out / "stability.png", picture(rows))
            files.append("stability.png")
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    return FAILURE if any(row.status is Status.FAILED for row in rows) else SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument("--quick", action="store_true", help="no slow cases, fewer points (the default)")
    effort.add_argument("--full", action="store_true", help="every case: 1e7 steps, 20,000 stages")
    parser.add_argument("--group", action="append", help="only this group of cases; repeatable")
    parser.add_argument("--out", type=Path, default=Path("results/stability"), help="output folder")
    parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    parser.add_argument("--verbose", action="store_true", help="print each case as soon as it is done")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
