"""The house style of figures: size, fonts, colors, line styles; and panels of curves."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experts.problems.shooting_problem import FloatArray

WIDTH = 7.16
"""Width of a figure over both columns of the page, inches."""
DOTS_PER_INCH = 200

# Okabe and Ito's palette, which color-blind readers tell apart; the line styles do so in black and white.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
BLACK, GRAY, LIGHT_GRAY = "#000000", "#707070", "#DDDDDD"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (6, 1.5, 1.2, 1.5)),
    (0, (1.3, 1.3)),
    (0, (2.6, 1.2)),
    (0, (6, 1.3, 1.2, 1.3, 1.2, 1.3)),
)
_MOST_BESIDE = 8  # entries of a legend in a row
LIMIT_STYLE: dict[str, Any] = {"color": GRAY, "linewidth": 0.8, "linestyle": (0, (4, 2)), "zorder": 1}
"""Style of limits and tolerances."""

_SETTINGS: dict[Any, Any] = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9.5,
    "axes.labelsize": 9.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.0,
    "grid.color": LIGHT_GRAY,
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.25,
    "patch.linewidth": 1.25,  # steps are patches
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "legend.columnspacing": 1.6,
    "legend.borderaxespad": 0.0,
    "pdf.fonttype": 42,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw in the house style inside the context; the user's settings of matplotlib stay as they are."""
    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **_SETTINGS}):
        yield


def encode(figure: Figure, file_format: str = "png", dots_per_inch: int = DOTS_PER_INCH) -> bytes:
    """The file of a figure, drawn without pyplot, which would pick a window system and keep the figure."""
    FigureCanvasAgg(figure)
    file = BytesIO()
    figure.savefig(file, format=file_format, dpi=dots_per_inch)
    return file.getvalue()


def plain(text: object) -> str:
    """What names say, as it is: no mathematics between dollars, nothing that legends leave out."""
    shown = str(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def as_png(make: Callable[[], Figure]) -> bytes:
    """Make a figure in the house style and encode it as PNG."""
    with house_style():
        return encode(make())


def finish_panel(axes: Axes, title: str, label: str) -> None:
    """Add title (left) and legend (right, in the panel if too wide) above it, and the label of its y axis."""
    above = axes.set_title(title, loc="left", fontsize=9.5)
    axes.set_ylabel(label)
    handles, _ = axes.get_legend_handles_labels()
    if len(handles) > 1:
        legend = axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.025), ncols=len(handles))
        if legend.get_window_extent().x0 < above.get_window_extent().x1:
            rows = -(-len(handles) // _MOST_BESIDE)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.17 * rows * (high - low))
            axes.legend(loc="upper right", ncols=min(len(handles), _MOST_BESIDE))


def draw_steps(axes: Axes, edges: FloatArray, values: FloatArray, symbols: Sequence[str]) -> None:
    """Draw the columns of `values`, shape (n, inputs), constant between edges, shape (n + 1,)."""
    for index, (column, symbol) in enumerate(zip(values.T, symbols, strict=True)):
        axes.stairs(column, edges, baseline=None, label=symbol, **look(index))


def look(index: int) -> dict[str, Any]:
    """Color and line style of a curve; the seventh has the first color and the second style."""
    return {"color": COLORS[index % 6], "linestyle": LINE_STYLES[(index + index // 6) % 6]}
