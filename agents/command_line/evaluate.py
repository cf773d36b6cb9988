"""`dq-space-arm evaluate`: policies beside the expert's optimal costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from agents.command_line.agent_policies import TRAINED_POLICY, policy_files
from dq_space_arm_env.command_line.names import SCENE, OneOf, given, normalize_option, trust_option
from dq_space_arm_env.command_line.results_options import destination, results_options
from dq_space_arm_env.command_line.verb import (
    DefaultGroup,
    MultiWordCommand,
    json_option,
    keeping,
)
from dq_space_arm_env.common.console import FAILURE, SUCCESS, print_document
from dq_space_arm_env.common.files import check_writable, check_writable_file
from experts.command_line.ray_option import chosen_executor, ray_option

Function = Callable[..., Any]


def _conditions() -> Iterable[str]:
    from agents.evaluation.conditions import CONDITIONS
    from agents.evaluation.evaluation_verbs import ALL

    return [*CONDITIONS, ALL]


def policies_options(
    conditions: Callable[[], Iterable[str]] = _conditions,
    changes: str = "Changes of the scene, several or all.  [default: training, none]",
    starts: str = "Number of evaluation starts.  [default: all 500]",
    scene: str | None = "paper",
) -> Callable[[Function], Function]:
    """Add policies, --policy, --scene, -n, --condition, --workers and --ray to a verb."""

    def add(function: Function) -> Function:
        condition = OneOf("condition", conditions)
        for option in (
            ray_option,
            click.option(
                "--workers", type=int, help="Processes of the expert.  [default: one per processor]"
            ),
            click.option("--condition", "conditions", type=condition, multiple=True, help=changes),
            click.option("-n", type=int, help=starts),
            click.option(
                "--scene",
                type=SCENE,
                default=scene,
                help=f"Name or YAML file.  [default: {scene or 'that of the policies, or paper'}]",
            ),
            click.option(
                "--policy", "more", type=TRAINED_POLICY, multiple=True, help="Same as POLICY, several."
            ),
            click.argument("policies", nargs=-1, type=TRAINED_POLICY, metavar="[POLICY]..."),
        ):
            function = option(function)
        return function

    return add


@click.group(
    cls=DefaultGroup,
    short_help="Evaluate policies beside the expert's optimal costs.",
    epilog="""\b
        Examples:
          dq-space-arm evaluate results/agents/ppo-0                   # a run on the 500 evaluation starts
          dq-space-arm evaluate a.npz b.npz --condition all --out out  # two, under all conditions
          dq-space-arm evaluate show results/agents/ppo-0              # one flight beside the expert's
    """,
)
def evaluate() -> None:
    """Evaluate each POLICY on the evaluation starts of a scene, beside the expert's optimal costs.

    A policy is a file (.npz, .onnx, .zip), the folder of a training run, or a name of the zoo. The first use
    computes the expert's costs, in minutes, and caches them. Three or more policies that differ only in their
    training seeds are also aggregated. Exit status 1: the expert had to stop.
    """


@evaluate.command(
    "policies",
    cls=MultiWordCommand,
    short_help="Many flights of each policy (the default).",
    epilog="""\b
        Examples:
          dq-space-arm evaluate policies a.npz b.npz -n 50 --json
    """,
)
@policies_options(scene=None)
@click.option(
    "--expert/--no-expert", default=True, help="Whether to compare with the expert's optimal costs."
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for a JSON file per evaluation, with its episodes, and one for all seeds of an agent.",
)
@normalize_option
@trust_option
@json_option
def policies_verb(
    policies: tuple[str, ...],
    more: tuple[str, ...],
    scene: str | None,
    n: int | None,
    conditions: tuple[str, ...],
    workers: int | None,
    ray: str | None,
    expert: bool,
    out: Path | None,
    normalize: Path | None,
    trust: bool,
    as_json: bool,
) -> None:
    """Evaluate each POLICY on the evaluation starts of a scene, beside the expert's optimal costs."""
    if not policies and not more:
        raise click.UsageError(
            f"name a policy to evaluate: a file, the folder of a run, or one of {', '.join(policy_files())}",
            click.get_current_context(),
        )
    executor = chosen_executor(workers, ray)
    from agents.evaluation.evaluation_verbs import evaluate_policies
    from agents.evaluation.plan_followers import CONTROLLERS
    from dq_space_arm_env.common.console import table_console as wide_console

    if out is not None:
        check_writable(out)
    chosen = given(n=n, conditions=conditions)
    named = (*policies, *more)
    for name in named:
        if name in CONTROLLERS and not Path(name).exists():
            raise click.UsageError(
                f"{name}: is a controller of the expert: `dq-space-arm compare --controller {name}` flies it",
                click.get_current_context(),
            )
    with keeping("the expert's solutions are kept; run the same command to resume"):
        console = wide_console(150, stderr=as_json)
        summaries = evaluate_policies(
            console,
            named,
            scene,
            expert=expert,
            executor=executor,
            out=out,
            trust=trust,
            normalize=normalize,
            **chosen,
        )
    if as_json:
        print_document(summaries)


@evaluate.command(
    epilog="""\b
        Examples:
          dq-space-arm evaluate show results/agents/ppo-0             # from the nominal start
          dq-space-arm evaluate show a.npz --seed 3 -n 5 --gif a.gif  # from five others
    """
)
@click.argument("policy", type=TRAINED_POLICY, required=False)
@click.option("--policy", "other", type=TRAINED_POLICY, help="Same as POLICY.")
@click.option("--scene", type=SCENE, help="Name or YAML file.  [default: the policy's]")
@click.option("--seed", type=int, help="Start where env.reset(seed=...) does.  [default: nominal start]")
@click.option(
    "-n", type=int, default=1, help="Number of flights, from consecutive seeds; pictures show the first."
)
@click.option(
    "--gif",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Animate the flight in this file (needs the extra plots).",
)
@normalize_option
@trust_option
@results_options("flight")
def show(
    policy: str | None,
    other: str | None,
    scene: str | None,
    seed: int | None,
    n: int,
    gif: Path | None,
    normalize: Path | None,
    trust: bool,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Show POLICY flying the maneuver, beside the expert's solution from the same start.

    The output folder receives flight.json, and pictures of tip errors and inputs over time. Exit status 1:
    the agent misses the target in one of the flights.
    """
    chosen = policy or other
    if chosen is None or None not in (policy, other):
        raise click.UsageError(
            f"name one policy: a file, the folder of a training run, or one of {', '.join(policy_files())}",
            click.get_current_context(),
        )
    from agents.evaluation.showing import show as fly_and_show

    if gif is not None:
        check_writable_file(gif, chosen, scene, normalize)
    written = destination(out, as_json, picture)
    reached = fly_and_show(written, chosen, scene, seed, n, gif, trust=trust, normalize=normalize)
    return SUCCESS if reached else FAILURE
