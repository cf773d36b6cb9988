"""The benchmark of the expert as a picture: how close to the best known cost solvers come in which time.

The upper panels follow single solves, one panel for each start. The lower ones count random starts, one panel
for each scene: the share of which a solver had solved after a time, its cost within 1 % of the best known.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experts.report.figures.style import (
    BLACK,
    COLORS,
    GRAY,
    LIMIT_STYLE,
    WIDTH,
    as_png,
)
from experts.report.solvers.accuracy import SolverComparison
from experts.report.solvers.random_starts import CLOSE, RandomStarts, is_best
from experts.report.solvers.runs import GAPS, relative_gaps
from experts.report.throughput.formats import integrator_title

SMALLEST_GAP = 1e-8
"""Smaller gaps are drawn here: the solvers' tolerance is not far above."""

_COLUMNS = 2
_ROW_HEIGHT, _LEGEND_HEIGHT = 2.5, 0.5  # inches
_PALETTE = (*COLORS, BLACK, GRAY)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_MOST_MARKERS = 25


def picture(comparisons: Sequence[SolverComparison], random_starts: Sequence[RandomStarts]) -> bytes:
    """Draw error against run time.

    Args:
        comparisons: Solvers from the same start, a panel each.
        random_starts: Random starts, a panel for each scene; at least one panel in all.

    Returns:
        A PNG file.
    """
    return as_png(lambda: solvers_figure(comparisons, random_starts))


def solvers_figure(comparisons: Sequence[SolverComparison], random_starts: Sequence[RandomStarts]) -> Any:
    """Make the figure of `picture`.

    Args:
        comparisons: Solvers from the same start, a panel each.
        random_starts: Random starts, a panel for each scene; at least one panel in all.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    solved = [found for found in random_starts if found.starts]
    count = len(comparisons) + len(solved)
    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * rows + _LEGEND_HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    looks = _Looks()
    for axes, comparison in zip(panels, comparisons, strict=False):
        _draw_gaps(axes, comparison, looks)
    for axes, found in zip(panels[len(comparisons) :], solved, strict=False):
        _draw_shares(axes, found, looks)
    for axes in panels[count:]:
        axes.remove()
    labels: dict[str, Any] = {}
    for axes in figure.axes:
        handles, names = axes.get_legend_handles_labels()
        labels |= dict(zip(names, handles, strict=True))
    figure.legend(
        labels.values(), labels.keys(), loc="outside upper center", ncols=min(len(labels), 4), fontsize=8.5
    )
    return figure


class _Looks:
    """Gives each solver a color and a marker of its own, the same in all panels."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def of(self, solver: str) -> dict[str, Any]:
        """Color, marker and label of a solver."""
        if solver not in self._names:
            self._names.append(solver)
        index = self._names.index(solver)
        return {
            "color": _PALETTE[index % len(_PALETTE)],
            "marker": _MARKERS[index % len(_MARKERS)],
            "markersize": 3.5,
            "linewidth": 1.0,
            "label": solver,
        }


def _draw_gaps(axes: Any, comparison: SolverComparison, looks: _Looks) -> None:
    """Draw the gap of every solver after each iteration over time; the first guess has no time."""
    for gap in GAPS:
        axes.axhline(gap, **LIMIT_STYLE)
    for result in comparison.results:
        run = result.run
        gaps = relative_gaps(run, comparison.best[result.formulation])
        axes.plot(
            run.seconds[1:],
            np.maximum(gaps[1:], SMALLEST_GAP),
            markevery=max(len(gaps) // _MOST_MARKERS, 1),
            **looks.of(run.solver),
        )
    _plain_logarithmic_time(axes)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.5 * SMALLEST_GAP)
    axes.margins(x=0.04)
    title = f"Scene {comparison.scene}, {integrator_title(comparison.integrator)}, {comparison.start}"
    axes.set_title(title, loc="left", fontsize=9.5)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("cost above the best known [$-$]")


def _plain_logarithmic_time(axes: Any) -> None:
    """Label times as 0.1, 0.3, 1 s, not as powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _draw_shares(axes: Any, found: RandomStarts, looks: _Looks) -> None:
    """Draw the share of random starts that each solver has solved after a time."""
    count = len(found.starts)
    for name in (solve.solver for solve in found.starts[0].solves):
        times = np.sort(
            [
                solve.seconds
                for start in found.starts
                for solve in start.solves
                if solve.solver == name and is_best(start, solve)
            ]
        )
        axes.step(
            times,
            np.arange(1, len(times) + 1) / count,
            where="post",
            markevery=max(len(times) // _MOST_MARKERS, 1),
            **looks.of(name),
        )
    _plain_logarithmic_time(axes)
    axes.set_ylim(0.0, 1.02)
    axes.margins(x=0.04)
    axes.set_title(f"Scene {found.scene}, {count} random starts", loc="left", fontsize=9.5)
    axes.set_xlabel("time of a solve [s]")
    axes.set_ylabel(f"share within {CLOSE:.0%} of the best [$-$]")
