"""Space on paper: a parallel projection, and a numbered grid."""

import math
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from experts.figures.style import GRAY, LIGHT_GRAY
from experts.problems.shooting_problem import FloatArray

_CELLS = (1.0, 2.5, 5.0, 10.0)  # times a power of ten, m
_MOST_CELLS = 8
_NUMBER_SIZE = 7.0  # points


class View(NamedTuple):
    """A parallel projection; it keeps lengths across the line of sight."""

    right: FloatArray  # Direction that points right in the picture, shape (3,)
    up: FloatArray  # Direction that points up, shape (3,)
    toward: FloatArray  # Direction to the reader, shape (3,)

    @classmethod
    def of(cls, azimuth: float, elevation: float) -> "View":
        """The view from azimuth and elevation, rad, with z up in the picture."""
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        z = np.array([0.0, 0.0, 1.0])
        toward = np.cos(elevation) * level + np.sin(elevation) * z
        return cls(right, np.cos(elevation) * z - np.sin(elevation) * level, toward)

    def project(self, points: FloatArray) -> FloatArray:
        """Places in the picture, right and up, shape (..., 2), m, of points, shape (..., 3), m."""
        return np.asarray(points @ np.column_stack([self.right, self.up]))


class Grid(NamedTuple):
    """A horizontal grid below things."""

    low: tuple[float, float]  # Smallest x and y, m
    high: tuple[float, float]  # Largest x and y, m
    height: float  # Its z, m
    cell: float  # Distance between lines, m

    @classmethod
    def below(cls, points: FloatArray) -> "Grid":
        """A grid below points, shape (n, 3), m, that reaches beyond them."""
        low, high = points.min(axis=0), points.max(axis=0)
        extent = float((high - low)[:2].max())
        smallest = extent / (_MOST_CELLS - 2)
        power = 10.0 ** math.floor(math.log10(smallest))
        cell = power * next((size for size in _CELLS if power * size >= smallest), _CELLS[-1])
        x0, y0 = np.floor(low[:2] / cell) * cell
        x1, y1 = np.ceil(high[:2] / cell) * cell
        return cls((x0, y0), (x1, y1), float(low[2]) - 0.03 * extent, cell)

    def corners(self) -> FloatArray:
        """Corners, shape (4, 3), m."""
        return np.array(
            [(x, y, self.height) for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])]
        )

    def lines(self, axis: int) -> FloatArray:
        """Coordinates of the lines on the x (0) or y axis (1), m."""
        return np.arange(self.low[axis], self.high[axis] + 0.5 * self.cell, self.cell) + 0.0  # no -0


def draw_grid(axes: Axes, grid: Grid, view: View) -> None:
    """Draw the lines of a grid."""
    (x0, y0), (x1, y1), z = grid.low, grid.high, grid.height
    lines = [[(x, y0, z), (x, y1, z)] for x in grid.lines(0)]
    lines += [[(x0, y, z), (x1, y, z)] for y in grid.lines(1)]
    _draw_lines(axes, view.project(np.array(lines)), LIGHT_GRAY)


def draw_scales(axes: Axes, grid: Grid, view: View, ceiling: float, spacing: float) -> None:
    """Number the lines of a grid and put up a post with the heights; `spacing` is that of numbers, m."""
    for axis in (0, 1):
        _number_edge(axes, grid, view, axis, spacing)
    if view.up[2] > 0.1:  # from straight above, there are no heights to be seen
        _draw_post(axes, grid, view, ceiling, spacing)


def _number_edge(axes: Axes, grid: Grid, view: View, axis: int, spacing: float) -> None:
    """Number the lower edge of the grid in the picture."""
    low, high = np.array([*grid.low, grid.height]), np.array([*grid.high, grid.height])
    middle = 0.5 * (low + high)
    ends = []
    for limit in (low, high):
        end = middle.copy()
        end[1 - axis] = limit[1 - axis]
        ends.append(end)
    edge = min(ends, key=lambda end: tuple(np.round(view.project(end)[::-1], 6)))
    outward = view.project(edge) - view.project(middle)
    # Text is wider than high.
    outward *= spacing * np.array([1.5, 1.0]) / np.linalg.norm(outward)
    for number in grid.lines(axis):
        point = edge.copy()
        point[axis] = number
        _write(axes, view.project(point) + outward, f"${number:g}$")
    _write(axes, view.project(edge) + np.array([2.9, 2.4]) * outward, f"${'xy'[axis]}$ [m]")


def _draw_post(axes: Axes, grid: Grid, view: View, ceiling: float, spacing: float) -> None:
    """Put up a scale of heights at the leftmost corner of the grid."""
    foot = min(grid.corners(), key=lambda corner: float(view.project(corner)[0]))
    start = view.project(foot)
    top = grid.height + float(ceiling - start[1]) / view.up[2]
    first, last = np.ceil(grid.height / grid.cell + 0.3), np.floor(top / grid.cell)
    heights = grid.cell * np.arange(first, last + 1) + 0.0  # no -0
    marks = start + np.outer(heights - grid.height, (0.0, view.up[2]))
    tick = np.array([0.3 * spacing, 0.0])
    lines = [[start, start + np.array([0.0, ceiling - start[1]])], *([mark, mark - tick] for mark in marks)]
    _draw_lines(axes, np.array(lines), GRAY)
    for mark, height in zip(marks, heights, strict=True):
        _write(axes, mark - 2.0 * tick, f"${height:g}$", ha="right")
    _write(axes, lines[0][1] + np.array([0.0, spacing]), "$z$ [m]")


def _draw_lines(axes: Axes, segments: FloatArray, color: str) -> None:
    axes.add_collection(LineCollection(list(segments), colors=color, linewidths=0.5, zorder=2))


def _write(axes: Axes, place: FloatArray, text: str, ha: str = "center") -> None:
    axes.text(place[0], place[1], text, ha=ha, va="center", fontsize=_NUMBER_SIZE, color=GRAY)
