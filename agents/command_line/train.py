"""`dq-space-arm train`: an agent from a configuration."""

from __future__ import annotations

from pathlib import Path

import click

from agents.command_line.agent_policies import CONFIGURATION, configuration_files
from dq_space_arm_env.command_line.names import given
from dq_space_arm_env.command_line.verb import json_option, keeping, print_document
from dq_space_arm_env.common.console import message_console, table_console
from dq_space_arm_env.common.files import check_writable


@click.command(
    short_help="Train an agent from a configuration.",
    epilog="""\b
        Examples:
          dq-space-arm train ppo                                  # a configuration that ships
          dq-space-arm train my.yaml --seed 1 --out results/mine  # your own
          dq-space-arm train sac --minutes 30                     # stop after half an hour; repeat to resume
    """,
)
@click.argument("configuration", type=CONFIGURATION, required=False)
@click.option("--config", type=CONFIGURATION, help="The same as CONFIGURATION.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the run.  [default: results/agents/<name>-<seed>]",
)
@click.option("--seed", type=int, help="Replaces the configuration's.")
@click.option("--total-steps", type=int, help="Environment steps; replaces the configuration's.")
@click.option("--minutes", type=float, help="Time limit; replaces the configuration's.")
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
    """Train an agent as CONFIGURATION specifies, a name or a file.

    The folder of the run receives the resolved configuration, commit and versions, checkpoints, the learning
    curve and the exported policy. Re-run the command to resume an interrupted run at its last checkpoint:
    it ends with the same weights. Nothing in the folder is executed.
    Exit status 1: the folder belongs to another run. Needs the extra `agents`.
    """
    chosen = configuration or config
    if chosen is None or None not in (configuration, config):
        raise click.UsageError(
            f"give one configuration: a YAML file, or one of {', '.join(configuration_files())}",
            click.get_current_context(),
        )
    from agents import training
    from agents.configuration import load_configuration
    from dq_space_arm_env.common.progress import ProgressDisplay

    changes = given(seed=seed, total_steps=total_steps, minutes=minutes)
    checked = training.with_changes(load_configuration(chosen), **changes)
    folder = out or training.default_folder(checked)
    check_writable(folder)
    kept = f"run the same command to resume at the last checkpoint in {folder}"
    with keeping(kept), ProgressDisplay(message_console()) as shown:
        training.train(checked, folder, report=shown.update)
    if as_json:
        facts = {"agent": checked.name, "seed": checked.seed, "folder": str(folder)}
        print_document({**facts, "policy": str(folder / "policy.npz")})
    else:
        table_console().print(f"{folder}: the policy is in policy.npz", markup=False, soft_wrap=True)
