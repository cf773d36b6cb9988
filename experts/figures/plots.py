"""Figures of rows: curves, points or bars, by columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dq_space_arm_env.common.tables import Row
from experts.figures.style import (
    BLACK,
    COLORS,
    GRAY,
    LIMIT_STYLE,
    WIDTH,
    as_png,
    plain,
)

PALETTE = (*COLORS, BLACK, GRAY)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "h", "p")
_DASHES = ("-", (0, (4, 1.5)), (0, (1.3, 1.3)))  # once all colors are used
_PANEL_HEIGHT, _BAR_HEIGHT, _LEGEND_LINE = 2.6, 0.26, 0.2  # inches


@dataclass(frozen=True)
class Plot:
    """A figure of rows; text in the column `y` makes horizontal bars.

    Rows without a finite x and y, or not positive on a logarithmic axis, are left out.
    """

    x: str
    y: str
    color: str | None = None  # a curve, its color and its entry in the legend for each value of this column
    marker: str | None = None  # filled markers for its first value, empty ones for others, without lines
    facet: str | None = None  # a panel for each value
    log: str = ""  # logarithmic axes: "", "x", "y" or "xy"
    join: bool = True  # whether lines join the points
    interval: tuple[str, str] | None = None  # columns of bounds, drawn as bars around y
    floor: float | None = None  # smaller values of y are drawn here
    levels: Sequence[float] = ()  # dashed: at these y, or at these x of bars
    labels: Mapping[str, str] = field(default_factory=dict)  # of axes, by column
    columns: int = 2  # of panels
    decorate: Callable[[Axes, Any], object] | None = None  # draws more in the panel of a facet

    def png(self, rows: Sequence[Row]) -> bytes:
        """Draw rows, as a PNG file."""
        return as_png(lambda: self.figure(rows))

    def figure(self, rows: Sequence[Row]) -> Figure:
        """Make the figure; in the house style if called inside its context."""
        facets = list(dict.fromkeys(row[self.facet] for row in rows)) if self.facet and rows else [None]
        curves = list(dict.fromkeys(row[self.color] for row in rows)) if self.color else [None]
        columns = min(len(facets), self.columns)
        bars = self._has_bars(rows)
        names = list(dict.fromkeys(row[self.y] for row in rows)) if bars else []  # alike in all panels
        lines, legend = -(-len(facets) // columns), -(-len(curves) // 4) if self.color else 0
        panel = _PANEL_HEIGHT
        if bars:
            panel = 0.8 + _BAR_HEIGHT * len(names)
        size = (WIDTH, panel * lines + _LEGEND_LINE * (legend + 1))
        figure = Figure(figsize=size, layout="constrained")
        panels = list(figure.subplots(lines, columns, sharey="row" if bars else False, squeeze=False).flat)
        handles: dict[str, Any] = {}
        for axes, facet in zip(panels, facets, strict=False):
            own = [row for row in rows if self.facet is None or row[self.facet] == facet]
            self._draw_panel(axes, facet, own, curves, names)
            handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        for axes in panels[len(facets) :]:
            axes.remove()
        if self.color and len(curves) > 1:
            figure.legend(
                handles.values(),
                handles.keys(),
                loc="outside upper center",
                ncols=min(len(handles), 4),
                fontsize=8.5,
            )
        return figure

    def _has_bars(self, rows: Sequence[Row]) -> bool:
        return any(isinstance(row[self.y], str) for row in rows)

    def _draw_panel(
        self, axes: Axes, facet: Any, rows: Sequence[Row], curves: Sequence[Any], names: Sequence[str]
    ) -> None:
        for axis in self.log:
            axes.set(**{f"{axis}scale": "log"})
        for level in self.levels:
            (axes.axvline if names else axes.axhline)(level, **LIMIT_STYLE)
        if names:
            self._draw_bars(axes, rows, curves, names)
        else:
            for index, curve in enumerate(curves):
                own = [row for row in rows if self.color is None or row[self.color] == curve]
                self._draw_curve(axes, own, index, None if curve is None else plain(curve))
            axes.set_ylabel(self._label(self.y), fontsize=8.5)
            axes.margins(x=0.05, y=0.08)
        if facet is not None:
            axes.set_title(plain(facet), loc="left", fontsize=9)
        axes.set_xlabel(self._label(self.x), fontsize=8.5)
        if self.decorate is not None:
            self.decorate(axes, facet)

    def _draw_curve(self, axes: Axes, rows: Sequence[Row], index: int, label: str | None) -> None:
        look: dict[str, Any] = {
            "color": PALETTE[index % len(PALETTE)],
            "marker": MARKERS[index % len(MARKERS)],
            "linestyle": _DASHES[index // len(PALETTE) % len(_DASHES)] if self.join else "",
            "markersize": 3.5 if self.join else 5.0,
            "linewidth": 1.0,
        }
        shown = [row for row in rows if self._is_drawn(row)]
        kinds = list(dict.fromkeys(row[self.marker] for row in shown)) if self.marker else [None]
        for number, kind in enumerate(kinds):
            own = [row for row in shown if self.marker is None or row[self.marker] == kind]
            x, y = [row[self.x] for row in own], [self._height(row[self.y]) for row in own]
            fill = "none" if number else "full"
            axes.plot(x, y, fillstyle=fill, label=None if number else label, **look)
            if self.interval is not None:
                low, high = ([self._height(row[key]) for row in own] for key in self.interval)
                axes.vlines(x, low, high, color=look["color"], linewidth=1.0)

    def _draw_bars(
        self, axes: Axes, rows: Sequence[Row], curves: Sequence[Any], names: Sequence[str]
    ) -> None:
        height = 0.8 / len(curves)
        for index, curve in enumerate(curves):
            own = [row for row in rows if self.color is None or row[self.color] == curve]
            places = [names.index(row[self.y]) - 0.4 + (index + 0.5) * height for row in own]
            label = None if curve is None else plain(curve)
            # Hatched, every other color is told apart in black and white too.
            look: dict[str, Any] = {"color": COLORS[index % len(COLORS)]}
            if index % 2:
                look |= {"hatch": "////", "edgecolor": BLACK, "linewidth": 0.4}
            axes.barh(places, [row[self.x] for row in own], height, label=label, **look)
        if "x" in self.log:  # bars begin a decade below the shortest
            axes.set_xlim(left=0.1 * min(row[self.x] for row in rows))
        axes.set_yticks(np.arange(len(names)), [plain(name) for name in names], fontsize=8.5)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")

    def _height(self, value: float) -> float:
        return value if self.floor is None else max(value, self.floor)

    def _is_drawn(self, row: Row) -> bool:
        for key, axis in ((self.x, "x"), (self.y, "y")):
            value = row.get(key)
            if isinstance(value, str):
                continue
            if value is None or not np.isfinite(value):
                return False
            if axis in self.log and (value if axis == "x" else self._height(value)) <= 0.0:
                return False
        return True

    def _label(self, column: str) -> str:
        return self.labels.get(column, column.replace("_", " "))
