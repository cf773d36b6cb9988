"""Measure the optimal-control expert: error against run time, beside other solvers where they are installed.

Four parts, for each scene:
iterations   what a Gauss-Newton and an exact iteration cost, and how many it takes from zero controls
accuracy     seconds until the cost is within 1 %, 0.1 % and 0.01 % of the best one known, for every solver
starts       random starts: how often solvers converge, succeed, and find the best minimum known
horizon      the receding-horizon expert: time per action, and cost beside the plan, also when disturbed
The output folder gets expert.json and, with the extra `plots`, expert.png. An interrupt keeps what there is.
Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import SceneError, list_scenes, load_scene
from experts.checks import check_at_least
from experts.report import to_json, write_atomically
from experts.report.provenance import provenance
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.effort import FULL, PARTS, QUICK, Effort
from experts.report.solvers.records import benchmark_record

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
    try:
        names = options.scene or (list_scenes() if options.full else ["paper"])
        scenes = [load_scene(name) for name in names]
        found = ExpertBenchmark(_effort(options), options.seed)
        parts = options.part or PARTS
        for scene in scenes:
            found.check(scene, parts)
        options.out.mkdir(parents=True, exist_ok=True)
        interrupted = False
        try:
            for scene in scenes:
                found.run(console, scene, parts)
        except KeyboardInterrupt:
            interrupted = True
            console.print("Interrupted: what is measured so far is saved.")
        files = _write(console, options, found, interrupted=interrupted)
    except (SceneError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(str(error), style="red", markup=False)
        return UNUSABLE
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
    return INTERRUPTED if interrupted else SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene",
        action="append",
        help="name of a shipped scene, or path of a YAML file; repeatable (default: paper; with --full: all)",
    )
    parser.add_argument(
        "--part", action="append", choices=PARTS, help="what to measure; repeatable (default: all four)"
    )
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--quick", action="store_true", help="little of each, and no other solvers")
    amount.add_argument("--full", action="store_true", help="200 starts of every shipped scene: hours")
    parser.add_argument("--starts", type=int, help="random starts of each scene (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of random starts and disturbances (default: 0)")
    parser.add_argument("--slow-peers", action="store_true", help="compare also solvers that take minutes")
    parser.add_argument("--no-peers", dest="peers", action="store_false", help="compare only our solvers")
    parser.add_argument("--out", type=Path, default=Path("results/expert"), help="output folder")
    parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    return parser.parse_args(arguments)


def _effort(options: argparse.Namespace) -> Effort:
    effort = QUICK if options.quick else FULL if options.full else Effort()
    starts = effort.starts if options.starts is None else options.starts
    check_at_least("--starts", starts, 1)
    check_at_least("--seed", options.seed, 0)
    return replace(
        effort,
        starts=starts,
        peers=effort.peers and options.peers,
        slow_peers=effort.slow_peers or options.slow_peers,
    )


def _write(
    console: Console, options: argparse.Namespace, found: ExpertBenchmark, *, interrupted: bool
) -> list[str]:
    """Write the files; their names."""
    record = {
        **benchmark_record(found, interrupted=interrupted),
        **provenance("crocoddyl", "pin"),
    }
    write_atomically(options.out / "expert.json", to_json(record))
    solved = [starts for starts in found.random_starts if starts.starts]
    if not options.picture or not (found.comparisons or solved):
        return ["expert.json"]
    if find_spec("matplotlib") is None:
        console.print('No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False)
        return ["expert.json"]
    from experts.report.figures.solvers import picture

    write_atomically(options.out / "expert.png", picture(found.comparisons, solved))
    return ["expert.json", "expert.png"]


if __name__ == "__main__":
    sys.exit(main())
