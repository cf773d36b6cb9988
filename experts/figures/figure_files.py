"""The figures of a maneuver as files."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from dq_space_arm_env.common.files import write_atomically
from experts.figures.maneuver_curves import (
    draw_angle,
    draw_distance,
    figure_3,
    figure_4,
    figure_5,
    figure_6,
)
from experts.figures.snapshots import (
    SnapshotPainter,
    figure_2,
    snapshot_stages,
)
from experts.figures.style import (
    encode,
    house_style,
)
from experts.maneuver import FIGURES, Maneuver

_README_SIZE = (8.0, 3.5)  # inches
_README_DOTS = 200


Draw = Callable[[], Figure | None]


def write_figures(
    maneuver: Maneuver, folder: Path, formats: Sequence[str] = ("png",), **more: Draw
) -> list[Path]:
    """Write Figures 2 to 6.

    Args:
        maneuver: A maneuver with a finite trajectory.
        folder: An existing folder.
        formats: File formats: "png", "pdf", or any other that Matplotlib has.
        **more: More figures by the names of their files, each made when called.

    Returns:
        The files; figures of actuators that the scene does not have are left out.
    """
    own = (figure_2, figure_3, figure_4, figure_5, figure_6)
    draw: dict[str, Draw] = {name: partial(each, maneuver) for name, each in zip(FIGURES, own, strict=True)}
    draw |= more
    files = []
    with house_style():
        for name, make in draw.items():
            figure = make()
            for format_ in formats:
                file = folder / f"{name}.{format_}"
                if figure is None:
                    file.unlink(missing_ok=True)  # of an earlier run with another scene
                    continue
                write_atomically(file, encode(figure, format_))
                files.append(file)
    return files


def write_readme_picture(maneuver: Maneuver, file: Path) -> None:
    """Write snapshots and error curves of a finite maneuver into one PNG of 1600 x 700 pixels."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with house_style():
        write_atomically(file, encode(_readme_figure(maneuver), "png", _README_DOTS))


def _readme_figure(maneuver: Maneuver) -> Figure:
    """Four snapshots on the left, attitude and position error on the right."""
    figure = Figure(figsize=_README_SIZE)
    stages = snapshot_stages(maneuver, 4)
    painter = SnapshotPainter(maneuver, stages, numbered=False)
    for index, stage in enumerate(stages):
        row, column = divmod(index, 2)
        painter.draw(figure.add_axes((0.005 + 0.31 * column, 0.5 - 0.5 * row, 0.31, 0.5)), stage)
    upper = figure.add_axes((0.69, 0.61, 0.29, 0.31))
    lower = figure.add_axes((0.69, 0.14, 0.29, 0.31), sharex=upper)
    draw_angle(upper, maneuver, f"Attitude error: {math.degrees(maneuver.angle[-1]):.2g}° at the end")
    draw_distance(lower, maneuver, f"Position error: {maneuver.distance[-1]:.2g} m at the end")
    lower.set_xlabel("time [s]")
    lower.locator_params(axis="x", nbins=4)
    return figure
