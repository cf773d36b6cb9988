"""`dq-space-arm suite`: any controller in all tasks of a suite."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from agents.command_line.agent_policies import configuration_files
from dq_space_arm_env.command_line.names import Named, given, shipped_files, trust_option
from dq_space_arm_env.command_line.results_options import destination, results_options
from dq_space_arm_env.command_line.verb import keeping
from dq_space_arm_env.common.console import FAILURE, SUCCESS, message_console
from experts.command_line.ray_option import chosen_executor, ray_option


def _suites() -> dict[str, Path]:
    return shipped_files("agents", "suites", "configs/suites")


def _entrants() -> Iterable[str]:
    from agents.evaluation.plan_followers import CONTROLLERS

    return [*CONTROLLERS, *configuration_files(), "zoo"]


def _tasks() -> Iterable[str]:
    from dq_space_arm_env.command_line.names import scene_files

    return scene_files()


_SUITE, _TASK = Named("suite", _suites), Named("task", _tasks)


@click.command(
    short_help="Fly any controller in all tasks of the benchmark suite.",
    epilog="""\b
        Examples:
          dq-space-arm suite                                    # all that ships, in 1.5 hours
          dq-space-arm suite gains 'mine=runs/{task}.npz'       # your policies, one for each task
          dq-space-arm suite my.yaml --seeds 3 --task paper     # your configuration, trained for a task
          dq-space-arm suite 'mine=runs/{task}.npz' --check mine.json  # whether a published result is right
    """,
)
@click.argument("entrants", nargs=-1, type=Named("entrant", _entrants), metavar="[ENTRANT]...")
@click.option(
    "--suite", "version", type=_SUITE, default="v1", show_default=True, help="Version, or a YAML file."
)
@click.option("--task", "tasks", type=_TASK, multiple=True, help="Some of its tasks; may be repeated.")
@click.option(
    "--seeds", type=click.IntRange(min=1), help="Trainings of an agent for a task.  [default: the suite's]"
)
@click.option("--workers", type=int, help="Processes.  [default: one per processor]")
@ray_option
@click.option(
    "--check",
    "other",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Compare with the suite.json of another run.",
)
@trust_option
@results_options("suite")
def suite(
    entrants: tuple[str, ...],
    version: str,
    tasks: tuple[str, ...],
    seeds: int | None,
    workers: int | None,
    ray: str | None,
    other: Path | None,
    trust: bool,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Train and fly each ENTRANT in all tasks of a suite, and compare it with the expert's optima.

    An ENTRANT is a controller of the expert (open-loop, gains, receding); an agent that is trained for each
    task (a configuration's name or YAML file); zoo, the policies that ship with the package; or the path of a
    policy, with {task} in it where each task has its own, and with NAME= before it for the tables. All that
    ship with the package by default.

    The output folder receives the page, suite.html and suite.md, suite.json, pictures, trainings, and
    finished rows. Re-run the command to resume. Exit status 1: a training failed, the file of a task is
    missing, or --check found a difference or a score that was not flown. Trainings by Stable-Baselines3 need
    the extra `agents`.
    """
    executor = chosen_executor(workers, ray)
    from agents.suite.entrants import entrant_names
    from agents.suite.running import run_suite
    from agents.suite.suite_check import check, check_columns, comparable, fewer_trainings
    from agents.suite.suite_page import suite_page
    from agents.suite.tasks import load_suite
    from dq_space_arm_env.common.progress import ProgressDisplay
    from dq_space_arm_env.common.tables import tabulate

    if other is not None:
        if other.resolve() == (out / "suite.json").resolve():
            raise click.UsageError(
                f"--check: this run writes {other}: give another --out", click.get_current_context()
            )
        flown = load_suite(version)  # what cannot be compared ends the run before it begins
        comparable(other, flown, tasks or flown.tasks, entrant_names(entrants, flown))
    written = destination(out, as_json, picture)
    chosen = given(tasks=tasks, seeds=seeds, workers=workers, executor=executor)
    with (
        keeping("trainings and finished rows are kept; run the same command to resume"),
        ProgressDisplay(message_console()) as shown,
    ):
        run = run_suite(entrants, version, out=out, trust=trust, progress=shown.update, **chosen)
    page, console = suite_page(run, picture=picture), written.console(150)
    files = page.save(out, "suite")
    for section in page.sections:
        section.print(console)
    for sentence in page.shortcomings:
        console.print(sentence, markup=False)
    console.print(f"{out}: {', '.join(files)}", markup=False)
    rows = [] if other is None else check(run, other)
    if rows:
        console.print(tabulate(f"Beside {other}", rows, check_columns()).for_terminal())
    for sentence in fewer_trainings(rows):
        console.print(sentence, markup=False)
    written.print(page.record)
    is_confirmed = all(row["verdict"] in ("equal", "agrees") for row in rows)
    return SUCCESS if is_confirmed and not run.notes else FAILURE
