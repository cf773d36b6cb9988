"""The throughput of scenes as a picture: steps per second over the batch size."""

import math
from collections.abc import Sequence
from io import BytesIO
from typing import Any

from dq_space_arm_env.scene import INTEGRATORS
from experts.report.throughput import (
    ENVIRONMENT,
    MAKE,
    MAKE_VEC,
    OURS,
    STEP,
    VECTOR,
    SceneThroughput,
)
from experts.report.throughput_tables import TITLES, select_timings


def picture(results: Sequence[SceneThroughput]) -> bytes:
    """Draw steps per second over the batch size, a panel for each scene, other engines as horizontal lines.

    Args:
        results: What is measured of each scene.

    Returns:
        A PNG file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from experts.report.figures.style import DOTS_PER_INCH, house_style

    columns = min(3, len(results))
    rows = math.ceil(len(results) / columns)
    with house_style():
        figure = Figure(figsize=(max(5.0, 3.2 * columns), 0.9 + 2.9 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, result in zip(panels, results, strict=False):
            _draw_panel(axes, result)
        for axes in panels[len(results) :]:
            axes.set_axis_off()
        figure.supxlabel("environments, or states of a kernel, per call", fontsize=9.5)
        figure.supylabel("steps per second, one thread", fontsize=9.5)
        entries = {
            label: handle
            for axes in panels[: len(results)]
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        labels = sorted(entries)  # Euler above RK4
        handles = [entries[label] for label in labels]
        figure.legend(handles, labels, loc="outside upper center", ncols=4 if columns > 1 else 2)
        file = BytesIO()
        figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def _draw_panel(axes: Any, result: SceneThroughput) -> None:
    """Color for what is timed, full lines for Euler and dashed ones for RK4."""
    from experts.report.figures.style import BLUE, GREEN, PURPLE, VERMILION

    for name, style in zip(INTEGRATORS, ("-", (0, (4, 1.5))), strict=True):
        for what, way, color, marker, title in (
            (STEP, VECTOR, BLUE, "o", "kernel"),
            (ENVIRONMENT, MAKE_VEC, VERMILION, "s", MAKE_VEC),
        ):
            timings = select_timings(result, what, way, name)
            sizes, speeds = [t.batch for t in timings], [1e9 / t.best_ns for t in timings]
            label = f"{title}, {TITLES[name]}"
            axes.plot(sizes, speeds, color=color, linestyle=style, marker=marker, markersize=3.5, label=label)
        (single,) = select_timings(result, ENVIRONMENT, MAKE, name)
        axes.plot(
            [1],
            [1e9 / single.best_ns],
            color=PURPLE,
            linestyle="none",
            marker="D",
            fillstyle="full" if name == INTEGRATORS[0] else "none",
            label=f"{MAKE}, {TITLES[name]}",
        )
        for timing in result.timings:
            if timing.engine != OURS and (timing.what, timing.integrator) == (STEP, name):
                label = f"{timing.engine}, {TITLES[name]}"
                axes.axhline(1e9 / timing.best_ns, color=GREEN, linestyle=style, label=label)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    sizes = sorted({t.batch for t in result.timings if t.way == MAKE_VEC})
    axes.set_xticks(sizes, [str(size) for size in sizes], rotation=45)
    axes.minorticks_off()
    axes.margins(x=0.03)
    axes.set_title(f"scene {result.scene}", loc="left", fontsize=9.5)
