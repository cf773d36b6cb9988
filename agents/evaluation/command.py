"""`dq-space-arm evaluate`, also `python -m agents.evaluate`: policies beside the expert's optimal costs."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from agents.evaluation.conditions import CONDITIONS
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.records import evaluation_record
from agents.evaluation.runs import groups
from agents.evaluation.statistics import Interval
from experts.files import write_atomically
from experts.report.provenance import provenance

ALL = "all"
"""In place of conditions: all of them."""
_COLUMNS = (
    "policy",
    "success\n%",
    "cost gap\n%",
    "95th percentile\n%",
    "angle\ndeg",
    "distance\nm",
    "effort",
    "base turn\ndeg",
    "action\nus",
    "training\nsteps",
    "training\ns",
    "expert\nsolves",
)


@dataclass(frozen=True)
class Options:
    """What to evaluate.

    Attributes:
        policies: Names of the zoo, exported policies, models of Stable-Baselines3, or folders of training
            runs; at least one.
        scene: Name of a shipped scene, or path of a YAML file.
        n: Number of starts, the first ones.
        conditions: What is changed in the scene, or `ALL`.
        expert: Whether to compare with the expert's optimal costs.
        workers: Processes of the expert; one per processor if None.
        out: Folder for a JSON file for each evaluation, with episodes, if wanted.
    """

    policies: Sequence[str]
    scene: str = "paper"
    n: int = EVALUATION_SEEDS
    conditions: Sequence[str] = ("training",)
    expert: bool = True
    workers: int | None = None
    out: Path | None = None


def run(console: Console, options: Options) -> list[dict[str, Any]]:
    """Evaluate, and print a table for each condition.

    The expert's costs are computed at the first use, and kept in the cache folder. Policies that differ in
    their training seeds alone are also aggregated.

    Args:
        console: Where to print.
        options: What to evaluate.

    Returns:
        Summaries, JSON values.

    Raises:
        ValueError: If an option, a policy or the scene cannot be used.
        DemonstrationsError: If the expert had to stop.
        PolicyFileError: If a policy's file is damaged.
    """
    summaries = []
    for condition in CONDITIONS if ALL in options.conditions else options.conditions:
        evaluations = [_one(options, policy, condition) for policy in options.policies]
        summaries += [evaluation.summary() for evaluation in evaluations]
        _show(console, evaluations)
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            for number, evaluation in enumerate(evaluations, 1):
                _save(options.out, number, evaluation)
    return summaries


def _show(console: Console, evaluations: Sequence[Evaluation]) -> None:
    console.print(table(evaluations))
    for sentence in remarks(evaluations):
        console.print(sentence, markup=False)
    for group in groups(evaluations):
        console.print(
            f"{group.name}, {len(group.seeds)} runs (seeds {', '.join(map(str, group.seeds))}): success "
            f"{_on_a_line(group.runs.success_rate)}, interquartile mean of the cost gap "
            f"{_on_a_line(group.runs.cost_gap)}",
            markup=False,
        )


def remarks(evaluations: Sequence[Evaluation]) -> list[str]:
    """Say what a table does not show and its reader should know.

    Args:
        evaluations: Those of the table.

    Returns:
        A sentence for each remark.
    """
    sentences = []
    for evaluation in evaluations:
        summary = evaluation.summary()
        if evaluation.same_scene is False:
            sentences.append(
                f"{evaluation.policy} was trained in another scene ({summary['trained_in']}), or in another "
                "version of this one."
            )
        if summary["policy_failed"]:
            sentences.append(
                f"{evaluation.policy} gave something that is no number in {summary['policy_failed']} "
                "episodes: they went on without control, and count as failures."
            )
        if evaluation.optimal is not None and summary["unknown_optima"]:
            sentences.append(
                f"{evaluation.policy}: {summary['unknown_optima']} episodes are without a cost gap, for the "
                "expert found no optimum there."
            )
        if summary["cheaper_than_expert"]:
            sentences.append(
                f"{evaluation.policy} reached the target for less than the expert in "
                f"{summary['cheaper_than_expert']} episodes: the expert's optima are local."
            )
    return sentences


def _one(options: Options, policy: str, condition: str) -> Evaluation:
    with stage_bars() as show:
        return evaluate(
            policy,
            options.scene,
            options.n,
            condition=condition,
            expert=options.expert,
            workers=options.workers,
            progress=show,
        )


@contextmanager
def stage_bars() -> Iterator[Callable[[Advance], None]]:
    """Show how far each stage of an evaluation has come: bars on the terminal, on standard error.

    Yields:
        What to call with each advance.
    """
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        tasks: dict[str, TaskID] = {}

        def show(advance: Advance) -> None:
            if advance.stage not in tasks:
                tasks[advance.stage] = progress.add_task(advance.stage)
            progress.update(tasks[advance.stage], completed=advance.done, total=advance.total)

        yield show


def table(evaluations: Sequence[Evaluation]) -> Table:
    """Write evaluations on one scene as a table.

    Args:
        evaluations: At least one.

    Returns:
        The table; medians where nothing else is said.
    """
    first = evaluations[0]
    result = Table(
        title=f"Scene {first.scene}, {len(first.seeds)} episodes; brackets: 95 % intervals",
        title_justify="left",
    )
    for column in _COLUMNS:
        is_label = column == "policy"
        result.add_column(column, justify="left" if is_label else "right", overflow="fold")
    for evaluation in evaluations:
        summary = evaluation.summary()
        result.add_row(
            evaluation.policy,
            _percent(evaluation.success_rate),
            _percent(evaluation.median_cost_gap),
            _percent(evaluation.tail_cost_gap),
            f"{summary['attitude_error']:.2f}",
            f"{summary['position_error']:.3f}",
            f"{summary['effort']:.3g}",
            f"{summary['base_turn']:.1f}",
            f"{1e6 * evaluation.action_seconds:.1f}",
            *(
                "-" if summary[name] is None else f"{summary[name]:,.0f}"
                for name in ("training_steps", "training_seconds", "expert_solves")
            ),
        )
    return result


def _percent(interval: Interval) -> str:
    if interval.value != interval.value:
        return "-"
    value, low, high = (100.0 * bound for bound in interval)
    return f"{value:.1f}\n[{low:.1f}, {high:.1f}]"


def _on_a_line(interval: Interval) -> str:
    return _percent(interval).replace("\n", " % ")


def _save(folder: Path, number: int, evaluation: Evaluation) -> None:
    name = re.sub(r"[^\w.-]+", "-", f"{number}-{Path(evaluation.policy).stem}-{evaluation.condition}")
    record = {**evaluation_record(evaluation), "provenance": provenance()}
    write_atomically(folder / f"{name}.json", json.dumps(record) + "\n")
