"""The command `python -m agents.evaluate`."""

import argparse
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from agents.evaluation.conditions import CONDITIONS
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.records import evaluation_record
from agents.evaluation.runs import groups
from agents.evaluation.statistics import Interval
from agents.policies import PolicyFileError
from experts.demonstrations import DemonstrationsError
from experts.files import write_atomically
from experts.report.command import INTERRUPTED, complain, guarded, table_console
from experts.report.provenance import provenance

FAILURE = 1
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
_DESCRIPTION = """Evaluate policies on the evaluation starts of a scene, beside the expert's optimal costs.

The expert's costs are computed at the first use, which takes minutes, and kept in the cache folder; what is
interrupted goes on there. Several policies that differ in their training seeds alone are also aggregated.
Exit status: 0; 1 if the expert had to stop; 2 if the input is unusable; 130 if interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    console = table_console(150)

    def run() -> int:
        try:
            _evaluate(console, options)
        except (DemonstrationsError, PolicyFileError) as error:
            complain([str(error)])
            return FAILURE
        except KeyboardInterrupt:
            complain(["Interrupted: what the expert has solved is kept, and the same command goes on there."])
            return INTERRUPTED
        return 0

    return guarded(run)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m agents.evaluate",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--policy",
        nargs="+",
        required=True,
        help="names of the zoo, exported policies (.npz), models of Stable-Baselines3 (.zip), or folders of "
        "training runs",
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument(
        "-n", type=int, default=EVALUATION_SEEDS, help="number of starts, the first ones (default: all 500)"
    )
    parser.add_argument(
        "--condition",
        nargs="+",
        default=["training"],
        choices=[*CONDITIONS, "all"],
        help="what is changed in the scene (default: training, nothing)",
    )
    parser.add_argument(
        "--no-expert", dest="expert", action="store_false", help="do without the expert's optimal costs"
    )
    parser.add_argument("--workers", type=int, help="processes of the expert (default: one per processor)")
    parser.add_argument("--out", type=Path, help="folder for a JSON file for each evaluation, with episodes")
    parser.add_argument("--json", action="store_true", help="print summaries as JSON in place of tables")
    return parser.parse_args(arguments)


def _evaluate(console: Console, options: argparse.Namespace) -> None:
    conditions = CONDITIONS if "all" in options.condition else options.condition
    summaries = []
    for condition in conditions:
        evaluations = [_one(options, policy, condition) for policy in options.policy]
        summaries += [evaluation.summary() for evaluation in evaluations]
        if not options.json:
            _show(console, evaluations)
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            for number, evaluation in enumerate(evaluations, 1):
                _save(options.out, number, evaluation)
    if options.json:
        print(json.dumps(summaries, indent=1, allow_nan=False))


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


def _one(options: argparse.Namespace, policy: str, condition: str) -> Evaluation:
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
