"""Compare agents with the expert's controllers: error against run time, in one table and one figure.

Controllers fly plans of the expert: open loop, with its feedback gains, or planned anew at every step. They
and the agents fly from the fixed evaluation starts, and are compared with the optimal costs there. Plans,
optimal costs and finished rows are kept: what is interrupted goes on when the command is given again.
The output folder gets table.md, comparison.json, the rows with each episode and, with the extra `plots`,
comparison.png.
Exit status: 0; 1 if the expert had to stop or a policy's file is damaged; 2 if the input is unusable; 130 if
interrupted.
"""

import argparse
import sys
from collections.abc import Sequence

from agents.comparison import CONTROLLERS, RECEDING_STARTS, Comparison, compare
from agents.comparison.tables import commands, markdown, notes, record, tables
from agents.evaluation import CONDITIONS, EVALUATION_SEEDS
from agents.evaluation.command import FAILURE, stage_bars
from agents.policies import PolicyFileError
from experts.demonstrations import DemonstrationsError
from experts.files import write_atomically
from experts.report.command import INTERRUPTED, complain, guarded, parser_of, save, table_console
from experts.report.provenance import provenance

NONE = "none"


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
    parser = parser_of(__doc__, "comparison")
    parser.add_argument(
        "--policy",
        nargs="+",
        default=[],
        help="names of the zoo, exported policies (.npz), or folders of training runs; runs that differ in "
        "their seeds alone are also aggregated, from three on",
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument(
        "-n", type=int, default=EVALUATION_SEEDS, help="number of starts, the first ones (default: all 500)"
    )
    parser.add_argument(
        "--condition",
        nargs="+",
        default=["training"],
        choices=[*CONDITIONS, "all"],
        help="what is changed in the scene (default: training, nothing)",
    )
    parser.add_argument(
        "--controller",
        nargs="+",
        default=list(CONTROLLERS),
        choices=[*CONTROLLERS, NONE],
        help="controllers to compare with (default: all)",
    )
    parser.add_argument(
        "--receding-starts",
        type=int,
        default=RECEDING_STARTS,
        help=f"starts of the receding-horizon expert, a second each (default: {RECEDING_STARTS})",
    )
    parser.add_argument("--workers", type=int, help="processes of the expert (default: one per processor)")
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    options.out.mkdir(parents=True, exist_ok=True)
    with stage_bars() as show:
        found = compare(
            options.policy,
            options.scene,
            options.n,
            controllers=() if NONE in options.controller else options.controller,
            conditions=CONDITIONS if "all" in options.condition else options.condition,
            receding_starts=options.receding_starts,
            out=options.out,
            workers=options.workers,
            progress=show,
        )
    console = table_console(width=180)
    for table in tables(found):
        console.print(table.for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    console.print("The rows are made again by:")
    for command in commands(found):
        console.print(f"  {command}", markup=False, soft_wrap=True)
    write_atomically(options.out / "table.md", markdown(found))
    save(console, options, "comparison", {**record(found), **provenance()}, lambda: _picture(found))
    return 0


def _picture(found: Comparison) -> bytes:
    from agents.comparison.figure import picture

    return picture(found)


if __name__ == "__main__":
    sys.exit(main())
