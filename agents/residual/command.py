"""`dq-space-arm compare residual`: corrected plans beside the plan alone, under model mismatch."""

from collections.abc import Sequence
from dataclasses import dataclass

from agents.evaluation.command import stage_bars
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
from experts.files import write_atomically
from experts.report.command import Destination
from experts.report.provenance import provenance


@dataclass(frozen=True)
class Options:
    """What to compare.

    Attributes:
        policies: Exported policies, or folders of training runs.
        scene: Name of a shipped scene, or path of a YAML file.
        n: Number of starts, the first ones.
        conditions: Names out of `CONDITIONS`; all by default.
        tolerance_scale: Tolerances that plans meet, relative to the scene's.
        receding_starts: Starts of the receding-horizon expert, the first ones; 0 leaves it out.
        workers: Processes that plan; one per processor if None.
    """

    policies: Sequence[str] = ()
    scene: str = "paper"
    n: int = 128
    conditions: Sequence[str] = tuple(CONDITIONS)
    tolerance_scale: float = TOLERANCE_SCALE
    receding_starts: int = 0
    workers: int | None = None

    def words(self) -> list[str]:
        """What the numbers follow from, as it is given on a command line."""
        return [
            *self.policies,
            *("--scene", self.scene, "-n", str(self.n)),
            *("--condition", *self.conditions),
            *("--tolerance-scale", f"{self.tolerance_scale:g}"),
            *("--receding-starts", str(self.receding_starts)),
        ]


def run(destination: Destination, options: Options) -> None:
    """Compare from the same starts, with the same pushes and noise, print the table, and write the files.

    Plans, costs of the expert that knows the masses, and finished rows are taken from the folder.

    Args:
        destination: Where the results go.
        options: What to compare.

    Raises:
        ValueError: If an option, a policy or the scene cannot be used.
        DemonstrationsError: If plans cannot be made.
        PolicyFileError: If a policy's file is damaged.
    """
    scene = load_scene(options.scene)
    read_corrections(options.policies, scene)  # refuses before plans are made
    with stage_bars() as show:
        plans = evaluation_plans(
            scene,
            destination.folder,
            options.n,
            tolerance_scale=options.tolerance_scale,
            workers=options.workers,
            progress=show,
        )
        found = compare_under_mismatch(
            options.policies,
            plans,
            scene,
            conditions=[CONDITIONS[name] for name in options.conditions],
            receding_starts=options.receding_starts,
            out=destination.folder,
            progress=show,
        )
    console = destination.console(150)
    console.print(table(found).for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    again = commands(found, options.words())
    console.print("The table is made again by:")
    for command in again:
        console.print(f"  {command}", markup=False, soft_wrap=True)
    write_atomically(destination.folder / "table.md", markdown(found, again))
    document = {**record(found, again), **provenance()}
    destination.save(console, "comparison", document, lambda: _picture(found))


def _picture(found: Comparison) -> bytes:
    from agents.residual.figure import picture

    return picture(found)
