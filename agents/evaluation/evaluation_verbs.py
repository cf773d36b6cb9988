"""What `dq-space-arm evaluate` and `compare` print and write."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from agents.evaluation.comparing import RECEDING_STARTS, Comparison, compare
from agents.evaluation.comparison_tables import (
    comparison_tables,
    evaluation_table,
    group_record,
    groups_table,
    markdown,
    notes,
    record,
    remarks,
)
from agents.evaluation.conditions import CONDITIONS, scene_under
from agents.evaluation.evaluating import Advance, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.plan_followers import CONTROLLERS
from agents.evaluation.training_runs import groups, pairs
from agents.zoo.finding import as_policy, check_fit, scene_of
from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line.policy_sources import statistics_by_model
from dq_space_arm_env.common.console import message_console
from dq_space_arm_env.common.files import json_value, write_atomically
from dq_space_arm_env.common.progress import ProgressDisplay
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.results import Destination
from dq_space_arm_env.common.tables import TextTable
from experts.executors import Executor

ALL, NONE = "all", "none"
"""In place of the names of conditions and of controllers."""


@contextmanager
def progress_bar() -> Iterator[Callable[[Advance], None]]:
    """Show the progress of an evaluation on standard error; yields the callback."""
    with ProgressDisplay(message_console()) as display:
        yield display.update


def evaluate_policies(
    console: Console,
    policies: Sequence[str],
    scene: str | None = None,
    n: int = EVALUATION_SEEDS,
    *,
    conditions: Sequence[str] = ("training",),
    expert: bool = True,
    executor: Executor | None = None,
    out: Path | None = None,
    trust: bool = False,
    normalize: Path | None = None,
) -> list[dict[str, Any]]:
    """Evaluate policies, print a table for each condition, and return the summaries.

    A folder `out` receives a JSON file for each evaluation, with its episodes, and one for agents with
    several training seeds. The scene is that of the policies by default, if they have one in common, else
    "paper". Statistics in `normalize` are those of the one model (.zip) among the policies.
    """
    summaries = []
    statistics = statistics_by_model(policies, normalize)
    acting = [as_policy(each, trust=trust, normalize=statistics.get(each)) for each in policies]
    given = load_scene(scene or scene_of(acting))
    for each in acting:
        check_fit(each, given)
    chosen = CONDITIONS if ALL in conditions else tuple(dict.fromkeys(conditions))
    for condition in chosen:
        scene_under(given, condition)  # refuses one that the scene cannot have before anything flies
    for condition in chosen:
        evaluations = []
        with progress_bar() as show:
            for number, policy in enumerate(acting, 1):
                evaluation = evaluate(
                    policy,
                    given,
                    n,
                    condition=condition,
                    expert=expert,
                    executor=executor,
                    progress=show,
                )
                evaluations.append(evaluation)
                if out is not None:  # what is flown stays, whatever happens to the next
                    name = f"{number}-{Path(evaluation.policy).stem}-{condition}"
                    content = json.dumps(json_value({**evaluation.record(), "provenance": provenance()}))
                    out.mkdir(parents=True, exist_ok=True)
                    write_atomically(out / (re.sub(r"[^\w.-]+", "-", name) + ".json"), content + "\n")
        summaries += [evaluation.summary() for evaluation in evaluations]
        together = groups(evaluations)
        if out is not None and together:
            seeds = {"groups": [group_record(group) for group in together], "provenance": provenance()}
            write_atomically(out / f"seeds-{condition}.json", json.dumps(json_value(seeds)) + "\n")
        elif out is not None:
            (out / f"seeds-{condition}.json").unlink(missing_ok=True)  # of an earlier run with other policies
        console.print(evaluation_table(evaluations).for_terminal())
        if together:
            console.print(groups_table(together).for_terminal())
        for sentence in (*remarks(evaluations), *pairs(evaluations)):
            console.print(sentence, markup=False)
    return summaries


def compare_controllers(
    destination: Destination,
    policies: Sequence[str] = (),
    scene: str = "paper",
    n: int = EVALUATION_SEEDS,
    *,
    conditions: Sequence[str] = ("training",),
    controllers: Sequence[str] = tuple(CONTROLLERS),
    receding_starts: int = RECEDING_STARTS,
    executor: Executor | None = None,
    trust: bool = False,
    normalize: Path | None = None,
) -> None:
    """Compare, write the files, and print the tables; finished rows are read from the folder."""
    if NONE in controllers and set(controllers) != {NONE}:
        raise ValueError(f"--controller: {' '.join(controllers)}, should be {NONE} alone, or controllers")
    with progress_bar() as show:
        found = compare(
            policies,
            scene,
            n,
            controllers=() if NONE in controllers else controllers,
            conditions=CONDITIONS if ALL in conditions else conditions,
            receding_starts=receding_starts,
            out=destination.folder,
            executor=executor,
            trust=trust,
            normalize=statistics_by_model(policies, normalize),
            progress=show,
        )

    def draw() -> bytes:
        from agents.evaluation.comparison_figure import comparison_figure
        from experts.figures.style import as_png

        return as_png(lambda: comparison_figure(found))

    save_comparison(destination, "Controllers and agents", comparison_tables(found), found, draw)


def save_comparison(
    destination: Destination,
    title: str,
    tables: Sequence[TextTable],
    found: Comparison,
    draw: Callable[[], bytes],
) -> None:
    """Write a comparison as Markdown, as JSON, and as a picture, and print it."""
    content = {**record(found), **provenance()}
    write_atomically(destination.folder / "table.md", markdown(title, tables, found))
    written = destination.write("comparison", content, {"comparison.png": draw})
    console = destination.console(180)
    for table in tables:
        console.print(table.for_terminal())
    for sentence in notes(found):
        console.print(sentence, markup=False)
    console.print("Commands that reproduce the rows:")
    for command in found.commands:
        console.print(f"  {command}", markup=False, soft_wrap=True)
    destination.tell(console, written, content)
