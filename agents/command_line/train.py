"""`dq-space-arm train`: agents from configurations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agents.command_line.agent_policies import CONFIGURATION, configuration_files
from dq_space_arm_env.command_line.names import SCENE, given
from dq_space_arm_env.command_line.verb import json_option, keeping
from dq_space_arm_env.common.console import (
    FAILURE,
    SUCCESS,
    complain,
    message_console,
    print_document,
    table_console,
)
from dq_space_arm_env.common.files import check_writable
from experts.command_line.ray_option import chosen_executor, ray_option

if TYPE_CHECKING:
    from agents.configuration import AgentConfiguration


@click.command(
    short_help="Train agents from configurations.",
    epilog="""\b
        Examples:
          dq-space-arm train ppo                                  # a configuration that ships
          dq-space-arm train my.yaml --seed 1 --out results/mine  # your own
          dq-space-arm train apg --scene my-scene.yaml            # in a scene of your own
          dq-space-arm train sac --minutes 30                     # half an hour; with more, it goes on
          dq-space-arm train apg ppo --seeds 10                   # twenty runs, on all cores, one table
          dq-space-arm train apg ppo --seeds 10 --ray             # the machines of a Ray cluster
    """,
)
@click.argument("configurations", type=CONFIGURATION, nargs=-1, metavar="[CONFIGURATION]...")
@click.option("--config", type=CONFIGURATION, help="Same as CONFIGURATION.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the run; with several, of their folders.  [default: results/agents/<name>-<seed>]",
)
@click.option("--scene", type=SCENE, help="Name or YAML file; replaces the configuration's.")
@click.option("--seed", type=int, help="Replaces the configuration's; with --seeds, the first one.")
@click.option("--seeds", type=int, help="Train with so many seeds, each in a folder of its own.")
@click.option("--total-steps", type=int, help="Environment steps; replaces the configuration's.")
@click.option("--minutes", type=float, help="Time limit; replaces the configuration's.")
@click.option("--workers", type=int, help="Processes of several runs.  [default: one per processor]")
@ray_option
@json_option
def train(
    configurations: tuple[str, ...],
    config: str | None,
    out: Path | None,
    scene: str | None,
    seed: int | None,
    seeds: int | None,
    total_steps: int | None,
    minutes: float | None,
    workers: int | None,
    ray: str | None,
    as_json: bool,
) -> int:
    """Train an agent as CONFIGURATION specifies, a name or a file.

    The folder of the run receives the resolved configuration, commit and versions, checkpoints, the learning
    curve and the exported policy. Re-run the command to resume an interrupted run at its last checkpoint:
    it ends with the same weights. Nothing in the folder is executed.

    Several configurations or --seeds are trained side by side, each run in its folder. Finished runs are
    kept, others resumed. One that fails does not stop the others. At the end there is one table, and the same
    in runs.json beside the folders of the runs. A cluster's machines need a file system in common.
    Exit status 1: the folder belongs to another run, or one of several runs failed. All but policy
    gradients (apg) need the extra `agents`.
    """
    chosen = (*configurations, *([config] if config is not None else []))
    context = click.get_current_context()
    if not chosen:
        raise click.UsageError(
            f"give a configuration: a YAML file, or one of {', '.join(configuration_files())}", context
        )
    several = len(chosen) > 1 or seeds is not None
    if not several and (workers is not None or ray is not None):
        raise click.UsageError("--workers and --ray are for several runs: give --seeds", context)
    from agents import training
    from agents.configuration import load_configuration

    changes = given(total_steps=total_steps, minutes=minutes, scene=scene)
    checked = [training.with_changes(load_configuration(each), **changes) for each in chosen]
    if several:
        return _train_several(checked, 1 if seeds is None else seeds, seed, out, workers, ray, as_json)
    return _train_one(training.with_changes(checked[0], seed=seed), out, as_json)


def _train_one(checked: AgentConfiguration, out: Path | None, as_json: bool) -> int:
    from agents import training
    from agents.run_folder import learned
    from dq_space_arm_env.common.progress import ProgressDisplay

    folder = out or training.default_folder(checked)
    check_writable(folder)
    kept = f"run the same command to resume at the last checkpoint in {folder}"
    finished = training.is_trained(checked, folder)
    if not finished:
        with keeping(kept), ProgressDisplay(message_console()) as shown:
            training.train(checked, folder, report=shown.update)
    curve = learned(folder)
    reached = curve[-1]["success_rate"] if curve else None
    if as_json:
        facts = {"agent": checked.name, "seed": checked.seed, "folder": str(folder)}
        print_document({**facts, "policy": str(folder / "policy.npz"), "success_rate": reached})
    else:
        before = "finished before, and not trained again; " if finished else ""
        after = "" if reached is None else f"; success from {reached:.0%} of the validation starts"
        said = f"{folder}: {before}the policy is in policy.npz{after}"
        table_console().print(said, markup=False, soft_wrap=True)
    return SUCCESS


def _train_several(
    checked: list[AgentConfiguration],
    seeds: int,
    first: int | None,
    out: Path | None,
    workers: int | None,
    ray: str | None,
    as_json: bool,
) -> int:
    from agents.experiments import many_trainings
    from dq_space_arm_env.common.files import json_value
    from dq_space_arm_env.common.progress import ProgressDisplay
    from dq_space_arm_env.common.provenance import provenance
    from dq_space_arm_env.common.results import Destination

    folder = out or Path("results") / "agents"
    check_writable(folder)
    executor = chosen_executor(workers, ray) or many_trainings.training_executor(checked)
    kept = f"finished runs are kept; run the same command to resume the others in {folder}"
    with keeping(kept), ProgressDisplay(message_console()) as shown:
        rows = many_trainings.train_seeds(
            checked, seeds, folder, first=first, executor=executor, report=shown.update
        )
    summaries = [*many_trainings.seed_summaries(rows)]
    destination = Destination(folder, picture=False, document=as_json)
    record: dict[str, Any] = json_value({"runs": rows, "seeds": summaries, **provenance()})
    written = destination.write("runs", record, {})
    console = destination.console()
    console.print(many_trainings.trainings_table(rows).for_terminal())
    if summaries:
        console.print(many_trainings.seeds_table(summaries).for_terminal())
    destination.tell(console, written, record)
    failed = [row for row in rows if row["outcome"] == "failed"]
    for row in failed:
        complain(f"{row['agent']}, seed {row['seed']}: {row['failure']}", label="Failed: ")
    return FAILURE if failed else SUCCESS
