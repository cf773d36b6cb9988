"""`dq-space-arm search`: hyperparameters of a configuration, by trials side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agents.command_line.agent_policies import CONFIGURATION
from dq_space_arm_env.command_line.names import given
from dq_space_arm_env.command_line.results_options import destination, results_options
from dq_space_arm_env.command_line.verb import keeping
from dq_space_arm_env.common.console import FAILURE, SUCCESS, complain, message_console
from experts.command_line.ray_option import chosen_executor, ray_option

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from agents.experiments.search_space import SearchSpace
    from dq_space_arm_env.common.tables import Row, TextTable


@click.command(
    short_help="Search for hyperparameters of a configuration.",
    epilog="""\b
        Examples:
          dq-space-arm search apg space.yaml --trials 20        # on all cores; repeat to resume
          dq-space-arm search my.yaml space.yaml --ray          # the machines of a Ray cluster
          dq-space-arm train results/search/best.yaml --seeds 10  # several seeds of what was found
    """,
)
@click.argument("configuration", type=CONFIGURATION)
@click.argument("space", type=click.Path(dir_okay=False))
@click.option("--trials", type=int, default=20, show_default=True, help="Trials of the folder in all.")
@click.option("--seed", type=int, help="Replaces the configuration's.")
@click.option("--total-steps", type=int, help="Environment steps of a trial; replaces the configuration's.")
@click.option("--minutes", type=float, help="Time limit of a trial; replaces the configuration's.")
@click.option(
    "--pruning/--no-pruning",
    default=True,
    help="Stop trials whose best point so far is below the median of the others.",
)
@click.option("--workers", type=int, help="Trials side by side.  [default: one per processor]")
@ray_option
@results_options("search")
def search(
    configuration: str,
    space: str,
    trials: int,
    seed: int | None,
    total_steps: int | None,
    minutes: float | None,
    pruning: bool,
    workers: int | None,
    ray: str | None,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Search for hyperparameters of CONFIGURATION, a name or a file, within SPACE, a YAML file.

    SPACE has a mapping `search` of keys, such as algorithm.learning_rate, to {low: 0.001, high: 0.03, log:
    true} or {choices: [64, 128]}. Each trial is a training; it is judged by the last point of its learning
    curve: more successes from validation starts win, less the flights that violate constraints, and a tie
    goes to the lower cost. Optuna proposes trials (TPE) and stops those that fall behind.

    The output folder receives the run folder of each trial, the study, search.json, search.png, and
    best.yaml, a configuration for `train`. Re-run the command to resume; with more --trials it goes on.
    Exit status 1: no trial was trained to the end. Needs the extras `agents` and `search`.
    """
    executor = chosen_executor(workers, ray)
    from agents.configuration import load_configuration
    from agents.experiments import hyperparameter_search
    from agents.experiments.search_space import load_search_space
    from agents.training import with_changes
    from dq_space_arm_env.common.files import json_value
    from dq_space_arm_env.common.progress import ProgressDisplay
    from dq_space_arm_env.common.provenance import provenance

    changes = given(seed=seed, total_steps=total_steps, minutes=minutes)
    checked = with_changes(load_configuration(configuration), **changes)
    varied = load_search_space(space, checked)
    written = destination(out, as_json, picture)
    kept = f"finished trials are kept; run the same command to resume the others in {out}"
    with keeping(kept), ProgressDisplay(message_console()) as shown:
        found = hyperparameter_search.search(
            checked, varied, trials, out, prune=pruning, executor=executor, report=shown.update
        )
    content = {
        "trials": found.trials,
        "best": None if found.best is None else found.best["trial"],
        "configuration": checked.model_dump(mode="json", exclude_none=True),
        **varied.model_dump(mode="json", exclude_none=True),
        **provenance("optuna"),
    }
    drawable = any(row["median_cost"] is not None for row in found.trials)
    pictures = {"search.png": lambda: _picture(found.trials, varied)} if drawable else {}
    record = json_value(content)
    lines = written.write("search", record, pictures)
    console = written.console(150)
    console.print(_table(found.trials, varied).for_terminal())
    for row in found.trials:
        if "failure" in row:
            complain(f"trial {row['trial']}: {row['failure']}", label="Failed: ")
    if found.best is not None:
        console.print(f"Best: trial {found.best['trial']}, {found.file}", markup=False, soft_wrap=True)
    written.tell(console, lines, record)
    return FAILURE if found.best is None else SUCCESS


def _table(rows: Sequence[Row], space: SearchSpace) -> TextTable:
    from agents.experiments.many_trainings import COST, OUTCOME, SECONDS, SUCCESS, VIOLATING, known
    from dq_space_arm_env.common.tables import Column, tabulate

    keys = [Column(key, key.replace(".", ".\n"), ".4g") for key in space.search]
    title = "Trials, flown from validation starts; cost: median"
    return tabulate(title, rows, ["trial", *keys, *known((SUCCESS, VIOLATING, COST, SECONDS, OUTCOME), rows)])


def _picture(rows: Sequence[Row], space: SearchSpace) -> bytes:
    """Draw the cost of each trial over its number, and over each hyperparameter that is a number."""
    from matplotlib.ticker import MaxNLocator

    from experts.figures.plots import Plot

    ranges = {key: parameter for key, parameter in space.search.items() if parameter.choices is None}
    points: list[dict[str, Any]] = [
        {
            "panel": panel,
            "value": row.get(panel),
            "median_cost": row["median_cost"],
            "outcome": row["outcome"],
        }
        for panel, row in ((panel, row) for panel in ("trial", *ranges) for row in rows)
        if row["median_cost"] is not None
    ]

    def decorate(axes: Axes, panel: str) -> None:
        axes.set_xlabel("")
        if panel == "trial":
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        elif ranges[panel].log:
            axes.set_xscale("log")

    plot = Plot(
        "value",
        "median_cost",
        color="outcome",
        facet="panel",
        log="y",
        join=False,
        labels={"median_cost": "median cost"},
        decorate=decorate,
    )
    return plot.png(points)
