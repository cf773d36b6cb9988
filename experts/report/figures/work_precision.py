"""Error against run time as a picture: a panel for each motion, and one for the accelerations.

Time runs to the right, error upward: lower left is better. A method of order p falls by p decades of error
for each decade of time; gray lines show these slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experts.report.figures.style import (
    BLACK,
    COLORS,
    GRAY,
    LIGHT_GRAY,
    LIMIT_STYLE,
    WIDTH,
    as_png,
)
from experts.report.throughput.timing import FLOAT64
from experts.report.work_precision.benchmark import WorkPrecision
from experts.report.work_precision.choices import ACCURACIES
from experts.report.work_precision.formulations import Formulations
from experts.report.work_precision.measurement import CaseResult, Curve

SMALLEST_ERROR = 1e-16
"""Smaller errors are drawn here."""

_COLUMNS = 2
_ROW_HEIGHT, _LEGEND_HEIGHT = 2.7, 0.6  # inches
_FAN_TIME, _FAN_ERROR = 0.5, 3.5  # decades
_PALETTE = (*COLORS, BLACK, GRAY)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "h", "p")
_LINES = ("-", (0, (4, 1.5)))  # once all colors are used, dashed


def picture(found: WorkPrecision) -> bytes:
    """Draw error against run time.

    Args:
        found: What is measured; at least one motion, or the formulations.

    Returns:
        A PNG file.
    """
    return as_png(lambda: work_precision_figure(found))


def work_precision_figure(found: WorkPrecision) -> Any:
    """Make the figure of `picture`.

    Args:
        found: What is measured; at least one motion, or the formulations.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(found.cases) + (found.formulations is not None)
    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * rows + _LEGEND_HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    methods = list(dict.fromkeys(curve.method for case in found.cases for curve in case.curves))
    labels: dict[str, Any] = {}
    for axes, case in zip(panels, found.cases, strict=False):
        _draw_case(axes, case, methods)
        handles, names = axes.get_legend_handles_labels()
        labels |= dict(zip(names, handles, strict=True))
    if found.formulations is not None:
        _draw_formulations(panels[count - 1], found.formulations)
    for axes in panels[count:]:
        axes.remove()
    if labels:
        figure.legend(
            labels.values(),
            labels.keys(),
            loc="outside upper center",
            ncols=min(len(labels), 4),
            fontsize=8.5,
        )
    return figure


def _look(index: int) -> dict[str, Any]:
    """Color and marker of the method of this number."""
    return {
        "color": _PALETTE[index % len(_PALETTE)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "linestyle": _LINES[index // len(_PALETTE) % len(_LINES)],
        "markersize": 3.5,
        "linewidth": 1.0,
    }


def _draw_case(axes: Any, case: CaseResult, methods: Sequence[str]) -> None:
    """Draw the error of each method over its time in a batch."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.5 * SMALLEST_ERROR, 2.0)
    for accuracy in ACCURACIES:
        axes.axhline(accuracy, **LIMIT_STYLE)
    if case.uncertainty is not None:
        # Below, the reference itself is not known.
        axes.axhspan(SMALLEST_ERROR, max(case.uncertainty, SMALLEST_ERROR), color=LIGHT_GRAY, zorder=0)
    for curve in case.curves:
        times = [1e-3 * point.batch_ns for point in curve.points]
        errors = np.maximum([point.errors.pose for point in curve.points], SMALLEST_ERROR)
        label = f"{curve.title} ({curve.order})" if not curve.method.startswith("paper") else curve.title
        axes.plot(times, errors, label=label, **_look(methods.index(curve.method)))
    axes.margins(x=0.04)
    _draw_slopes(axes, case.curves)
    axes.set_title(case.title, loc="left", fontsize=9)
    axes.set_xlabel("time per simulated second, one of 1024 [µs]", fontsize=8.5)
    axes.set_ylabel("error of the tip [m, rad]", fontsize=8.5)


def _draw_slopes(axes: Any, curves: Sequence[Curve]) -> None:
    """Draw a fan of slopes in the lower left corner, one for each order among the methods."""
    left, right = axes.get_xlim()
    start = left * (right / left) ** 0.03
    top = 1e-11
    for order in sorted({curve.order for curve in curves}):
        decades = min(_FAN_TIME, _FAN_ERROR / order)
        x, y = start * 10.0**decades, top * 10.0 ** (-order * decades)
        axes.plot([start, x], [top, y], color=GRAY, linewidth=0.7, zorder=1)
        axes.annotate(str(order), (x, y), (2, -3), textcoords="offset points", fontsize=7, color=GRAY)
    axes.annotate("order", (start, top), (0, 2), textcoords="offset points", fontsize=7, color=GRAY)
    axes.set_xlim(left, right)


def _draw_formulations(axes: Any, found: Formulations) -> None:
    """Draw each formulation's error over its time: full markers in float64, empty ones in float32."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    names = list(dict.fromkeys(result.name for result in found.results))
    for result in found.results:
        time = result.single_ns if result.batch_ns is None else result.batch_ns
        look = {**_look(names.index(result.name)), "linestyle": "", "markersize": 6}
        double = result.precision == FLOAT64
        axes.plot(
            [time],
            [max(result.largest_error, SMALLEST_ERROR)],
            fillstyle="full" if double else "none",
            label=result.name if double else None,
            **look,
        )
    axes.margins(x=0.2, y=0.15)
    axes.legend(loc="center right", fontsize=7.5)
    axes.set_title("Accelerations; empty: float32", loc="left", fontsize=9)
    axes.set_xlabel("time per call, one of 1024 [ns]", fontsize=8.5)
    axes.set_ylabel("largest relative error [$-$]", fontsize=8.5)
