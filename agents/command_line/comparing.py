"""`dq-space-arm compare`: agents with controllers, ways of cloning, plans with and without corrections."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from agents.command_line.learning import policies_options
from agents.command_line.names import CONFIGURATION, SCENE, TRAINED_POLICY, OneOf, given
from agents.command_line.results import destination, results_options
from agents.command_line.verb import ManyValued, VerbsWithDefault, keeping


def _controllers() -> Iterable[str]:
    from agents.comparison.command import NONE
    from agents.comparison.controllers import CONTROLLERS

    return [*CONTROLLERS, NONE]


def _mismatches() -> Iterable[str]:
    from agents.residual.conditions import CONDITIONS

    return CONDITIONS


_folder = click.Path(file_okay=False, path_type=Path)


@click.group(
    cls=VerbsWithDefault,
    short_help="Compare controllers and agents, error against run time.",
    examples="""
        compare                                           # the expert's controllers, in an hour
        compare results/agents/ppo-0 -n 50                # and an agent, from 50 starts
        compare cloning                                   # demonstrations needed, with gains and without
        compare residual --policy results/agents/residual-0
    """,
)
def compare() -> None:
    """Compare the expert's controllers and each POLICY: error against run time, one table, one figure.

    Controllers fly plans of the expert: open loop, with its feedback gains, or planned anew at every step.
    All fly from the fixed evaluation starts, and are compared with the optimal costs there. What is
    interrupted goes on when the command is given again. Exit status 1: the expert had to stop, or the file of
    a policy is damaged.
    """


@compare.command(
    cls=ManyValued,
    short_help="Controllers and agents; meant if nothing is named.",
    examples="compare agents a.npz b.npz --controller gains receding --condition all",
)
@policies_options
@click.option(
    "--controller",
    "controllers",
    type=OneOf("controller", _controllers),
    multiple=True,
    help="open-loop, gains, receding, several, or none.  [default: all]",
)
@click.option(
    "--receding-starts", type=int, help="Starts of the receding horizon, a second each.  [default: 100]"
)
@results_options("comparison")
def agents(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str,
    n: int | None,
    conditions: tuple[str, ...],
    workers: int | None,
    controllers: tuple[str, ...],
    receding_starts: int | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> None:
    """Compare the expert's controllers and each POLICY: error against run time, one table, one figure.

    The output folder gets table.md, comparison.json, the rows with each episode, and comparison.png. Runs
    that differ in their seeds alone are also aggregated, from three on.
    """
    from agents.comparison import command

    chosen = given(n=n, conditions=conditions, controllers=controllers, receding_starts=receding_starts)
    options = command.Options((*policies, *more), scene, workers=workers, **chosen)
    with keeping("what is finished is kept, and the same command goes on there"):
        command.run(destination(out, as_json, picture), options)


@compare.command(
    cls=ManyValued,
    examples="""
        compare cloning                                   # ten to a thousand demonstrations, three seeds
        compare cloning --counts 20 100 --seeds 1         # sooner
    """,
)
@click.option(
    "--config",
    type=CONFIGURATION,
    default="cloning-with-gains",
    show_default=True,
    help="What scene, demonstrations, network and optimizer are taken from.",
)
@click.option(
    "--counts",
    type=int,
    multiple=True,
    help="Numbers of demonstrations.  [default: 10 20 50 100 200 500 1000]",
)
@click.option("--seeds", type=int, default=3, show_default=True, help="Trainings of each.")
@click.option("--updates", type=int, default=5000, show_default=True, help="Updates of a training.")
@click.option("--tests", type=int, default=400, show_default=True, help="Starts to fly from.")
@click.option("--demonstrations", type=_folder, help="Folder of demonstrations, in place of new ones.")
@click.option("--test-demonstrations", type=_folder, help="Folder of those to fly from, likewise.")
@results_options("cloning")
def cloning(
    config: str,
    counts: tuple[int, ...],
    seeds: int,
    updates: int,
    tests: int,
    demonstrations: Path | None,
    test_demonstrations: Path | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> None:
    """Compare cloning with and without the expert's feedback gains: success over demonstrations.

    All variants learn from the same demonstrations with the same network and as many updates, and fly from
    the same starts, which none has seen. The output folder gets demonstrations/ and tests/, unless others are
    named, trainings.jsonl, cloning.json and cloning.png. Needs the extra `agents`.
    """
    from agents.imitation import command

    folders = given(demonstrations=demonstrations, test_demonstrations=test_demonstrations)
    options = command.Options(
        config, seeds=seeds, updates=updates, tests=tests, **given(counts=counts), **folders
    )
    with keeping(f"the same command goes on in {out}"):
        command.run(destination(out, as_json, picture), options)


@compare.command(
    cls=ManyValued,
    examples="compare residual results/agents/residual-0 --condition heavy pushes -n 32",
)
@click.argument("policies", nargs=-1, type=TRAINED_POLICY, metavar="[POLICY]...")
@click.option("--policy", "more", type=TRAINED_POLICY, multiple=True, help="The same as POLICY, several.")
@click.option("--scene", type=SCENE, default="paper", show_default=True, help="Name or YAML file.")
@click.option("-n", type=int, default=128, show_default=True, help="Number of starts, the first of the 500.")
@click.option(
    "--condition",
    "conditions",
    type=OneOf("condition", _mismatches),
    multiple=True,
    help="Masses, noise, pushes, several.  [default: all]",
)
@click.option(
    "--tolerance-scale",
    type=float,
    default=0.7,
    show_default=True,
    help="Tolerances that plans meet, relative to the scene's.",
)
@click.option(
    "--receding-starts",
    type=int,
    default=0,
    help="Starts of the receding-horizon expert, some seconds each.  [default: 0, which leaves it out]",
)
@click.option("--workers", type=int, help="Processes that plan.  [default: one per processor]")
@results_options("residual-comparison")
def residual(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str,
    n: int,
    conditions: tuple[str, ...],
    tolerance_scale: float,
    receding_starts: int,
    workers: int | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> None:
    """Fly plans that each POLICY corrects beside the plan alone, under model mismatch.

    All fly from the same evaluation starts and meet the same pushes and noise. The output folder gets
    table.md, comparison.json, the plans, the rows with each episode, and comparison.png. What is interrupted
    goes on when the command is given again. Exit status 1: the expert had to stop, or the file of a policy is
    damaged.
    """
    from agents.residual import command

    settings = given(conditions=conditions)
    options = command.Options(
        (*policies, *more),
        scene,
        n,
        tolerance_scale=tolerance_scale,
        receding_starts=receding_starts,
        workers=workers,
        **settings,
    )
    with keeping("what is finished is kept, and the same command goes on there"):
        command.run(destination(out, as_json, picture), options)
