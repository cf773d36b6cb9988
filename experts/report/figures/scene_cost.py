"""What scenes and their parts cost as a picture: operations and time, relative to those of a whole scene."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experts.report.figures.style import BLACK, BLUE, ORANGE, WIDTH, as_png
from experts.report.scene_cost.measurement import SceneCostReport, SceneRow
from experts.report.scene_cost.records import ratios

_ROW_HEIGHT, _MARGIN_HEIGHT = 0.26, 1.1  # inches
_BAR = 0.38  # height of a bar, in distances of rows


def picture(report: SceneCostReport) -> bytes:
    """Draw operations and time of an environment's step: scenes on the left, parts of one on the right.

    Args:
        report: What is measured.

    Returns:
        A PNG file.
    """
    return as_png(lambda: scene_cost_figure(report))


def scene_cost_figure(report: SceneCostReport) -> Any:
    """Make the figure of `picture`.

    Args:
        report: What is measured.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = max(len(report.scenes), len(report.features))
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * rows + _MARGIN_HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _draw_bars(left, report.scenes, "Scenes")
    _draw_bars(right, report.features, f"Parts of scene {report.output_scene}")
    for axes in (left, right):  # bars are of one height, the first at the top
        axes.set_ylim(rows - 0.5, -0.5)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles))
    return figure


def _draw_bars(axes: Any, rows: Sequence[SceneRow], title: str) -> None:
    """Two bars for each row."""
    found = [ratios(row, rows[0]) for row in rows]
    places = np.arange(len(rows))
    operations = [ratio.environment_operations for ratio in found]
    times = [ratio.environment_time for ratio in found]
    # Hatched, the times differ from the operations in black and white too.
    axes.barh(places - _BAR / 2, operations, _BAR, color=BLUE, label="operations")
    looks = {"color": ORANGE, "hatch": "////", "edgecolor": BLACK, "linewidth": 0.4}
    axes.barh(places + _BAR / 2, times, _BAR, label="time per state", **looks)
    axes.axvline(1.0, color=BLACK, linewidth=0.8)
    axes.set_yticks(places, [row.title for row in rows], fontsize=8.5)
    axes.grid(visible=False, axis="y")
    axes.margins(x=0.05)
    axes.set_xlim(left=0.0)
    axes.set_title(title, loc="left", fontsize=9.5)
    axes.set_xlabel(f"environment step / that of\n“{rows[0].title}” [1]")
