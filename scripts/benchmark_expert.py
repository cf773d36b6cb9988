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

from dq_space_arm_env import list_scenes, load_scene
from experts.checks import check_at_least
from experts.report.command import INTERRUPTED, SUCCESS, guarded, parser_of, save, table_console
from experts.report.provenance import provenance
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.effort import FULL, PARTS, QUICK, Effort
from experts.report.solvers.records import benchmark_record


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
    console = table_console()
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
    record = {**benchmark_record(found, interrupted=interrupted), **provenance("crocoddyl", "pin")}
    solved = [starts for starts in found.random_starts if starts.starts]

    def picture() -> bytes:
        from experts.report.figures.solvers import picture as draw

        return draw(found.comparisons, solved)

    save(console, options, "expert", record, picture if found.comparisons or solved else None)
    return INTERRUPTED if interrupted else SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "expert")
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


if __name__ == "__main__":
    sys.exit(main())
