"""Stability as a picture: what extreme masses cost in digits, and stiff springs in energy.

On the left the backward error of the accelerations over the mass ratio, a curve for each formulation; on the
right the largest change of energy of a joint on its spring over the product of time step and frequency, a
curve for each integrator: about 1 where the vibration is damped, at the upper edge where it has blown up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from experts.report.figures.style import (
    BLACK,
    COLORS,
    GRAY,
    LIMIT_STYLE,
    LINE_STYLES,
    WIDTH,
    as_png,
)
from experts.report.stability import mass_properties, stiff_joints
from experts.report.stability.rows import Row

_HEIGHT = 3.4  # inches
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_PALETTE = (*COLORS, BLACK, GRAY)
_SMALLEST = 1e-17


def picture(rows: Sequence[Row]) -> bytes:
    """Draw the curves of the rows.

    Args:
        rows: The rows; at least one of the groups of masses and stiff joints is among them.

    Returns:
        A PNG file.
    """
    return as_png(lambda: stability_figure(rows))


def stability_figure(rows: Sequence[Row]) -> Any:
    """Make the figure of `picture`.

    Args:
        rows: The rows.

    Returns:
        The figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, _HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    masses = [
        row for row in rows if row.group == mass_properties.GROUP and row.name.endswith("backward error")
    ]
    _draw(left, masses, _SMALLEST)
    left.axhline(mass_properties.BACKWARD_BOUND, **LIMIT_STYLE)
    left.set_title("Accelerations, extreme masses", loc="left", fontsize=9.5)
    left.set_xlabel("mass of base / mass of arm [$-$]")
    left.set_ylabel("row-wise backward error [$-$]")
    stiff = [row for row in rows if row.group == stiff_joints.GROUP]
    _draw(right, stiff, 1e-16)
    right.set_ylim(top=3.0 * stiff_joints.LARGEST_CHANGE)
    right.set_title(f"Stiff joint, {stiff_joints.STEPS} steps", loc="left", fontsize=9.5)
    right.set_xlabel(r"$\Delta t\,\omega$ [$-$]")
    right.set_ylabel("largest change / first energy [$-$]")
    return figure


def _draw(axes: Any, rows: Sequence[Row], smallest: float) -> None:
    """A curve for each row that has one, its legend below the panel."""
    shown = [row for row in rows if row.curve]
    for index, row in enumerate(shown):
        axes.plot(
            [x for x, _ in row.curve],
            [max(y, smallest) for _, y in row.curve],
            color=_PALETTE[index % len(_PALETTE)],
            marker=_MARKERS[index % len(_MARKERS)],
            linestyle=LINE_STYLES[index % len(LINE_STYLES)],
            markersize=3.5,
            label=row.subject,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.04)
    if shown:
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.45, -0.2), ncols=1 if len(shown) < 5 else 2, fontsize=8.5
        )
