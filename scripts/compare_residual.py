"""Compare corrections of a plan with the plan alone and the receding-horizon expert, under model mismatch.

All fly from the evaluation starts and meet the same pushes and noise. Plans, costs of the expert that knows
the masses, and finished rows are kept: what is interrupted goes on when the command is given again.
The output folder gets table.md, comparison.json, the plans, the rows with each episode and, with the extra
`plots`, comparison.png.
Exit status: 0; 1 if the expert had to stop or a policy's file is damaged; 2 if the input is unusable; 130 if
interrupted.
"""

import argparse
import sys
from collections.abc import Sequence

from agents.evaluation import EVALUATION_SEEDS
from agents.evaluation.command import FAILURE, stage_bars
from agents.policies import PolicyFileError
from agents.residual.conditions import CONDITIONS
from agents.residual.evaluation import (
    TOLERANCE_SCALE,
    Comparison,
    compare_under_mismatch,
    evaluation_plans,
    read_corrections,
)
from agents.residual.tables import commands, markdown, notes, record, table
from dq_space_arm_env import load_scene
from experts.demonstrations import DemonstrationsError
from experts.files import write_atomically
from experts.report.command import INTERRUPTED, complain, guarded, parser_of, save, table_console
from experts.report.provenance import provenance

STARTS = 128


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)

    def run() -> int:
        try:
            return _run(options)
        except (DemonstrationsError, PolicyFileError) as error:
            complain([str(error)])
            return FAILURE
        except KeyboardInterrupt:
            complain(["Interrupted: what is finished is kept, and the same command goes on there."])
            return INTERRUPTED

    return guarded(run)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "residual-comparison")
    parser.add_argument(
        "--policy", nargs="+", default=[], help="exported policies (.npz), or folders of training runs"
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument(
        "-n",
        type=int,
        default=STARTS,
        help=f"number of starts, the first of the {EVALUATION_SEEDS} (default: {STARTS})",
    )
    parser.add_argument(
        "--condition", nargs="+", default=list(CONDITIONS), choices=[*CONDITIONS], help="(default: all)"
    )
    parser.add_argument(
        "--tolerance-scale",
        type=float,
        default=TOLERANCE_SCALE,
        help=f"tolerances that plans meet, relative to the scene's (default: {TOLERANCE_SCALE})",
    )
    parser.add_argument(
        "--receding-starts",
        type=int,
        default=0,
        help="starts of the receding-horizon expert, some seconds each (default: 0, which leaves it out)",
    )
    parser.add_argument("--workers", type=int, help="processes that plan (default: one per processor)")
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    scene = load_scene(options.scene)
    read_corrections(options.policy, scene)  # refuses before plans are made
    with stage_bars() as show:
        plans = evaluation_plans(
            scene,
            options.out,
            options.n,
            tolerance_scale=options.tolerance_scale,
            workers=options.workers,
            progress=show,
        )
        found = compare_under_mismatch(
            options.policy,
            plans,
            scene,
            conditions=[CONDITIONS[name] for name in options.condition],
            receding_starts=options.receding_starts,
            out=options.out,
            progress=show,
        )
    console = table_console(width=150)
    console.print(table(found).for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    again = commands(found, _words(options))
    console.print("The table is made again by:")
    for command in again:
        console.print(f"  {command}", markup=False, soft_wrap=True)
    write_atomically(options.out / "table.md", markdown(found, again))
    content = {**record(found, again), **provenance()}
    save(console, options, "comparison", content, lambda: _picture(found))
    return 0


def _words(options: argparse.Namespace) -> list[str]:
    """The options that the numbers follow from, as they are given on a command line."""
    return [
        *(["--policy", *options.policy] if options.policy else []),
        *("--scene", options.scene, "-n", str(options.n), "--condition", *options.condition),
        *("--tolerance-scale", f"{options.tolerance_scale:g}"),
        *("--receding-starts", str(options.receding_starts)),
    ]


def _picture(found: Comparison) -> bytes:
    from agents.residual.figure import picture

    return picture(found)


if __name__ == "__main__":
    sys.exit(main())
