"""Pictures of a data set of demonstrations: distributions, and sample trajectories side by side."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from experts.demonstrations import Demonstration, Demonstrations
from experts.demonstrations.facts import Facts, Quantity
from experts.figures.snapshots import SnapshotPainter
from experts.figures.style import BLUE, GREEN, LIMIT_STYLE, PURPLE, VERMILION, WIDTH, encode, house_style
from experts.maneuver import Maneuver
from experts.problems.shooting_problem import FloatArray

_COLUMNS = 4
_MOST_BINS = 40
_SKEWED = 10.0
"""An axis is logarithmic if its largest value exceeds the median by this factor."""
_BLOCKS = 50
"""Parts of a maneuver, each with its share of inputs at a limit."""
_TITLE = 8.5


def distributions(facts: Facts) -> bytes:
    """Draw a histogram of each quantity, as PNG."""
    shown = [quantity for quantity in facts.quantities if len(quantity.values)]
    rows = -(-len(shown) // _COLUMNS)
    with house_style():
        figure = Figure(figsize=(WIDTH, 1.6 * rows), layout="constrained")
        grid = figure.subplots(rows, _COLUMNS, squeeze=False)
        for axes in grid[:, 0]:
            axes.set_ylabel("number")
        for axes in grid.flat[len(shown) :]:
            axes.set_axis_off()
        for axes, quantity in zip(grid.flat, shown, strict=False):
            _draw_histogram(axes, quantity)
        return encode(figure)


def _draw_histogram(axes: Any, quantity: Quantity) -> None:
    failed = np.zeros(0) if quantity.failed is None else quantity.failed
    everything = np.concatenate([quantity.values, failed])
    logarithmic = everything.min() > 0.0 and everything.max() > _SKEWED * np.median(everything)
    edges = _edges(everything, logarithmic)
    axes.hist([quantity.values, failed], edges, stacked=True, color=[BLUE, VERMILION])
    if logarithmic:
        axes.set_xscale("log")
    elif _are_whole(everything):
        axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))
    if quantity.bound is not None:
        axes.axvline(quantity.bound, **LIMIT_STYLE)
    axes.grid(axis="x", visible=False)
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.set_title(quantity.label, loc="left", fontsize=_TITLE)
    axes.tick_params(labelsize=7.5)


def _edges(values: FloatArray, logarithmic: bool) -> FloatArray:
    """Edges of bins: fewer for fewer values, at halves for small whole numbers."""
    low, high = float(values.min()), float(values.max())
    count = int(np.clip(2.0 * len(values) ** 0.5, 5, _MOST_BINS))
    if high == low:
        return np.array([low - 0.5, low + 0.5])
    if _are_whole(values):
        step = max(1.0, np.ceil((high - low + 1.0) / count))
        return np.asarray(np.arange(low - 0.5, high + step, step))
    return np.geomspace(low, high, count + 1) if logarithmic else np.linspace(low, high, count + 1)


def _are_whole(values: FloatArray) -> bool:
    return bool(np.equal(values, np.rint(values)).all())


def samples(demonstrations: Demonstrations, count: int) -> bytes:
    """Draw demonstrations side by side, from the cheapest to the most expensive, as PNG."""
    order = np.argsort(demonstrations.column("cost"), kind="stable")
    positions = order[np.unique(np.linspace(0, len(order) - 1, count).round().astype(np.int64))]
    with house_style():
        # As wide as with all of them, so that one alone is no larger.
        figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
        heights = [1.0, 1.0, 0.8, 0.8, 0.8]
        grid = figure.subplots(5, count, squeeze=False, height_ratios=heights)
        for column, position in enumerate(positions):
            _draw_sample(grid[:, column], demonstrations, demonstrations[int(position)])
        for row, label in zip(grid[2:], ("attitude [°]", "position [m]", "at a limit [%]"), strict=True):
            row[0].set_ylabel(label, fontsize=_TITLE)
            _share_scale(row[: len(positions)])
        for axes in grid[:, len(positions) :].flat:
            axes.set_axis_off()
        return encode(figure)


def _draw_sample(column: Any, demonstrations: Demonstrations, demonstration: Demonstration) -> None:
    """Start, end, errors, and inputs at a limit, one below the other."""
    kernels = demonstrations.kernels
    stages = kernels.stage_parameters(demonstration.parameters)
    controls = kernels.layout.to_control(demonstration.actions, stages[:-1])
    maneuver = Maneuver(demonstration.episode_scene, demonstration.states, controls)
    start, end, attitude, position, limits = column
    last = len(maneuver.time) - 1
    painter = SnapshotPainter(maneuver, [0, last], numbered=False)
    with matplotlib.rc_context({"font.size": 7.0}):
        for axes, stage in ((start, 0), (end, last)):
            painter.draw(axes, stage, timed=False)
    start.set_anchor("N")  # so that titles stand in a row, whatever the shapes of the pictures
    start.set_title(f"problem {demonstration.index}\n$J$ = {demonstration.cost:.4g}", fontsize=_TITLE)
    success = demonstrations.scene.success
    attitude.plot(maneuver.time, np.degrees(maneuver.angle), color=BLUE)
    attitude.axhline(success.attitude_error_deg, **LIMIT_STYLE)
    position.plot(maneuver.time, maneuver.distance, color=GREEN)
    position.axhline(success.position_error, **LIMIT_STYLE)
    share, edges = _limit_share(demonstration.actions, kernels.layout.lower_limits(np.ones(kernels.n_u)))
    limits.stairs(100.0 * share, edges * demonstrations.scene.simulation.dt, color=PURPLE, fill=True)
    limits.set_xlabel("time [s]", fontsize=_TITLE)
    for axes in (attitude, position):
        axes.set_yscale("log")
        axes.tick_params(labelbottom=False)
    for axes in (attitude, position, limits):
        axes.tick_params(labelsize=7.5)


def _share_scale(row: Any) -> None:
    """Give the panels of a row a common scale, numbered at the first."""
    low, high = zip(*(axes.get_ylim() for axes in row), strict=True)
    for axes in row:
        axes.set_ylim(min(low), max(high))
    for axes in row[1:]:
        axes.tick_params(labelleft=False)


def _limit_share(actions: FloatArray, least: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Share of the inputs at a limit in each block of stages, and the edges of the blocks."""
    edges = np.unique(np.linspace(0, len(actions), _BLOCKS + 1).astype(np.int64))
    clamped = np.mean((actions == least) | (actions == 1.0), axis=1)
    return np.add.reduceat(clamped, edges[:-1]) / np.diff(edges), edges
