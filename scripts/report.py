"""Measure everything and write it on one page, as HTML and as Markdown.

Error against run time of integrators and formulations, stiff and extreme cases, what scenes leave out, the
expert beside other solvers, and throughput, each with its tables, figures and captions; machine, versions and
commit at the top. The output folder gets report.html, which needs no other file, report.md with its pictures
beside it, and a JSON file of each part. They are written after each part: an interrupt keeps those before it.
Exit status: 0; 1 if something is less accurate than declared (times are never judged); 2 if a package is
missing or the folder cannot be written; 130 if interrupted.
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from rich.console import Console

from experts.report import to_json, write_atomically
from experts.report.command import guarded, judge, parser_of, table_console
from experts.report.page.parts import PARTS
from experts.report.page.rendering import html_page, markdown_page
from experts.report.page.sections import Section
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
    # Some hundred scenes are compiled on the way.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    console = table_console()
    options.out.mkdir(parents=True, exist_ok=True)
    sections: list[Section] = []
    for name in dict.fromkeys(options.part or PARTS):
        section = _measured(console, name, options)
        sections.append(section)
        _write(options.out, sections)
    console.print(f"{options.out}: report.html, report.md, and JSON of each part", markup=False)
    return judge([sentence for section in sections for sentence in section.shortcomings])


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "report", picture=False)
    parser.add_argument(
        "--part", action="append", choices=tuple(PARTS), help="what to measure; repeatable (default: all)"
    )
    parser.add_argument("--quick", action="store_true", help="little of each: minutes")
    return parser.parse_args(arguments)


def _measured(console: Console, name: str, options: argparse.Namespace) -> Section:
    """Measure a part, show what is under way, and say how long it took."""
    began = perf_counter()
    with console.status(f"Measuring: {name}") as status:
        section = PARTS[name](
            quick=options.quick, announce=lambda what: status.update(f"Measuring: {name}: {what}")
        )
    console.print(f"{section.title}: {perf_counter() - began:.0f} s", markup=False)
    return section


def _write(out: Path, sections: Sequence[Section]) -> None:
    """Write the pages of what is measured so far, and the files of the last part."""
    origin = provenance("crocoddyl", "mpmath", "mujoco", "pin", "scipy")
    last = sections[-1]
    write_atomically(out / f"{last.name}.json", to_json({**last.record, **origin}))
    for figure in last.figures:
        write_atomically(out / f"{figure.name}.png", figure.png)
    write_atomically(out / "report.md", markdown_page(sections, origin))
    write_atomically(out / "report.html", html_page(sections, origin))


if __name__ == "__main__":
    sys.exit(main())
