"""`dq-space-arm train` and `evaluate`: agents, from a configuration to numbers beside the expert's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from agents.command_line.names import (
    CONFIGURATION,
    SCENE,
    TRAINED_POLICY,
    OneOf,
    configuration_files,
    given,
    policy_files,
)
from agents.command_line.output import check_writable, message_console, print_document, table_console
from agents.command_line.results import destination, results_options
from agents.command_line.verb import (
    FAILURE,
    SUCCESS,
    ManyValued,
    Verb,
    VerbsWithDefault,
    json_option,
    keeping,
)

_KEPT = "what the expert has solved is kept, and the same command goes on there"

Function = Callable[..., Any]


def _conditions() -> Iterable[str]:
    from agents.evaluation.command import ALL
    from agents.evaluation.conditions import CONDITIONS

    return [*CONDITIONS, ALL]


def policies_options(function: Function) -> Function:
    """Add policies, --scene, -n, --condition and --workers to a verb.

    Args:
        function: The verb's function, with arguments `policies`, `more`, `scene`, `n`, `conditions` and
            `workers`.

    Returns:
        The function with the options.
    """
    for add in (
        click.option("--workers", type=int, help="Processes of the expert.  [default: one per processor]"),
        click.option(
            "--condition",
            "conditions",
            type=OneOf("condition", _conditions),
            multiple=True,
            help="What is changed in the scene, several or all.  [default: training, nothing]",
        ),
        click.option("-n", type=int, help="Number of starts, the first ones.  [default: all 500]"),
        click.option("--scene", type=SCENE, default="paper", show_default=True, help="Name or YAML file."),
        click.option(
            "--policy", "more", type=TRAINED_POLICY, multiple=True, help="The same as POLICY, several."
        ),
        click.argument("policies", nargs=-1, type=TRAINED_POLICY, metavar="[POLICY]..."),
    ):
        function = add(function)
    return function


@click.command(
    cls=Verb,
    short_help="Train an agent as a configuration says.",
    examples="""
        train ppo                                   # a configuration that ships with the package
        train my.yaml --seed 1 --out results/mine   # your own
        train sac --minutes 30                      # stop after half an hour; the same command goes on
    """,
)
@click.argument("configuration", type=CONFIGURATION, required=False)
@click.option("--config", type=CONFIGURATION, help="The same as CONFIGURATION.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the run.  [default: results/agents/<name>-<seed>]",
)
@click.option("--seed", type=int, help="In place of the configuration's.")
@click.option("--total-steps", type=int, help="Environment steps, in place of the configuration's.")
@click.option("--minutes", type=float, help="Limit of time, in place of the configuration's.")
@json_option
def train(
    configuration: str | None,
    config: str | None,
    out: Path | None,
    seed: int | None,
    total_steps: int | None,
    minutes: float | None,
    as_json: bool,
) -> None:
    """Train an agent as CONFIGURATION says, a name or a file.

    The folder of the run gets the resolved configuration, commit and versions, checkpoints, the learning
    curve and the policy, exported. A run that was interrupted or killed goes on at its last checkpoint when
    the same command is given again. Exit status 1: the folder is for another run. Needs the extra `agents`.
    """
    chosen = configuration or config
    if chosen is None or None not in (configuration, config):
        raise click.UsageError(
            f"give one configuration: a YAML file, or one of {', '.join(configuration_files())}",
            click.get_current_context(),
        )
    from agents import training
    from agents.configuration import load_configuration
    from agents.progress import ProgressDisplay

    changes = given(seed=seed, total_steps=total_steps, minutes=minutes)
    checked = training.with_changes(load_configuration(chosen), **changes)
    folder = out or training.default_folder(checked)
    check_writable(folder)
    kept = f"the same command goes on at the last checkpoint in {folder}"
    with keeping(kept), ProgressDisplay(message_console()) as shown:
        training.train(checked, folder, report=shown.update)
    if as_json:
        facts = {"agent": checked.name, "seed": checked.seed, "folder": str(folder)}
        print_document({**facts, "policy": str(folder / "policy.npz")})
    else:
        table_console().print(f"{folder}: the policy is in policy.npz", markup=False, soft_wrap=True)


@click.group(
    cls=VerbsWithDefault,
    short_help="Evaluate policies beside the expert's optimal costs.",
    examples="""
        evaluate results/agents/ppo-0                    # a run, on the 500 evaluation starts of scene paper
        evaluate a.npz b.npz --condition all --out out   # beside each other, also where they were not trained
        evaluate show results/agents/ppo-0               # one flight beside the expert's
    """,
)
def evaluate() -> None:
    """Evaluate each POLICY on the evaluation starts of a scene, beside the expert's optimal costs.

    A policy is a file (.npz, .zip), the folder of a training run, or a name of the zoo. The expert's costs
    are computed at the first use, which takes minutes, and kept in the cache folder. Policies that differ in
    their training seeds alone are also aggregated. Exit status 1: the expert had to stop, or the file of a
    policy is damaged.
    """


@evaluate.command(
    "policies",
    cls=ManyValued,
    short_help="Many flights of each policy; meant if nothing is named.",
    examples="evaluate policies a.npz b.npz -n 50 --json",
)
@policies_options
@click.option(
    "--expert/--no-expert", default=True, help="Whether to compare with the expert's optimal costs."
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for a JSON file for each evaluation, with episodes.",
)
@json_option
def policies_verb(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str,
    n: int | None,
    conditions: tuple[str, ...],
    workers: int | None,
    expert: bool,
    out: Path | None,
    as_json: bool,
) -> None:
    """Evaluate each POLICY on the evaluation starts of a scene, beside the expert's optimal costs."""
    if not policies and not more:
        raise click.UsageError(
            f"name a policy to evaluate: a file, the folder of a run, or one of {', '.join(policy_files())}",
            click.get_current_context(),
        )
    from agents.evaluation import command
    from experts.report.command import table_console as wide_console

    if out is not None:
        check_writable(out)
    chosen = given(n=n, conditions=conditions)
    options = command.Options(
        (*policies, *more), scene=scene, expert=expert, workers=workers, out=out, **chosen
    )
    with keeping(_KEPT):
        summaries = command.run(wide_console(150, stderr=as_json), options)
    if as_json:
        print_document(summaries)


@evaluate.command(
    examples="""
        evaluate show results/agents/ppo-0               # from the nominal start
        evaluate show a.npz --seed 3 -n 5 --gif a.gif    # from five others
    """,
)
@click.argument("policy", type=TRAINED_POLICY, required=False)
@click.option("--policy", "other", type=TRAINED_POLICY, help="The same as POLICY.")
@click.option("--scene", type=SCENE, help="Name or YAML file.  [default: the policy's]")
@click.option("--seed", type=int, help="Start where env.reset(seed=...) does.  [default: nominal start]")
@click.option("-n", type=int, default=1, help="Number of flights, from further seeds; pictures: the first.")
@click.option(
    "--gif",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File for the flight as a moving picture (needs the extra plots).",
)
@results_options("flight")
def show(
    policy: str | None,
    other: str | None,
    scene: str | None,
    seed: int | None,
    n: int,
    gif: Path | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Show POLICY flying the maneuver, beside the expert's solution from the same start.

    The output folder gets flight.json, and the errors of the tip and the inputs over time as pictures. Exit
    status 1: the agent misses the target in one of the flights, or its file is damaged.
    """
    chosen = policy or other
    if chosen is None or None not in (policy, other):
        raise click.UsageError(
            f"name one policy: a file, the folder of a training run, or one of {', '.join(policy_files())}",
            click.get_current_context(),
        )
    from agents.showing import command

    options = command.Options(chosen, scene, seed, n, gif)
    return SUCCESS if command.run(destination(out, as_json, picture), options) else FAILURE
