"""What cloning reaches over how many demonstrations it has, as a picture."""

from collections.abc import Sequence
from typing import Any

from agents.imitation.data_efficiency import TITLES, VARIANTS, Point
from experts.report.figures.style import COLORS, LINE_STYLES, WIDTH, as_png

_MARKERS = ("o", "s", "^")
_HEIGHT = 2.9  # inches
_LEAST_GAP = 1e-4


def picture(points: Sequence[Point]) -> bytes:
    """Draw success and cost gap over the number of demonstrations, a curve for each variant.

    Args:
        points: What is measured.

    Returns:
        A PNG file.
    """
    return as_png(lambda: figure(points))


def figure(points: Sequence[Point]) -> Any:
    """Make the figure of `picture`.

    Args:
        points: What is measured.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter, ScalarFormatter

    drawn = Figure(figsize=(WIDTH, _HEIGHT), layout="constrained")
    FigureCanvasAgg(drawn)
    left, right = drawn.subplots(1, 2)
    for variant, color, line, marker in zip(VARIANTS, COLORS, LINE_STYLES, _MARKERS, strict=False):
        mine = [point for point in points if point.variant == variant]
        counts = [point.count for point in mine]
        look = {"color": color, "linestyle": line, "marker": marker, "markersize": 4}
        below = [point.success - point.low for point in mine]
        above = [point.high - point.success for point in mine]
        success = [point.success for point in mine]
        left.errorbar(
            counts, success, [below, above], elinewidth=0.8, capsize=2, label=TITLES[variant], **look
        )
        right.plot(counts, [max(point.gap, _LEAST_GAP) for point in mine], label=TITLES[variant], **look)
    counts = sorted({point.count for point in points})
    for axes, title in ((left, "Successful flights, 95 % intervals"), (right, "Median cost gap")):
        axes.set_title(title, loc="left", fontsize=9.5)
        axes.set_xscale("log")
        axes.margins(x=0.05)
        axes.set_xticks(counts)
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.minorticks_off()
        axes.set_xlabel("demonstrations")
    left.set_ylim(-0.02, 1.02)
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.set_yscale("log")
    right.yaxis.set_major_formatter(PercentFormatter(1.0))
    handles, labels = left.get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside upper center", ncols=len(handles))
    return drawn
