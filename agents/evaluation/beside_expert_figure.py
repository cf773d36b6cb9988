"""Figures of an agent's flight beside the expert's solution: errors of the tip, and inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from agents.evaluation.beside_expert import SideBySide
from experts.figures.style import (
    BLACK,
    BLUE,
    COLORS,
    GRAY,
    LIMIT_STYLE,
    VERMILION,
    WIDTH,
    plain,
)
from experts.maneuver import ActuatorHistory
from experts.report.maneuver_summary import ACTUATOR_TITLES

_ROW_HEIGHT = 2.0  # inches
_DASHED = (0, (4, 1.5))


def errors_figure(pair: SideBySide) -> Figure:
    """Draw the errors of the tip over time."""
    figure = Figure(figsize=(WIDTH, 1.3 * _ROW_HEIGHT), layout="constrained")
    success = pair.agent.maneuver.scene.success
    left, right = figure.subplots(1, 2)
    for side, color, line in ((pair.expert, BLUE, _DASHED), (pair.agent, VERMILION, "-")):
        flown = side.maneuver
        look: dict[str, Any] = {"color": color, "linestyle": line}
        left.plot(flown.time, np.degrees(flown.angle), **look)
        right.plot(flown.time, flown.distance, **look)
    left.axhline(success.attitude_error_deg, **LIMIT_STYLE)
    left.set_ylabel("attitude error of the tip [deg]")
    right.axhline(success.position_error, **LIMIT_STYLE)
    right.set_ylabel("position error of the tip [m]")
    for axes in (left, right):
        axes.set_yscale("log")
        axes.set_xlabel("time [s]")
    handles = [
        Line2D([], [], color=VERMILION, label=f"{plain(pair.agent.name)}: J = {pair.agent.cost:.6g}"),
        Line2D([], [], color=BLUE, linestyle=_DASHED, label=f"expert: J = {pair.expert.cost:.6g}"),
        Line2D([], [], **{**LIMIT_STYLE, "label": "tolerance"}),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    return figure


def inputs_figure(pair: SideBySide) -> Figure:
    """Draw the inputs over time, one panel per actuator."""
    actuators = list(zip(pair.agent.maneuver.actuators, pair.expert.maneuver.actuators, strict=True))
    columns = min(len(actuators), 2)
    rows = -(-len(actuators) // columns)
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * rows + 0.4), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    step = pair.agent.maneuver.scene.simulation.dt
    for axes, (agent, expert) in zip(panels, actuators, strict=False):
        _draw_inputs(axes, agent, expert, step)
    for axes in panels[len(actuators) :]:
        axes.remove()
    handles = [
        Line2D([], [], color=BLACK, label=plain(pair.agent.name)),
        Line2D([], [], color=BLACK, linestyle=_DASHED, label="expert"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return figure


def _draw_inputs(axes: Any, agent: ActuatorHistory, expert: ActuatorHistory, step: float) -> None:
    """Draw the inputs of an actuator, one color each; the expert's are dashed."""
    axes.axhline(0.0, color=GRAY, linewidth=0.5, zorder=1)
    names = _short(agent.inputs)
    for history, line, width in ((agent, "-", 1.1), (expert, _DASHED, 0.9)):
        edges = step * np.arange(len(history.values) + 1)
        for index, column in enumerate(history.values.T):
            look: dict[str, Any] = {"color": COLORS[index % len(COLORS)], "linestyle": line}
            label = names[index] if history is agent else None
            axes.stairs(column, edges, baseline=None, linewidth=width, label=label, **look)
    title = ACTUATOR_TITLES[agent.name].capitalize()
    axes.set_title(title, loc="left", fontsize=9.5)
    if len(names) > 1:
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.02),
            ncols=len(names),
            fontsize=8.5,
            handlelength=1.2,
            columnspacing=1.0,
            handletextpad=0.4,
        )
    axes.set_ylabel(f"[{agent.unit}]")
    axes.set_xlabel("time [s]")


def _short(names: Sequence[str]) -> list[str]:
    """Names without the words that all of them share."""
    shared = set.intersection(*(set(name.split()) for name in names))
    short = [" ".join(word for word in name.split() if word not in shared) for name in names]
    return short if all(short) else list(names)
