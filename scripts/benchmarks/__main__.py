"""Measure the project against its declared bounds, and against its peers where they are installed.

Exit status: 0; 1 if something is less accurate than declared, or an error ended a benchmark, with a sentence
for each shortcoming; 2 if the input is unusable; 130 if interrupted. Times are shown, never judged.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from dq_space_arm_env.command_line.verb_program import run_to_end
from dq_space_arm_env.common.console import table_console

BENCHMARKS = {
    "work-precision": "work_precision",
    "stability": "stability",
    "scene-cost": "scene_cost",
    "solvers": "solvers",
    "throughput": "throughput",
    "rendering": "rendering",
    "basilisk": "basilisk",
    "devices": "devices",
}
"""Packages and modules beside this file, each with a `BENCHMARK`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run benchmarks; returns the exit status."""
    parser = argparse.ArgumentParser("python -m scripts.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(BENCHMARKS)} (default: all)")
    level = parser.add_mutually_exclusive_group()
    level.add_argument("--quick", action="store_true", help="reduced workload: minutes, no other solvers")
    level.add_argument("--full", action="store_true", help="200 random starts, slow peers: hours")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="output folder")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help='override a field of the effort, such as starts=100, only="[stiff joints]", scenes=[payload]',
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"{unknown[0]!r} is not a benchmark; choose from {', '.join(BENCHMARKS)}")
    return run_to_end(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    from scripts.benchmarks.effort import FULL, QUICK, STANDARD
    from scripts.benchmarks.harness import run

    effort = QUICK if options.quick else FULL if options.full else STANDARD
    names = dict.fromkeys(options.names or BENCHMARKS)
    chosen = [import_module(f"scripts.benchmarks.{BENCHMARKS[name]}").BENCHMARK for name in names]
    return run(chosen, effort.changed(tuple(options.set)), options.out, table_console(width=120))


if __name__ == "__main__":
    sys.exit(main())
