"""The command of `scripts/add_to_zoo.py`: a trained policy becomes one of the zoo.

It is for those who release the package, and no verb of `dq-space-arm`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from agents.evaluation import CONDITIONS, EVALUATION_SEEDS
from agents.evaluation.command import stage_bars
from agents.policies import PolicyFileError
from agents.zoo.adding import add_to_zoo
from agents.zoo.shelf import SHELF
from experts.demonstrations import DemonstrationsError
from experts.report.command import complain, guarded

FAILURE = 1

_DESCRIPTION = """Put a trained policy into the zoo, with its evaluation and its model card.

It is evaluated on the 500 evaluation starts, under all conditions. The card follows from the policy's file
and this evaluation. The zoo takes policies that follow from a configuration and a scene of the package, up to
2 MB in all.
Exit status: 0; 1 if the expert had to stop or the policy's file is damaged; 2 if the input is unusable; 130
if interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(
        description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", help="folder of a training run, or an exported policy (.npz)")
    parser.add_argument("--name", help="name in the zoo (default: the agent's)")
    parser.add_argument(
        "--condition",
        nargs="+",
        default=list(CONDITIONS),
        choices=CONDITIONS,
        help="what to evaluate it under, besides training (default: all)",
    )
    parser.add_argument(
        "-n", type=int, default=EVALUATION_SEEDS, help="number of evaluation starts (default: all 500)"
    )
    parser.add_argument(
        "--training", metavar="COMMAND", help="what trains it, if that is no configuration of the package"
    )
    parser.add_argument("--zoo", type=Path, default=SHELF, help="folder of the zoo (default: the package's)")
    parser.add_argument("--workers", type=int, help="processes of the expert (default: one per processor)")
    options = parser.parse_args(arguments)
    return guarded(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    try:
        with stage_bars() as show:
            written = add_to_zoo(
                options.run,
                options.name,
                conditions=options.condition,
                n=options.n,
                training=options.training,
                shelf=options.zoo,
                workers=options.workers,
                progress=show,
            )
    except (DemonstrationsError, PolicyFileError) as error:
        complain([str(error)])
        return FAILURE
    Console(highlight=False).print(f"{written}: its card; weights and evaluation beside it", markup=False)
    return 0
