"""Measure everything and write it on one page, as HTML and as Markdown.

Error against run time of integrators and formulations, what scenes leave out, the expert beside other
solvers, and throughput, each with its tables, figures and captions; machine, versions and commit at the top.
The output folder gets report.html, which needs no other file, and report.md with its pictures beside it.
Exit status: 0; 1 if something is less accurate than declared (times are never judged); 2 if a package is
missing or the folder cannot be written; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from rich.console import Console

from dq_space_arm_env import SceneError
from experts.report import write_atomically
from experts.report.page.parts import PARTS
from experts.report.page.rendering import html_page, markdown_page
from experts.report.page.sections import Section
from experts.report.provenance import provenance

SUCCESS, INACCURATE, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        sections = [
            _measured(console, name, quick=options.quick) for name in dict.fromkeys(options.part or PARTS)
        ]
        files = _write(options.out, sections)
    except (SceneError, ModuleNotFoundError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    except KeyboardInterrupt:
        console.print("Interrupted: nothing is saved.")
        return INTERRUPTED
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    failures = [sentence for section in sections for sentence in section.shortcomings]
    for sentence in failures:
        Console(stderr=True, highlight=False).print(sentence, style="red", markup=False)
    return INACCURATE if failures else SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--part", action="append", choices=tuple(PARTS), help="what to measure; repeatable (default: all)"
    )
    parser.add_argument("--quick", action="store_true", help="little of each: minutes")
    parser.add_argument("--out", type=Path, default=Path("results/report"), help="output folder")
    return parser.parse_args(arguments)


def _measured(console: Console, name: str, *, quick: bool) -> Section:
    """Measure a part, and say how long it took."""
    began = perf_counter()
    with console.status(f"Measuring: {name}"):
        section = PARTS[name](quick=quick)
    console.print(f"{section.title}: {perf_counter() - began:.0f} s", markup=False)
    return section


def _write(out: Path, sections: Sequence[Section]) -> list[str]:
    """Write the files; their names."""
    origin = provenance("crocoddyl", "mpmath", "mujoco", "pin", "scipy")
    write_atomically(out / "report.html", html_page(sections, origin))
    write_atomically(out / "report.md", markdown_page(sections, origin))
    figures = [figure for section in sections for figure in section.figures]
    for figure in figures:
        write_atomically(out / f"{figure.name}.png", figure.png)
    return ["report.html", "report.md", *(f"{figure.name}.png" for figure in figures)]


if __name__ == "__main__":
    sys.exit(main())
