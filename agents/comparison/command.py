"""`dq-space-arm compare`: agents and the expert's controllers in one table and one figure."""

from collections.abc import Sequence
from dataclasses import dataclass

from agents.comparison.comparing import RECEDING_STARTS, Comparison, compare
from agents.comparison.controllers import CONTROLLERS
from agents.comparison.tables import commands, markdown, notes, record, tables
from agents.evaluation import CONDITIONS, EVALUATION_SEEDS
from agents.evaluation.command import ALL, stage_bars
from experts.files import write_atomically
from experts.report.command import Destination
from experts.report.provenance import provenance

NONE = "none"
"""In place of controllers."""


@dataclass(frozen=True)
class Options:
    """What to compare.

    Attributes:
        policies: Names of the zoo, exported policies, or folders of training runs.
        scene: Name of a shipped scene, or path of a YAML file.
        n: Number of starts, the first ones.
        conditions: What is changed in the scene, or `ALL`.
        controllers: Controllers to compare with, or `NONE`.
        receding_starts: Starts of the receding-horizon expert.
        workers: Processes of the expert; one per processor if None.
    """

    policies: Sequence[str] = ()
    scene: str = "paper"
    n: int = EVALUATION_SEEDS
    conditions: Sequence[str] = ("training",)
    controllers: Sequence[str] = tuple(CONTROLLERS)
    receding_starts: int = RECEDING_STARTS
    workers: int | None = None


def run(destination: Destination, options: Options) -> None:
    """Compare, print the tables, and write the files; finished rows are taken from the folder.

    Args:
        destination: Where the results go.
        options: What to compare.

    Raises:
        ValueError: If an option, a policy or the scene cannot be used.
        DemonstrationsError: If the expert had to stop.
        PolicyFileError: If a policy's file is damaged.
    """
    with stage_bars() as show:
        found = compare(
            options.policies,
            options.scene,
            options.n,
            controllers=() if NONE in options.controllers else options.controllers,
            conditions=CONDITIONS if ALL in options.conditions else options.conditions,
            receding_starts=options.receding_starts,
            out=destination.folder,
            workers=options.workers,
            progress=show,
        )
    console = destination.console(180)
    for table in tables(found):
        console.print(table.for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    console.print("The rows are made again by:")
    for command in commands(found):
        console.print(f"  {command}", markup=False, soft_wrap=True)
    write_atomically(destination.folder / "table.md", markdown(found))
    document = {**record(found), **provenance()}
    destination.save(console, "comparison", document, lambda: _picture(found))


def _picture(found: Comparison) -> bytes:
    from agents.comparison.figure import picture

    return picture(found)
