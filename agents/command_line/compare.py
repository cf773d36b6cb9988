"""`dq-space-arm compare`: agents with controllers, ways of cloning, plans with and without corrections."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from agents.command_line.agent_policies import CONFIGURATION
from agents.command_line.evaluate import policies_options
from dq_space_arm_env.command_line.names import OneOf, given, normalize_option, trust_option
from dq_space_arm_env.command_line.results_options import destination, results_options
from dq_space_arm_env.command_line.verb import DefaultGroup, MultiWordCommand, keeping
from experts.command_line.ray_option import chosen_executor


def _controllers() -> Iterable[str]:
    from agents.evaluation.evaluation_verbs import NONE
    from agents.evaluation.plan_followers import CONTROLLERS

    return [*CONTROLLERS, NONE]


def _mismatches() -> Iterable[str]:
    from agents.residual.mismatch import CONDITIONS

    return CONDITIONS


_folder = click.Path(file_okay=False, path_type=Path)


@click.group(
    cls=DefaultGroup,
    short_help="Compare controllers and agents, error against run time.",
    epilog="""\b
        Examples:
          dq-space-arm compare                             # the expert's controllers, in an hour
          dq-space-arm compare results/agents/ppo-0 -n 50  # and an agent, from 50 starts
          dq-space-arm compare cloning                     # demonstrations needed, with gains and without
          dq-space-arm compare residual --policy results/agents/residual-0
    """,
)
def compare() -> None:
    """Compare the expert's controllers and each POLICY: error against run time, one table, one figure.

    Controllers fly the expert's plans: open loop, with its feedback gains, or replanned at every step. All
    fly from the fixed evaluation starts and are compared with the optimal costs there. Re-run the command to
    resume. Exit status 1: the expert had to stop.
    """


@compare.command(
    cls=MultiWordCommand,
    short_help="Controllers and agents (the default).",
    epilog="""\b
        Examples:
          dq-space-arm compare agents a.npz b.npz --controller gains receding --condition all
    """,
)
@policies_options()
@click.option(
    "--controller",
    "controllers",
    type=OneOf("controller", _controllers),
    multiple=True,
    help="open-loop, gains, receding, several, or none.  [default: all]",
)
@click.option(
    "--receding-starts",
    type=int,
    help="Starts of the receding-horizon expert, a second each.  [default: 100]",
)
@normalize_option
@trust_option
@results_options("comparison")
def agents(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str,
    n: int | None,
    conditions: tuple[str, ...],
    workers: int | None,
    ray: str | None,
    controllers: tuple[str, ...],
    receding_starts: int | None,
    normalize: Path | None,
    trust: bool,
    out: Path,
    picture: bool,
    as_json: bool,
) -> None:
    """Compare the expert's controllers and each POLICY: error against run time, one table, one figure.

    The output folder receives table.md, comparison.json, the rows with each episode, and comparison.png.
    Three or more runs that differ only in their seeds are also aggregated. Learning curves need the expert's
    optima of their own starts, which are solved once.
    """
    if receding_starts is not None and controllers and "receding" not in controllers:
        raise ValueError(f"--receding-starts: {receding_starts}, but --controller leaves out receding")
    executor = chosen_executor(workers, ray)
    from agents.evaluation.evaluation_verbs import compare_controllers

    chosen = given(n=n, conditions=conditions, controllers=controllers, receding_starts=receding_starts)
    with keeping("finished rows are kept; run the same command to resume"):
        written = destination(out, as_json, picture)
        compare_controllers(
            written,
            (*policies, *more),
            scene,
            executor=executor,
            trust=trust,
            normalize=normalize,
            **chosen,
        )


@compare.command(
    cls=MultiWordCommand,
    epilog="""\b
        Examples:
          dq-space-arm compare cloning                            # ten to 1000 demonstrations, 5 seeds
          dq-space-arm compare cloning --counts 20 100 --seeds 1  # a shorter run
    """,
)
@click.option(
    "--config",
    type=CONFIGURATION,
    default="cloning-with-gains",
    show_default=True,
    help="Source of scene, demonstrations, network and optimizer.",
)
@click.option(
    "--counts",
    type=int,
    multiple=True,
    help="Numbers of demonstrations.  [default: 10 20 50 100 200 500 1000]",
)
@click.option("--seeds", type=int, default=5, show_default=True, help="Trainings per variant.")
@click.option("--updates", type=int, default=5000, show_default=True, help="Updates per training.")
@click.option("--tests", type=int, default=400, show_default=True, help="Starts to fly from.")
@click.option("--demonstrations", type=_folder, help="Folder of demonstrations for all trainings.")
@click.option("--test-demonstrations", type=_folder, help="The same for the starts to fly from.")
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

    Each seed draws its own demonstrations, from which all variants learn with the same network and number of
    updates, and all fly from the same held-out starts. The output folder receives trainings.jsonl,
    cloning.json and cloning.png, and demonstrations and tests unless you name others. Needs the extra
    `agents`.
    """
    from agents.evaluation import data_efficiency_command as command

    folders = given(demonstrations=demonstrations, test_demonstrations=test_demonstrations)
    options = command.Options(
        config, seeds=seeds, updates=updates, tests=tests, **given(counts=counts), **folders
    )
    with keeping(f"run the same command to resume in {out}"):
        command.run(destination(out, as_json, picture), options)


@compare.command(
    cls=MultiWordCommand,
    epilog="""\b
        Examples:
          dq-space-arm compare residual results/agents/residual-0 --condition heavy pushes -n 32
    """,
)
@policies_options(
    _mismatches,
    "Model mismatch: masses, noise, pushes; several.  [default: all]",
    "Number of evaluation starts.  [default: 128]",
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
    help="Starts of the receding-horizon expert, some seconds each; 0 leaves it out.  [default: 0]",
)
@results_options("residual-comparison")
def residual(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str,
    n: int | None,
    conditions: tuple[str, ...],
    tolerance_scale: float,
    receding_starts: int,
    workers: int | None,
    ray: str | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> None:
    """Fly plans that each POLICY corrects beside the plan alone, under model mismatch.

    All fly from the same evaluation starts and meet the same pushes and noise. The output folder receives
    table.md, comparison.json, the plans, the rows with each episode, and comparison.png. Re-run the command
    to resume. Exit status 1: the expert had to stop.
    """
    executor = chosen_executor(workers, ray)
    from agents.residual.mismatch_comparison import compare_corrections

    with keeping("finished rows are kept; run the same command to resume"):
        compare_corrections(
            destination(out, as_json, picture),
            (*policies, *more),
            scene,
            128 if n is None else n,
            tolerance_scale=tolerance_scale,
            receding_starts=receding_starts,
            executor=executor,
            **given(conditions=conditions),
        )
