"""Figures of comparisons: cost gaps over the time of an action, their profile, training, and conditions.

Gaps at or below zero have no place on a logarithmic axis: they are drawn at its lower edge as triangles, as
the label says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedFormatter, FixedLocator, FuncFormatter, NullLocator

from agents.evaluation.comparing import Comparison, Row
from agents.evaluation.statistics import Interval, performance_profile
from agents.evaluation.training_runs import agent_of
from experts.figures.plots import MARKERS, PALETTE
from experts.figures.style import LIMIT_STYLE, WIDTH, plain

FLOOR = 0.01
"""Smaller cost gaps are drawn here, %."""

_PANEL_HEIGHT, _LEGEND_ROW = 2.7, 0.2  # inches
_LEGEND_COLUMNS = 3
_THRESHOLDS = 80
_NEARLY = 0.97  # of the time of a training: its last flights stand for its end
_ROUND_TIMES = {1.0: "1 s", 10.0: "10 s", 60.0: "1 min", 600.0: "10 min", 3600.0: "1 h", 36000.0: "10 h"}

Looks = Mapping[str, dict[str, Any]]
"""Color and marker of each controller and agent."""


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw the first condition over times; where there are several, all of them side by side."""
    first, several = comparison.conditions[0], len(comparison.conditions) > 1
    rows = comparison.under(first)
    looks = _looks(rows)
    trained = any(_training_seconds(row) is not None for row in rows)
    lines = 1 + trained + several
    height = _PANEL_HEIGHT * lines + _LEGEND_ROW * -(-len(looks) // _LEGEND_COLUMNS)
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    parts = figure.subfigures(lines, 1, squeeze=False)[:, 0]
    left, right = np.transpose([part.subplots(1, 2) for part in parts])
    _draw_action_times(left[0], rows, looks)
    _draw_profiles(right[0], comparison, looks)
    if trained:
        _draw_training_costs(left[1], rows, looks)
        _draw_training_rates(right[1], rows, looks)
    if several:
        _draw_conditions(left[-1], right[-1], comparison, looks)
    rates = {row.name: f": {100.0 * row.evaluation.success_rate.value:.1f} %" for row in rows}
    title = f"Scene {comparison.scene}, {first}: success rates, and 95 % intervals as bars"
    _add_legend(figure, looks, title, rates)
    return figure


def mismatch_figure(comparison: Comparison) -> Figure:
    """Draw success rates and cost gaps under model mismatch, condition by condition."""
    looks = _looks(comparison.under(comparison.conditions[0]))
    figure = Figure(figsize=(WIDTH, 2.0 * _PANEL_HEIGHT - 0.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    _draw_conditions(above, below, comparison, looks)
    title = (
        f"Scene {comparison.scene}: success rates, and median cost gaps to the expert that knows the masses; "
        "bars: 95 % intervals"
    )
    _add_legend(figure, looks, title)
    return figure


def _looks(rows: Sequence[Row]) -> Looks:
    """Runs that differ in their seeds share the color."""
    agents: dict[str, int] = {}
    looks = {}
    for index, row in enumerate(rows):
        color = agents.setdefault(agent_of(row.evaluation.metadata) or row.name, len(agents))
        looks[row.name] = {
            "color": PALETTE[color % len(PALETTE)],
            # A triangle that points down marks gaps at the floor.
            "marker": [marker for marker in MARKERS if marker != "v"][index % (len(MARKERS) - 1)],
            "markersize": 5.0,
        }
    return looks


def _add_legend(figure: Figure, looks: Looks, title: str, suffixes: Mapping[str, str] | None = None) -> None:
    handles = [
        Line2D([], [], linestyle="", label=plain(name) + (suffixes or {}).get(name, ""), **look)
        for name, look in looks.items()
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), _LEGEND_COLUMNS),
        fontsize=8.5,
        title=title,
        title_fontsize=9,
    )


def _draw_action_times(axes: Axes, rows: Sequence[Row], looks: Looks) -> None:
    """Cost gaps over the time of an action."""
    axes.set_xscale("log")
    for row in rows:
        look, time = looks[row.name], 1e6 * row.evaluation.action_seconds
        _draw_gap(axes, time, row.evaluation.median_cost_gap, look)
        tail = 100.0 * row.evaluation.tail_cost_gap.value
        if np.isfinite(tail) and tail > FLOOR:
            axes.plot([time], [tail], marker="_", markersize=8.0, color=look["color"])
    axes.margins(x=0.12)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    _logarithmic_gaps(axes)
    axes.set_xlabel("time per action [µs]", fontsize=8.5)
    axes.set_title("Marker: median, dash: 95th percentile", loc="left", fontsize=8.5)


def _draw_profiles(axes: Axes, comparison: Comparison, looks: Looks) -> None:
    """Shares of flights within a cost gap, of the first condition; bands are 95 % intervals."""
    condition = comparison.conditions[0]
    gaps = np.concatenate([row.evaluation.cost_gaps for row in comparison.under(condition)])
    known = 100.0 * gaps[np.isfinite(gaps)]
    top = max(100.0, float(np.percentile(known, 99.0))) if known.size else 100.0
    thresholds = np.geomspace(FLOOR, top, _THRESHOLDS)
    for _, members in comparison.entrants(condition):
        shares = performance_profile([row.evaluation.valid_cost_gaps for row in members], thresholds / 100.0)
        if shares:
            value, low, high = 100.0 * np.array(shares).T
            color = looks[members[0].name]["color"]
            axes.plot(thresholds, value, color=color)
            axes.fill_between(thresholds, low, high, color=color, alpha=0.15, linewidth=0.0)
    axes.set_xscale("log")
    axes.set_xlim(FLOOR, top)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    _rates(axes)
    axes.set_xlabel("cost gap [%]", fontsize=8.5)
    axes.set_ylabel("flights within it [%]", fontsize=8.5)
    axes.set_title("Performance profile; bands: 95 % intervals", loc="left", fontsize=8.5)


def _draw_training_costs(axes: Axes, rows: Sequence[Row], looks: Looks) -> None:
    """Median costs over the time of training, relative to the median optimum from the same starts.

    A learning curve has medians alone, so the markers are ratios of medians as well.
    """
    for row in rows:
        optimum = row.facts["validation_optimum"]
        costs = [point["median_cost"] for point in row.facts["learning_curve"]]
        known = [None if cost is None or optimum is None else _excess(cost / optimum) for cost in costs]
        end = _excess(_median_ratio(row))
        _draw_training(axes, row, known, end, looks)
        if (seconds := _training_seconds(row)) is not None:
            _draw_gap(axes, max(seconds, 1.0), Interval(*3 * [end / 100.0]), looks[row.name])
    _logarithmic_gaps(axes)
    axes.set_ylabel("median cost above\nmedian optimum [%]", fontsize=8.5)
    _set_training_axis(axes, rows)


def _excess(ratio: float) -> float:
    """What a ratio exceeds 1 by, %, at least what the axis shows."""
    return max(100.0 * (ratio - 1.0), FLOOR)


def _draw_training_rates(axes: Axes, rows: Sequence[Row], looks: Looks) -> None:
    """Success rates over the time of training."""
    for row in rows:
        rates = [100.0 * point["success_rate"] for point in row.facts["learning_curve"]]
        rate = row.evaluation.success_rate
        _draw_training(axes, row, rates, 100.0 * rate.value, looks)
        if (seconds := _training_seconds(row)) is not None:
            _draw_rate(axes, max(seconds, 1.0), rate, looks[row.name])
    _rates(axes)
    _set_training_axis(axes, rows)


def _draw_training(axes: Axes, row: Row, values: Sequence[float | None], end: float, looks: Looks) -> None:
    """A learning curve that ends in the evaluation, which replaces the flights at the end of the training."""
    seconds = _training_seconds(row)
    last = np.inf if seconds is None else _NEARLY * seconds
    times = [point["seconds"] for point in row.facts["learning_curve"]]
    known = [(max(time, 1.0), value) for time, value in zip(times, values, strict=True) if value is not None]
    points = [(time, value) for time, value in known if time < last]
    if seconds is not None and np.isfinite(end):
        points.append((max(seconds, 1.0), end))
    color = looks[row.name]["color"]
    axes.plot([time for time, _ in points], [value for _, value in points], color=color, linewidth=0.9)


def _draw_conditions(rates: Axes, gaps: Axes, comparison: Comparison, looks: Looks) -> None:
    """Success rates and cost gaps of all rows, condition by condition."""
    conditions = comparison.conditions
    for position, condition in enumerate(conditions):
        rows = comparison.under(condition)
        for index, row in enumerate(rows):
            place = position + 0.8 * ((index + 0.5) / len(rows) - 0.5)
            _draw_rate(rates, place, row.evaluation.success_rate, looks[row.name])
            _draw_gap(gaps, place, row.evaluation.median_cost_gap, looks[row.name])
        if position:
            for axes in (rates, gaps):
                axes.axvline(position - 0.5, **LIMIT_STYLE)
    names = [name.replace("_", "\n").replace("-", "\n") for name in conditions]
    for axes in (rates, gaps):
        axes.set_xlim(-0.5, len(conditions) - 0.5)
        axes.set_xticks(range(len(conditions)), names, fontsize=8)
        axes.grid(visible=False, axis="x")
    _rates(rates)
    _logarithmic_gaps(gaps)


def _draw_gap(axes: Axes, x: float, gap: Interval, look: dict[str, Any]) -> None:
    """A gap with its interval, in per cent; at the floor as an empty triangle; nothing for NaN."""
    value, low, high = (100.0 * bound for bound in gap)
    if not np.isfinite(value):
        return
    if high > FLOOR:
        axes.plot([x, x], [max(low, FLOOR), high], color=look["color"], linewidth=1.0)
    if value > FLOOR:
        axes.plot([x], [value], linestyle="", **look)
    else:
        at_floor = {**look, "marker": "v", "fillstyle": "none"}
        axes.plot([x], [FLOOR], linestyle="", clip_on=False, **at_floor)


def _draw_rate(axes: Axes, x: float, rate: Interval, look: dict[str, Any]) -> None:
    """A rate with its interval, in per cent."""
    axes.plot([x, x], [100.0 * rate.low, 100.0 * rate.high], color=look["color"], linewidth=1.0)
    axes.plot([x], [100.0 * rate.value], linestyle="", **look)


def _rates(axes: Axes) -> None:
    axes.set_ylim(-3.0, 103.0)
    axes.set_ylabel("success rate [%]", fontsize=8.5)


def _logarithmic_gaps(axes: Axes) -> None:
    axes.set_yscale("log")
    top = axes.get_ylim()[1]
    axes.set_ylim(FLOOR, max(1.5 * top, 1000.0 * FLOOR))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel(f"cost gap [%]; $\\nabla$: below {FLOOR:g}", fontsize=8.5)


def _set_training_axis(axes: Axes, rows: Sequence[Row]) -> None:
    """Label the horizontal axis with round times of training."""
    times = [time for row in rows if (time := _training_seconds(row)) is not None]
    times += [point["seconds"] for row in rows for point in row.facts["learning_curve"]]
    marks = list(_ROUND_TIMES)
    while len(marks) > 2 and marks[1] <= 0.9 * min(times):
        del marks[0]
    while len(marks) > 2 and marks[-2] >= 1.1 * max(times):
        del marks[-1]
    axes.set_xscale("log")
    axes.set_xlim(marks[0], max(marks[-1], 1.1 * max(times)))
    axes.xaxis.set_major_locator(FixedLocator(marks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FixedFormatter([_ROUND_TIMES[mark] for mark in marks]))
    axes.set_xlabel("time of training", fontsize=8.5)
    axes.set_title("Line: validation starts; marker: evaluation", loc="left", fontsize=8.5)


def _median_ratio(row: Row) -> float:
    """Median cost over the median optimum, of the starts whose optimum is known; NaN if none is."""
    optimal = row.evaluation.optimal
    if optimal is None or np.isnan(optimal.cost).all():
        return float("nan")
    known = np.isfinite(optimal.cost)
    return float(np.median(row.evaluation.flights.cost[known]) / np.median(optimal.cost[known]))


def _training_seconds(row: Row) -> float | None:
    """Time of training, s; None without training, or if unknown."""
    seconds = row.evaluation.summary()["training_seconds"]
    return float(seconds) if seconds else None
