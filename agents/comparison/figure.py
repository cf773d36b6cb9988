"""A comparison as a picture: cost gap over the time of an action, and over the time of training.

Lower left is better. Gaps of zero, or below, have no place on a logarithmic axis: they are drawn on its lower
edge, as triangles, which the axis says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.comparison.comparing import Comparison, Row
from agents.evaluation.runs import agent_of
from agents.evaluation.statistics import Interval
from experts.report.figures.style import BLACK, COLORS, GRAY, LIMIT_STYLE, WIDTH, as_png

FLOOR = 0.01
"""Cost gap that smaller ones are drawn at, %."""

_PANEL_HEIGHT, _LEGEND_ROW = 2.7, 0.2  # inches
MARKERS = ("o", "s", "^", "D", "P", "X", "*", "<", ">", "h", "p")
PALETTE = (*COLORS, BLACK, GRAY)
_LEGEND_COLUMNS = 3
_ROUND_TIMES = {1.0: "1 s", 10.0: "10 s", 60.0: "1 min", 600.0: "10 min", 3600.0: "1 h", 36000.0: "10 h"}


def picture(comparison: Comparison) -> bytes:
    """Draw a comparison.

    Args:
        comparison: The comparison.

    Returns:
        A PNG file.
    """
    return as_png(lambda: comparison_figure(comparison))


def comparison_figure(comparison: Comparison) -> Any:
    """Make the figure of `picture`.

    Args:
        comparison: The comparison. Its first condition is drawn over times; all of them side by side if there
            are several.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first, several = comparison.conditions[0], len(comparison.conditions) > 1
    rows = comparison.under(first)
    looks = _looks(rows)
    trained = [row for row in rows if _training_seconds(row) is not None]
    panels = [_draw_action_times, *([_draw_training_times, _draw_learning_curves] if trained else [])]
    lines = -(-len(looks) // _LEGEND_COLUMNS)
    height = _PANEL_HEIGHT * (1 + several) + _LEGEND_ROW * lines
    figure = Figure(
        figsize=(WIDTH if len(panels) > 1 or several else 0.6 * WIDTH, height), layout="constrained"
    )
    FigureCanvasAgg(figure)
    parts = figure.subfigures(1 + several, 1, squeeze=False)[:, 0]
    over_times = np.atleast_1d(parts[0].subplots(1, len(panels)))
    for axes, draw in zip(over_times, panels, strict=True):
        draw(axes, rows, looks)
    top = max(axes.get_ylim()[1] for axes in over_times[:2]) if trained else None
    for axes in over_times[:2]:
        axes.set_ylim(FLOOR, top)
    if several:
        left, right = parts[1].subplots(1, 2)
        _draw_conditions(left, comparison, looks, "success rate [%]", lambda row: row.evaluation.success_rate)
        _draw_conditions(
            right, comparison, looks, "median cost gap [%]", lambda row: row.evaluation.median_cost_gap
        )
        logarithmic_gaps(right)
    handles = [_handle(name, rows, look) for name, look in looks.items()]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), _LEGEND_COLUMNS),
        fontsize=8.5,
        title=f"Scene {comparison.scene}, {first}: success rates, and 95 % intervals as bars",
        title_fontsize=9,
    )
    return figure


def _handle(name: str, rows: Sequence[Row], look: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D

    rate = next(row.evaluation.success_rate for row in rows if row.evaluation.policy == name)
    return Line2D([], [], linestyle="", label=f"{name}: {100.0 * rate.value:.1f} %", **look)


def _looks(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Color and marker of each row: runs that differ in their seeds share the color."""
    agents: dict[str, int] = {}
    looks = {}
    for index, row in enumerate(rows):
        color = agents.setdefault(agent_of(row.evaluation.metadata) or row.evaluation.policy, len(agents))
        looks[row.evaluation.policy] = {
            "color": PALETTE[color % len(PALETTE)],
            "marker": MARKERS[index % len(MARKERS)],
            "markersize": 5.0,
        }
    return looks


def _draw_action_times(axes: Any, rows: Sequence[Row], looks: dict[str, dict[str, Any]]) -> None:
    """Draw cost gaps over the time of an action."""
    axes.set_xscale("log")
    for row in rows:
        look = looks[row.evaluation.policy]
        draw_gap(axes, 1e6 * row.evaluation.action_seconds, row.evaluation.median_cost_gap, look)
        # The tail as a short dash, without its interval.
        tail = 100.0 * row.evaluation.tail_cost_gap.value
        if np.isfinite(tail) and tail > FLOOR:
            x = 1e6 * row.evaluation.action_seconds
            axes.plot([x], [tail], marker="_", markersize=8.0, color=look["color"])
    axes.margins(x=0.12)
    logarithmic_gaps(axes)
    axes.set_xlabel("time per action [µs]", fontsize=8.5)
    axes.set_title("Marker: median, dash: 95th percentile", loc="left", fontsize=8.5)


def _draw_training_times(axes: Any, rows: Sequence[Row], looks: dict[str, dict[str, Any]]) -> None:
    """Draw cost gaps over the time of training: the learning curve, and what came of it."""
    axes.set_xscale("log")
    for row in rows:
        look, seconds = looks[row.evaluation.policy], _training_seconds(row)
        optimum = _median_optimum(row)
        curve = [(point.seconds, 100.0 * (point.median_cost / optimum - 1.0)) for point in row.curve]
        known = [(max(time, 1.0), max(gap, FLOOR)) for time, gap in curve if np.isfinite(gap)]
        if known:
            axes.plot(*zip(*known, strict=True), color=look["color"], linewidth=0.9)
        if seconds is not None:
            draw_gap(axes, seconds, row.evaluation.median_cost_gap, look)
    logarithmic_gaps(axes)
    _times(axes, rows)
    axes.set_title("Line: validation starts", loc="left", fontsize=8.5)


def _draw_learning_curves(axes: Any, rows: Sequence[Row], looks: dict[str, dict[str, Any]]) -> None:
    """Draw success rates over the time of training: the learning curve, and what came of it."""
    axes.set_xscale("log")
    for row in rows:
        look = looks[row.evaluation.policy]
        seconds = _training_seconds(row)
        if row.curve:
            times = [max(point.seconds, 1.0) for point in row.curve]
            rates = [100.0 * point.success_rate for point in row.curve]
            axes.plot(times, rates, color=look["color"], linewidth=0.9)
        if seconds is not None:
            draw_bar(axes, seconds, row.evaluation.success_rate, look)
    axes.set_ylim(-3.0, 103.0)
    _times(axes, rows)
    axes.set_ylabel("success rate [%]", fontsize=8.5)
    axes.set_title("Line: validation starts", loc="left", fontsize=8.5)


def _draw_conditions(
    axes: Any, comparison: Comparison, looks: dict[str, dict[str, Any]], label: str, value: Any
) -> None:
    """Draw a quantity of all rows, condition by condition."""
    conditions = comparison.conditions
    for position, condition in enumerate(conditions):
        rows = comparison.under(condition)
        for row, offset in zip(rows, spread(len(rows)), strict=True):
            interval, look = value(row), looks[row.evaluation.policy]
            if label.startswith("success"):
                draw_bar(axes, position + offset, interval, look)
            else:
                draw_gap(axes, position + offset, interval, look)
        if position:
            axes.axvline(position - 0.5, **LIMIT_STYLE)
    axes.set_xlim(-0.5, len(conditions) - 0.5)
    axes.set_xticks(range(len(conditions)), [name.replace("_", "\n") for name in conditions], fontsize=8)
    axes.grid(visible=False, axis="x")
    axes.set_ylabel(label, fontsize=8.5)
    if label.startswith("success"):
        axes.set_ylim(-3.0, 103.0)


def draw_gap(axes: Any, x: float, gap: Interval, look: dict[str, Any]) -> None:
    """Draw a gap with its interval, in per cent; on the floor as an empty triangle.

    Args:
        axes: Where.
        x: Place on the horizontal axis.
        gap: The gap, dimensionless; nothing is drawn if it is NaN.
        look: Color and marker.
    """
    value, low, high = (100.0 * bound for bound in gap)
    if not np.isfinite(value):
        return
    if high > FLOOR:
        axes.plot([x, x], [max(low, FLOOR), high], color=look["color"], linewidth=1.0)
    if value > FLOOR:
        axes.plot([x], [value], linestyle="", **look)
    else:
        on_floor = {**look, "marker": "v", "fillstyle": "none"}
        axes.plot([x], [FLOOR], linestyle="", clip_on=False, **on_floor)


def draw_bar(axes: Any, x: float, rate: Interval, look: dict[str, Any]) -> None:
    """Draw a rate with its interval, in per cent.

    Args:
        axes: Where.
        x: Place on the horizontal axis.
        rate: The rate, in [0, 1].
        look: Color and marker.
    """
    axes.plot([x, x], [100.0 * rate.low, 100.0 * rate.high], color=look["color"], linewidth=1.0)
    axes.plot([x], [100.0 * rate.value], linestyle="", **look)


def logarithmic_gaps(axes: Any) -> None:
    """Make the vertical axis that of cost gaps.

    Args:
        axes: Where they are drawn.
    """
    from matplotlib.ticker import FuncFormatter

    axes.set_yscale("log")
    top = axes.get_ylim()[1]
    axes.set_ylim(FLOOR, max(1.5 * top, 1000.0 * FLOOR))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel(f"cost gap [%]; $\\nabla$: below {FLOOR:g}", fontsize=8.5)


def _times(axes: Any, rows: Sequence[Row]) -> None:
    """Make the horizontal axis that of times of training, between round ones."""
    from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

    times = [time for row in rows if (time := _training_seconds(row)) is not None]
    times += [point.seconds for row in rows for point in row.curve]
    marks = list(_ROUND_TIMES)
    while len(marks) > 2 and marks[1] <= 0.9 * min(times):
        del marks[0]
    while len(marks) > 2 and marks[-2] >= 1.1 * max(times):
        del marks[-1]
    axes.set_xlim(marks[0], marks[-1])
    axes.xaxis.set_major_locator(FixedLocator(marks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FixedFormatter([_ROUND_TIMES[mark] for mark in marks]))
    axes.set_xlabel("time of training", fontsize=8.5)


def _median_optimum(row: Row) -> float:
    """Median of the optimal costs, dimensionless; NaN if none is known."""
    optimal = row.evaluation.optimal
    if optimal is None or np.isnan(optimal.cost).all():
        return float("nan")
    return float(np.nanmedian(optimal.cost))


def _training_seconds(row: Row) -> float | None:
    """Time of training, s; None if there was none, or nobody knows."""
    seconds = row.evaluation.summary()["training_seconds"]
    return float(seconds) if seconds else None


def spread(count: int) -> list[float]:
    """Give places side by side within a column of width 1.

    Args:
        count: How many.

    Returns:
        Distances from its middle.
    """
    return [0.8 * ((i + 0.5) / count - 0.5) for i in range(count)]
