"""Figure 2: snapshots of the spacecraft with the path of its tip and the target."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from dq_space_arm_env.algebra import poses
from experts.figures.schematic import AXIS_COLORS, Faces, Schematic
from experts.figures.space import Grid, View, draw_grid, draw_scales
from experts.figures.style import WIDTH
from experts.maneuver import Maneuver
from experts.problems.shooting_problem import FloatArray

_ELEVATION = np.radians(24.0)
_AZIMUTHS = np.radians(np.arange(15.0, 360.0, 30.0))
_SMALLEST_GAP = 0.5  # between the ends of two axes of the target in the picture, as a share of their length
_SHADOW = "0.9"  # gray


def snapshot_stages(maneuver: Maneuver, count: int) -> list[int]:
    """Stages between which the frames of the arm move equally far, the first and last included."""
    path = np.linalg.norm(np.diff(_origins(maneuver), axis=0), axis=2).sum(axis=1).cumsum()
    stages = np.searchsorted(path, np.linspace(0.0, path[-1], count)[1:-1]) + 1
    return sorted({0, *stages.tolist(), len(path)})


def best_view(maneuver: Maneuver) -> View:
    """The view in which motion is broadside, the tip in front of the base, the target's axes well apart.

    A planar scene is seen from above.
    """
    if maneuver.scene.base.motion == "planar":
        return View.of(-0.5 * np.pi, 0.5 * np.pi)
    origins = _origins(maneuver)[::10]
    spread = np.cov(origins.reshape(-1, 3).T)
    arm = (origins[:, -1] - origins[:, 0]).mean(axis=0)
    end = tuple(np.atleast_2d(np.transpose(maneuver.target))[-1].tolist())
    axes: FloatArray = np.array(poses.to_matrix(end)[0]).T

    def rank(view: View) -> tuple[bool, bool, float]:
        x, y, z = view.project(axes)
        gap = min(float(np.linalg.norm(first - second)) for first, second in ((x, y), (y, z), (z, x)))
        return gap < _SMALLEST_GAP, bool(view.toward @ arm < 0.0), float(view.toward @ spread @ view.toward)

    return min((View.of(azimuth, _ELEVATION) for azimuth in _AZIMUTHS), key=rank)


def _origins(maneuver: Maneuver) -> FloatArray:
    """Origins of all frames, shape (N + 1, frames, 3), m."""
    return np.stack(poses.position(tuple(np.moveaxis(maneuver.frames, -1, 0))), axis=-1)


class SnapshotPainter:
    """Draws stages of a maneuver from one direction, to one scale; `aspect`: width / height."""

    def __init__(self, maneuver: Maneuver, stages: Sequence[int], *, numbered: bool) -> None:
        # Everything is placed first, to know how much room it takes.
        self.view = best_view(maneuver)
        # From the upper left, behind the reader: the faces that are seen are bright.
        light = 0.6 * self.view.toward + 0.7 * self.view.up - 0.4 * self.view.right
        self._maneuver = maneuver
        self._first = stages[0]
        self._schematic = Schematic(maneuver.scene, light)
        self._targets = {stage: self._schematic.target(stage) for stage in stages}
        self._tip_path = _origins(maneuver)[:, -1]
        payload = maneuver.payload
        self._spacecraft = {
            stage: self._schematic.spacecraft(
                maneuver.frames[stage], None if payload is None else payload[stage]
            )
            for stage in stages
        }
        corners = [faces.corners for part in (self._targets, self._spacecraft) for faces in part.values()]
        points = np.concatenate(corners).reshape(-1, 3)
        self._grid = Grid.below(points)
        shown = self.view.project(np.concatenate([points, self._grid.corners()]))
        low, high = shown.min(axis=0), shown.max(axis=0)
        self._spacing = 0.045 * float((high - low).max())
        self._ceiling = float(high[1])
        self._numbered = numbered
        names = [place for stage in stages for *_, place in self._target_arrows(stage)]
        low, high = (
            limit(np.vstack([edge, *(place + side * self._spacing for place in names)]), axis=0)
            for edge, side, limit in ((low, -0.8, np.min), (high, 0.8, np.max))
        )
        # Room for numbers on the left and below, and for the time above.
        self._low = low - np.array([5.8, 3.3] if numbered else [0.5, 0.5]) * self._spacing
        self._high = high + np.array([1.4, 2.2]) * self._spacing
        width, height = self._high - self._low
        self.aspect = float(width / height)

    def draw(self, axes: Axes, stage: int, *, timed: bool = True) -> None:
        """Draw one of the stages, with its time above if `timed`."""
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        path = self._schematic.path(self._tip_path[: stage + 1], 0.007 * self._schematic.reach)
        faces = Faces.joined([self._spacecraft[stage], path, self._targets[stage]])
        self._draw_shadow(axes, faces)
        draw_grid(axes, self._grid, self.view)
        self._draw_faces(axes, faces)
        self._name_target(axes, stage)
        if stage == self._first:
            self._name_tip(axes, stage)
            if self._numbered:
                draw_scales(axes, self._grid, self.view, self._ceiling, self._spacing)
        if timed:
            time = self._maneuver.time[stage]
            axes.text(0.5, 0.985, f"$t$ = {time:.1f} s", transform=axes.transAxes, ha="center", va="top")

    def _name_target(self, axes: Axes, stage: int) -> None:
        """Name the target's axes, and dot them where something hides them."""
        for axis, line, (right, up) in self._target_arrows(stage):
            color = AXIS_COLORS[axis]
            axes.plot(*line.T, color=color, linestyle=":", linewidth=0.7, zorder=3)
            axes.text(right, up, f"${'xyz'[axis]}_D$", color=color, ha="center", va="center")

    def _target_arrows(self, stage: int) -> Iterator[tuple[int, FloatArray, FloatArray]]:
        """Find the ends and the place of the name of each axis of the target that does not point at us."""
        origin, *ends = self.view.project(self._schematic.target_points(stage))
        for axis, end in enumerate(ends):
            length = float(np.linalg.norm(end - origin))
            if length > self._spacing:
                place = end + 1.2 * self._spacing * (end - origin) / length
                yield axis, np.array([origin, end]), place

    def _name_tip(self, axes: Axes, stage: int) -> None:
        """Name the tip where there is most room, away from its axes and the arm."""
        tip, *ends = self.view.project(self._schematic.tip_points(self._maneuver.frames[stage]))
        arm = self.view.project(_origins(self._maneuver)[stage])[::-1]
        lines = [*((tip, end) for end in ends), *pairwise(arm)]
        obstacles = [
            start + share * (end - start) for start, end in lines for share in np.linspace(0.25, 1.0, 4)
        ]
        angles = np.radians(np.arange(0.0, 360.0, 30.0))
        places = tip + 1.3 * self._spacing * np.column_stack([np.cos(angles), np.sin(angles)])
        room = np.linalg.norm(places[:, None] - np.array(obstacles), axis=2).min(axis=1)
        right, up = places[room.argmax()]
        axes.text(right, up, "$G$", ha="center", va="center")

    def _draw_shadow(self, axes: Axes, faces: Faces) -> None:
        """Draw a shadow on the grid, which shows where things are and how high."""
        corners = faces.corners.copy()
        corners[..., 2] = self._grid.height
        self._draw(axes, corners, _SHADOW)

    def _draw_faces(self, axes: Axes, faces: Faces) -> None:
        """Draw the faces that look at the reader, the farthest first."""
        seen = faces.normals @ self.view.toward > 0.0
        corners, colors = faces.corners[seen], faces.colors[seen]
        order = np.argsort(corners.mean(axis=1) @ self.view.toward)
        self._draw(axes, corners[order], colors[order])

    def _draw(self, axes: Axes, corners: FloatArray, colors: FloatArray | str) -> None:
        # The thin edges close the seams between neighbors.
        quadrilaterals = self.view.project(corners)
        axes.add_collection(
            PolyCollection(
                list(quadrilaterals), facecolors=colors, edgecolors=colors, linewidths=0.3, zorder=2
            )
        )


def figure_2(maneuver: Maneuver, count: int = 6) -> Figure:
    """Snapshots of the maneuver, the arm moving equally far between them."""
    stages = snapshot_stages(maneuver, count)
    painter = SnapshotPainter(maneuver, stages, numbered=True)
    columns = min(3, len(stages))
    rows = -(-len(stages) // columns)
    figure = Figure(figsize=(WIDTH, rows * WIDTH / columns / painter.aspect))
    for index, stage in enumerate(stages):
        row, column = divmod(index, columns)
        axes = figure.add_axes((column / columns, 1.0 - (row + 1) / rows, 1.0 / columns, 1.0 / rows))
        painter.draw(axes, stage)
    return figure
