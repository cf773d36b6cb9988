"""A comparison under model mismatch as a picture: success and cost gap of each controller, by conditions."""

from __future__ import annotations

from typing import Any

from agents.comparison.figure import (
    MARKERS,
    PALETTE,
    draw_bar,
    draw_gap,
    logarithmic_gaps,
    spread,
)
from agents.residual.evaluation import Comparison
from experts.report.figures.style import LIMIT_STYLE, WIDTH, as_png

_PANEL_HEIGHT = 2.3  # inches


def picture(comparison: Comparison) -> bytes:
    """Draw a comparison.

    Args:
        comparison: The comparison.

    Returns:
        A PNG file.
    """
    return as_png(lambda: mismatch_figure(comparison))


def mismatch_figure(comparison: Comparison) -> Any:
    """Make the figure of `picture`.

    Args:
        comparison: The comparison.

    Returns:
        The figure: success rates above, median cost gaps below.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    names = [row.controller for row in comparison.under(comparison.conditions[0])]
    looks: dict[str, dict[str, Any]] = {
        name: {
            "color": PALETTE[index % len(PALETTE)],
            "marker": MARKERS[index % len(MARKERS)],
            "markersize": 5.0,
        }
        for index, name in enumerate(names)
    }
    figure = Figure(figsize=(WIDTH, 2.0 * _PANEL_HEIGHT + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    for position, condition in enumerate(comparison.conditions):
        rows = comparison.under(condition)
        for row, offset in zip(rows, spread(len(rows)), strict=True):
            draw_bar(above, position + offset, row.success_rate, looks[row.controller])
            draw_gap(below, position + offset, row.cost_gap, looks[row.controller])
        if position:
            for axes in (above, below):
                axes.axvline(position - 0.5, **LIMIT_STYLE)
    above.set_ylabel("success rate [%]", fontsize=8.5)
    above.set_ylim(-3.0, 103.0)
    logarithmic_gaps(below)
    below.set_xlim(-0.5, len(comparison.conditions) - 0.5)
    ticks = [condition.replace("-", "\n") for condition in comparison.conditions]
    below.set_xticks(range(len(ticks)), ticks, fontsize=8.5)
    for axes in (above, below):
        axes.grid(visible=False, axis="x")
    figure.legend(
        handles=[Line2D([], [], linestyle="", label=name, **look) for name, look in looks.items()],
        loc="outside upper center",
        ncols=min(len(names), 4),
        fontsize=8.5,
        title=f"Scene {comparison.scene}: success rates, and median cost gaps to the expert that knows the "
        "masses; bars: 95 % intervals",
        title_fontsize=9,
    )
    return figure
