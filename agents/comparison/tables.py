"""A comparison as tables, for the terminal and as Markdown, and as JSON values."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from agents.comparison.comparing import Comparison, Row
from agents.evaluation.statistics import Interval
from experts.report.page.rendering import markdown_table
from experts.report.tables import TextTable

_HEADINGS = (
    "",
    "starts",
    "success\n%",
    "cost gap\n%",
    "95th perc.\n%",
    "angle\ndeg",
    "distance\nm",
    "effort",
    "base turn\ndeg",
    "action\nus",
    "plan\ns",
    "training\nsteps",
    "training\ntime",
    "expert\nsolves",
)


def tables(comparison: Comparison) -> list[TextTable]:
    """Write a comparison as tables, one for each condition.

    Args:
        comparison: The comparison.

    Returns:
        The tables.
    """
    made = []
    for condition in comparison.conditions:
        title = f"Scene {comparison.scene}, condition {condition}; brackets: 95 % intervals"
        rows = [_cells(row) for row in comparison.under(condition)]
        for group in comparison.groups:
            if group.condition == condition:
                seeds = ", ".join(map(str, group.seeds))
                rates, gaps = _percent(group.runs.success_rate), _percent(group.runs.cost_gap)
                name = f"{group.name}, all {len(group.seeds)} runs (seeds {seeds})"
                rows.append((name, "", rates, f"{gaps}*", *[""] * (len(_HEADINGS) - 4)))
        made.append(TextTable(title, _HEADINGS, tuple(rows), right=1))
    return made


def notes(comparison: Comparison) -> list[str]:
    """Explain what the tables show.

    Args:
        comparison: The comparison.

    Returns:
        Sentences.
    """
    sentences = [
        "Cost gap: J / J_expert - 1, median; J_expert is the optimum of the scene that is flown in. Angle, "
        "distance, effort and base turn are medians. Plan: what is planned before a flight, median."
    ]
    if comparison.groups:
        sentences.append("*: interquartile mean over runs and starts.")
    names = {row.evaluation.policy for row in comparison.rows if not row.is_agent}
    if names and any(condition.endswith("payload") for condition in comparison.conditions):
        sentences.append(
            "Controllers plan with the payload of the unchanged scene: they do not know the new one."
        )
    for row in comparison.rows:
        summary = row.evaluation.summary()
        where = f"{summary['policy']}, {summary['condition']}"
        if summary["unknown_optima"]:
            sentences.append(
                f"{where}: {summary['unknown_optima']} of {summary['episodes']} starts are without a cost "
                "gap, for the expert found no optimum there."
            )
        if summary["cheaper_than_expert"]:
            sentences.append(
                f"{where}: {summary['cheaper_than_expert']} flights reached the target for less than the "
                "expert, whose optima are local."
            )
        if summary["policy_failed"]:
            sentences.append(f"{where}: {summary['policy_failed']} flights ended for want of an action.")
        if row.evaluation.same_scene is False and summary["condition"] == comparison.conditions[0]:
            sentences.append(
                f"{summary['policy']} was trained in another scene ({summary['trained_in']}), or in another "
                "version of this one."
            )
    return sentences


def commands(comparison: Comparison) -> list[str]:
    """List the commands that make the rows again.

    Args:
        comparison: The comparison.

    Returns:
        The commands: for each row its training, and its flights under all conditions.
    """
    found: dict[str, list[str]] = {}
    for row in comparison.rows:
        if row.training is not None:
            found.setdefault(row.training, [])
        found.setdefault(row.again, []).append(row.evaluation.condition)
    return [" ".join([command, *conditions]) for command, conditions in found.items()]


def markdown(comparison: Comparison) -> str:
    """Write a comparison as Markdown.

    Args:
        comparison: The comparison.

    Returns:
        Tables, notes and commands.
    """
    return "\n\n".join(_paragraphs(comparison)) + "\n"


def record(comparison: Comparison) -> dict[str, Any]:
    """Write a comparison as JSON values.

    Args:
        comparison: The comparison.

    Returns:
        Summaries, commands and learning curves of all rows, and what several runs have in common.
    """
    return {
        "scene": comparison.scene,
        "rows": [
            {
                **row.evaluation.summary(),
                "is_agent": row.is_agent,
                "planning_seconds": row.planning_seconds,
                "solves": " ".join(row.solves.split()),
                "training_command": row.training,
                "evaluation_command": f"{row.again} {row.evaluation.condition}",
                "learning_curve": [
                    {name: None if value != value else value for name, value in point._asdict().items()}
                    for point in row.curve
                ],
            }
            for row in comparison.rows
        ],
        "groups": [
            {
                "agent": group.name,
                "condition": group.condition,
                "seeds": list(group.seeds),
                "success_rate": list(group.runs.success_rate),
                "interquartile_mean_cost_gap": None
                if group.runs.cost_gap.value != group.runs.cost_gap.value
                else list(group.runs.cost_gap),
            }
            for group in comparison.groups
        ],
        "notes": notes(comparison),
        "commands": commands(comparison),
    }


def _paragraphs(comparison: Comparison) -> Iterator[str]:
    yield f"# Controllers and agents, scene {comparison.scene}"
    for table in tables(comparison):
        yield from markdown_table(table)
    yield from notes(comparison)
    yield "The rows are made again by:"
    yield "\n".join(["```bash", *commands(comparison), "```"])


def _cells(row: Row) -> tuple[str, ...]:
    evaluation, summary = row.evaluation, row.evaluation.summary()
    return (
        evaluation.policy,
        str(summary["episodes"]),
        _percent(evaluation.success_rate),
        _percent(evaluation.median_cost_gap),
        _percent(evaluation.tail_cost_gap),
        f"{summary['attitude_error']:.2f}",
        f"{summary['position_error']:.3f}",
        f"{summary['effort']:.3g}",
        f"{summary['base_turn']:.1f}",
        _microseconds(evaluation.action_seconds),
        "-" if row.is_agent else f"{row.planning_seconds:.2f}",
        "-" if summary["training_steps"] is None else f"{summary['training_steps']:,}",
        "-" if summary["training_seconds"] is None else _duration(summary["training_seconds"]),
        row.solves,
    )


def _duration(seconds: float) -> str:
    """A time for people: "45 s", "12 min" or "3.4 h"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"


def _microseconds(seconds: float) -> str:
    value = 1e6 * seconds
    return f"{value:.1f}" if value < 99.95 else f"{value:.0f}"


def _percent(interval: Interval) -> str:
    if interval.value != interval.value:
        return "-"
    value, low, high = (_digits(100.0 * bound) for bound in interval)
    return f"{value}\n[{low}, {high}]"


def _digits(value: float) -> str:
    """A percentage with as many digits as tell something."""
    size = abs(value)
    if size < 0.005:
        return "0.0"
    if size >= 1000.0:
        return f"{value:,.0f}"
    return f"{value:.2f}" if size < 1.0 else f"{value:.1f}"
