"""A comparison under model mismatch as a table, for the terminal and as Markdown, and as JSON values."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from agents.comparison.controllers import FEEDBACK, RECEDING
from agents.evaluation.runs import training_command
from agents.evaluation.statistics import Interval
from agents.residual.evaluation import Comparison, Row
from experts.report.page.rendering import markdown_table
from experts.report.tables import TextTable

_HEADINGS = (
    "condition",
    "controller",
    "starts",
    "success\n%",
    "cost gap\n%",
    "saves\n%",
    "angle\ndeg",
    "distance\nm",
    "action\nus",
)


def table(comparison: Comparison) -> TextTable:
    """Write a comparison as a table.

    Args:
        comparison: The comparison.

    Returns:
        The table, a row for each condition and controller.
    """
    title = f"Scene {comparison.scene}, controllers under model mismatch; brackets: 95 % intervals"
    rows = []
    for condition in comparison.conditions:
        for index, row in enumerate(comparison.under(condition)):
            rows.append((condition if index == 0 else "", *_cells(row, comparison.saving(row))))
    return TextTable(title, _HEADINGS, tuple(rows), right=2)


def notes(comparison: Comparison) -> list[str]:
    """Explain what the table shows.

    Args:
        comparison: The comparison.

    Returns:
        Sentences.
    """
    sentences = [
        "Cost gap: J / J_informed - 1, median; J_informed is the optimum of the expert that knows the "
        f"masses, and meets neither noise nor pushes. Saves: of what the {FEEDBACK} pays, geometric mean, "
        "flight by flight from the starts that both have flown. Angle and distance are medians."
    ]
    if comparison.policies:
        verb = "corrects" if len(comparison.policies) == 1 else "correct"
        sentences.append(f"{' and '.join(comparison.policies)} {verb} the {FEEDBACK}.")
    fewer = {row.controller: len(row.flown.cost) for row in comparison.rows}
    if RECEDING in fewer and fewer[RECEDING] < max(fewer.values()):
        sentences.append(
            f"The {RECEDING} flies the first {fewer[RECEDING]} starts: compare it by what it saves, for its "
            "success rate and cost gap are of these alone."
        )
    for row in comparison.rows:
        unknown = int(np.isnan(row.informed_cost).sum())
        if unknown and row.controller == FEEDBACK:
            sentences.append(
                f"{row.condition.name}: {unknown} of {len(row.informed_cost)} starts are without a cost gap, "
                "for the informed expert found no optimum there."
            )
    return sentences


def commands(comparison: Comparison, options: Sequence[str]) -> list[str]:
    """List the commands that make the table again.

    Args:
        comparison: The comparison.
        options: Of `dq-space-arm compare residual`.

    Returns:
        Those that train the policies, as far as they can be told, and the one that compares.
    """
    trained = [training_command(policy.metadata, file) for policy, file in comparison.policies.values()]
    compare = shlex.join(["dq-space-arm", "compare", "residual", *options])
    return [*(command for command in trained if command is not None), compare]


def markdown(comparison: Comparison, again: Sequence[str]) -> str:
    """Write a comparison as Markdown.

    Args:
        comparison: The comparison.
        again: The commands that make it again.

    Returns:
        Table, notes and commands.
    """
    return "\n\n".join(_paragraphs(comparison, again)) + "\n"


def record(comparison: Comparison, again: Sequence[str]) -> dict[str, Any]:
    """Write a comparison as JSON values.

    Args:
        comparison: The comparison.
        again: The commands that make it again.

    Returns:
        A summary of each row, None for what is not known, notes and commands.
    """
    return {
        "scene": comparison.scene,
        "rows": [_summary(row, comparison.saving(row)) for row in comparison.rows],
        "notes": notes(comparison),
        "commands": list(again),
    }


def _paragraphs(comparison: Comparison, again: Sequence[str]) -> Iterator[str]:
    yield f"# Corrections of plans under model mismatch, scene {comparison.scene}"
    yield from markdown_table(table(comparison))
    yield from notes(comparison)
    yield "The table is made again by:"
    yield "\n".join(["```bash", *again, "```"])


def _summary(row: Row, saving: Interval | None) -> dict[str, Any]:
    flown = row.flown
    return {
        "condition": row.condition._asdict(),
        "controller": row.controller,
        "episodes": len(flown.cost),
        "success_rate": list(row.success_rate),
        "median_cost": float(np.median(flown.cost)),
        "mean_cost": float(np.mean(flown.cost)),
        "median_cost_gap": None if np.isnan(row.cost_gap.value) else list(row.cost_gap),
        "unknown_optima": int(np.isnan(row.informed_cost).sum()),
        "saving": None if saving is None else list(saving),
        "attitude_error": float(np.median(flown.attitude_error)),
        "position_error": float(np.median(flown.position_error)),
        "action_seconds": row.action_seconds,
    }


def _cells(row: Row, saving: Interval | None) -> tuple[str, ...]:
    microseconds = 1e6 * row.action_seconds
    return (
        row.controller,
        str(len(row.flown.cost)),
        _percent(row.success_rate),
        _percent(row.cost_gap),
        "" if saving is None else _percent(saving),
        f"{np.median(row.flown.attitude_error):.2f}",
        f"{np.median(row.flown.position_error):.3f}",
        f"{microseconds:.1f}" if microseconds < 99.95 else f"{microseconds:,.0f}",
    )


def _percent(interval: Interval) -> str:
    if np.isnan(interval.value):
        return "-"
    value, low, high = (_digits(100.0 * bound) for bound in interval)
    return f"{value} [{low}, {high}]"


def _digits(value: float) -> str:
    """A percentage with as many digits as tell something."""
    text = f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.1f}"
    return "0.0" if text == "-0.0" else text
