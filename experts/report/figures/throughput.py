"""The throughput of scenes as a picture: states per second over the batch size, other engines as lines.

On the left the kernel of the forward dynamics, on the right the environment, which is what an agent sees.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experts.problem import FloatArray
from experts.report.figures.style import (
    BLACK,
    BLUE,
    GRAY,
    VERMILION,
    WIDTH,
    as_png,
)
from experts.report.throughput.environments import MAKE, MAKE_VEC
from experts.report.throughput.formats import integrator_title
from experts.report.throughput.kernels import VECTOR
from experts.report.throughput.measurement import SceneThroughput
from experts.report.throughput.mujoco_peer import SYNCHRONOUS, SYNCHRONOUS_COPIES, WRAPPED
from experts.report.throughput.timing import DYNAMICS, ENVIRONMENT, OURS, STEP, Timing, fastest, select
from experts.report.throughput.variants import VARIANTS

_ROW_HEIGHT, _LEGEND_HEIGHT = 2.6, 0.4  # inches
_DASHED = (0, (4, 1.5))
_LOOKS = ((BLUE, "o", "-"), (VERMILION, "s", "-"), (BLUE, "o", _DASHED), (VERMILION, "s", _DASHED))
_LABEL_HEIGHT = 0.068  # of a line of text, in heights of a panel


def picture(results: Sequence[SceneThroughput]) -> bytes:
    """Draw states per second over the batch size, a row of two panels for each scene.

    Args:
        results: What is measured of each scene.

    Returns:
        A PNG file.
    """
    return as_png(lambda: throughput_figure(results))


def throughput_figure(results: Sequence[SceneThroughput]) -> Any:
    """Make the figure of `picture`.

    Args:
        results: What is measured of each scene.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height = _ROW_HEIGHT * len(results) + _LEGEND_HEIGHT
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(results), 2, squeeze=False, sharey="row")
    for (left, right), result in zip(panels, results, strict=True):
        engines = ((left, _draw_dynamics(left, result)), (right, _draw_environments(right, result)))
        for axes, timings in engines:
            for timing in timings.values():
                axes.axhline(timing.states_per_second, color=GRAY, linewidth=0.9, zorder=1)
        for axes, timings in engines:  # now that the panels' common limits are known
            _name_lines(axes, timings)
        left.set_ylabel("states or steps per second")
    for axes, label in zip(panels[-1], ("states per call", "environments"), strict=True):
        axes.set_xlabel(label)
    handles, labels = panels[0, 1].get_legend_handles_labels()
    spacing = {"columnspacing": 1.2, "handlelength": 2.0, "handletextpad": 0.5}
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), fontsize=8.5, **spacing)
    return figure


def _draw_dynamics(axes: Any, result: SceneThroughput) -> dict[str, Timing]:
    """Draw ours; name the other engines' times."""
    timings = select(result.timings, what=DYNAMICS)
    _draw_variants(axes, select(timings, engine=OURS, way=VECTOR))
    axes.set_title(f"Scene {result.scene}: forward dynamics", loc="left", fontsize=9.5)
    return {
        f"{timing.engine}, {'C++' if timing.batch > 1 else 'Python'}": timing
        for timing in timings
        if timing.engine != OURS
    }


def _draw_environments(axes: Any, result: SceneThroughput) -> dict[str, Timing]:
    """Draw ours; name the other engines' times."""
    timings = select(result.timings, integrator=result.integrator)
    ours = select(timings, engine=OURS, what=ENVIRONMENT)
    _draw_variants(axes, select(ours, way=MAKE_VEC))
    for single in select(ours, way=MAKE):
        place = (1, single.states_per_second)
        axes.plot(*place, "*", color=BLACK, markersize=8, label=MAKE)
    axes.set_title(f"environment steps, {integrator_title(result.integrator)}", loc="left", fontsize=9.5)
    found = {}
    for engine in dict.fromkeys(timing.engine for timing in timings if timing.engine != OURS):
        theirs = select(timings, engine=engine)
        for name, timing in (
            ("steps in C++", fastest(theirs, what=STEP)),
            (f"{SYNCHRONOUS_COPIES} in {SYNCHRONOUS}", fastest(theirs, way=SYNCHRONOUS)),
            ("gymnasium.make", fastest(theirs, way=WRAPPED)),
        ):
            if timing is not None:
                found[f"{engine}, {name}"] = timing
    return found


def _draw_variants(axes: Any, timings: Sequence[Timing]) -> None:
    """Color and marker for the precision, full lines for one thread, over the batch size."""
    for variant, (color, marker, style) in zip(VARIANTS, _LOOKS, strict=True):
        own = select(timings, **vars(variant))
        axes.plot(
            [timing.batch for timing in own],
            [timing.states_per_second for timing in own],
            color=color,
            marker=marker,
            markersize=3.5,
            fillstyle="full" if variant.threads == 1 else "none",
            linestyle=style,
            label=f"{variant.precision}, {variant.threads} thread{'s' * (variant.threads > 1)}",
        )
    sizes = sorted({timing.batch for timing in timings})
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks(sizes, [str(size) if size < 1024 else f"{size // 1024}k" for size in sizes])
    axes.minorticks_off()
    axes.margins(x=0.05, y=0.08)


def _name_lines(axes: Any, timings: Mapping[str, Timing]) -> None:
    """Write the other engines' names to the right of the panel, each beside its line."""
    ordered = sorted(timings.items(), key=lambda item: item[1].states_per_second)
    low, high = np.log10(axes.get_ylim())
    levels = np.log10([timing.states_per_second for _, timing in ordered])
    for (name, _), level, height in zip(ordered, levels, _apart((levels - low) / (high - low)), strict=True):
        axes.annotate(
            name,
            (1.0, (level - low) / (high - low)),
            (1.05, height),
            xycoords="axes fraction",
            textcoords="axes fraction",
            va="center",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "color": GRAY, "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": 0.0},
        )


def _apart(heights: FloatArray) -> FloatArray:
    """Ascending heights of labels, moved apart as far as their text needs it."""
    moved = heights.copy()
    for index in range(1, len(moved)):
        moved[index] = max(moved[index], moved[index - 1] + _LABEL_HEIGHT)
    return moved - (moved - heights).mean() if len(moved) else moved
