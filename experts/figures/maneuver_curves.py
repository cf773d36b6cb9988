"""Figures 3 to 6, curves over time; and the convergence of the solver, curves over its iterations."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from dq_space_arm_env.scene import StateLayout
from experts.ddp.solution import Solution
from experts.figures.style import (
    BLACK,
    BLUE,
    LIMIT_STYLE,
    LINE_STYLES,
    VERMILION,
    WIDTH,
    draw_steps,
    finish_panel,
    look,
)
from experts.maneuver import (
    ActuatorHistory,
    Maneuver,
)

_TITLES = {
    "base_force": ("Force on the base", "force"),
    "base_torque": ("Torque on the base", "torque"),
    "joint_torque": ("Joint torques", "torque"),
    "wrist_rate": ("Euler angle rates of the wrist", "rate"),
    "wheel_torque": ("Torques on the wheels", "torque"),
    "thruster_force": ("Forces of the thrusters", "force"),
}
_EULER_RATES = (r"$\dot{\psi}$", r"$\dot{\theta}$", r"$\dot{\phi}$")
_SMALL = 0.1  # below this, inputs are shown in thousandths of their unit
_NEAR = 0.5  # from this share of a limit on, the limit is drawn

_WIDE = 1e3  # costs that are numbered at powers of ten alone
_MOST_MARKERS = 60  # iterations that are marked one by one


def figure_3(maneuver: Maneuver) -> Figure:
    """Error quaternion and position error in the axes of the tip."""
    figure, (upper, lower) = _stacked(2)
    planar = maneuver.scene.base.motion == "planar"
    time, quaternion = maneuver.time, maneuver.error_pose[:, :4]
    upper.plot(time, quaternion[:, 0], color=BLACK, linestyle=LINE_STYLES[3], label="$q_0$")
    for axis in (2,) if planar else (0, 1, 2):
        upper.plot(time, quaternion[:, axis + 1], label=f"$q_{axis + 1}$", **look(axis))
    finish_panel(upper, r"Error quaternion $q_{D/G}$", "component [$-$]")
    for axis in (0, 1) if planar else (0, 1, 2):
        lower.plot(time, maneuver.position_error[:, axis], label=f"$r_{'xyz'[axis]}$", **look(axis))
    finish_panel(lower, r"Position error $r_{D/G}$ in the axes of $G$", "position [m]")
    return figure


def figure_4(maneuver: Maneuver) -> Figure:
    """Euler angle of the attitude error and length of the position error."""
    figure, (upper, lower) = _stacked(2)
    success = maneuver.scene.success
    angle, distance = np.degrees(maneuver.angle[-1]), maneuver.distance[-1]
    tolerated_angle, tolerated_distance = success.attitude_error_deg, success.position_error
    title = "Euler angle of the attitude error"
    draw_angle(upper, maneuver, f"{title}: {_ending(angle, tolerated_angle, '°')}")
    title = "Length of the position error"
    draw_distance(lower, maneuver, f"{title}: {_ending(distance, tolerated_distance, ' m')}")
    upper.axhline(tolerated_angle, **LIMIT_STYLE)
    lower.axhline(tolerated_distance, **LIMIT_STYLE)
    return figure


def _ending(end: float, tolerance: float, unit: str) -> str:
    return f"{end:.2g}{unit} at the end (dashed: tolerance {tolerance:g}{unit})"


def draw_angle(axes: Axes, maneuver: Maneuver, title: str) -> None:
    """Draw the Euler angle of the attitude error."""
    axes.plot(maneuver.time, np.degrees(maneuver.angle), color=BLUE)
    axes.set_ylim(bottom=0.0)
    finish_panel(axes, title, "angle [deg]")


def draw_distance(axes: Axes, maneuver: Maneuver, title: str) -> None:
    """Draw the length of the position error."""
    axes.plot(maneuver.time, maneuver.distance, color=VERMILION)
    axes.set_ylim(bottom=0.0)
    finish_panel(axes, title, "distance [m]")


def figure_5(maneuver: Maneuver) -> Figure | None:
    """Force and torque on the base, of wheels and thrusters; None without them."""
    return _inputs(maneuver, "base_force", "base_torque", "wheel_torque", "thruster_force")


def figure_6(maneuver: Maneuver) -> Figure | None:
    """Joint torques and Euler angle rates; None without joint motors and driven wrist."""
    return _inputs(maneuver, "joint_torque", "wrist_rate")


def _inputs(maneuver: Maneuver, *names: str) -> Figure | None:
    actuators = [actuator for actuator in maneuver.actuators if actuator.name in names]
    if not actuators:
        return None
    figure, panels = _stacked(len(actuators))
    for axes, actuator in zip(panels, actuators, strict=True):
        _draw_actuator(axes, maneuver, actuator)
    return figure


def _draw_actuator(axes: Axes, maneuver: Maneuver, actuator: ActuatorHistory) -> None:
    largest = float(actuator.largest.max())
    scale, prefix = (1e3, "m") if 0.0 < largest < _SMALL else (1.0, "")
    draw_steps(axes, maneuver.time, scale * actuator.values, _symbols(maneuver, actuator))
    near = [limit for limit in sorted(set(actuator.limits.tolist())) if largest >= _NEAR * limit]
    for limit in near:
        for side in (0.0 if actuator.name == "thruster_force" else -limit, limit):
            axes.axhline(scale * side, **LIMIT_STYLE)
    title, quantity = _TITLES[actuator.name]
    layout = StateLayout.of(maneuver.scene)
    unit = layout.control.unit(getattr(layout.control, actuator.name), prefix)
    finish_panel(axes, f"{title} ({_limit_note(actuator, near)})", f"{quantity} [{unit}]")


def _limit_note(actuator: ActuatorHistory, drawn: list[float]) -> str:
    """The limits, and whether they are in the picture."""
    limits = sorted(set(actuator.limits.tolist()))
    if len(limits) > 1:
        return "dashed: limits" if drawn else "limits off the scale"
    if limits[0] == np.inf:
        return "no limit"
    sides = "0 to " if actuator.name == "thruster_force" else "±"
    written = f"{sides}{limits[0]:g} {actuator.unit}"
    return f"dashed: limit {written}" if drawn else f"limit {written}, off the scale"


def _symbols(maneuver: Maneuver, actuator: ActuatorHistory) -> list[str]:
    """Symbols of the inputs: by axis, joint number or Euler angle."""
    if actuator.name == "joint_torque":
        return [rf"$\tau_{{{joint + 1}}}$" for joint in StateLayout.of(maneuver.scene).actuated_joints]
    if actuator.name == "wrist_rate":
        return list(_EULER_RATES)
    if actuator.name in ("wheel_torque", "thruster_force"):
        letter = "u" if actuator.name == "wheel_torque" else "f"
        return [f"${letter}_{{{i + 1}}}$" for i in range(len(actuator.inputs))]
    letter = "f" if actuator.name == "base_force" else r"\tau"
    return [rf"${letter}_{name[-1]}$" for name in actuator.inputs]


def convergence_figure(
    solution: Solution, start_cost: float, tolerance: float, seconds: float
) -> Figure | None:
    """Cost, expected decrease, step length and damping over the iterations; None without iterations."""
    history = solution.history
    if len(history) == 0:
        return None
    figure, (cost, decrease, step) = _stacked(3, height=1.15)
    done = np.concatenate([[0], history["iteration"]])
    marked = len(history) <= _MOST_MARKERS
    line, cross = (".-", "x--") if marked else ("-", "--")
    # The penalties of doing nothing are not known here: under constraints the first iteration comes first.
    costs = np.array([start_cost if solution.constraints is None else np.nan, *history["cost"]])
    cost.semilogy(done, costs, line, color=BLUE)
    # Whether the powers of ten alone number the axis: without numbers between them a short one has none.
    is_wide = np.nanmax(costs) > _WIDE * np.nanmin(costs)
    cost.yaxis.set_major_locator(LogLocator(subs=(1.0,) if is_wide else (1.0, 2.0, 5.0)))
    cost.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    cost.yaxis.set_minor_formatter(NullFormatter())
    minimized = "$J$" if solution.constraints is None else "$J$ + penalties"
    finish_panel(cost, f"Cost {minimized}, in the end $J$ = {solution.cost:.6g}", f"{minimized} [$-$]")
    # Known before each iteration, and at the end.
    expected = np.array([*history["optimality"], solution.optimality])
    decrease.semilogy(done, np.where(expected > 0.0, expected, np.nan), line, color=BLUE)
    decrease.axhline(tolerance, **LIMIT_STYLE)
    finish_panel(decrease, "Decrease that the model expects (dashed: tolerance)", "relative to cost [$-$]")
    for name, label, color, style in (
        ("alpha", "step length", BLUE, line),
        ("regularization", "damping", VERMILION, cross),
    ):
        step.semilogy(
            history["iteration"],
            np.where(history[name] > 0.0, history[name], np.nan),
            style,
            color=color,
            label=label,
        )
    finish_panel(step, "Step length and damping (zero is not shown)", "[$-$]")
    step.set_xlabel(f"iterations done ({seconds:.2g} s in all)")
    step.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    step.set_xlim(-0.012 * done[-1], 1.012 * done[-1])
    return figure


def _stacked(rows: int, height: float = 1.5) -> tuple[Figure, list[Axes]]:
    """Panels in a column over the same time, with the same margins in all figures."""
    left, right, below, above, between = 0.66, 0.16, 0.42, 0.27, 0.40  # inches
    total = rows * height + (rows - 1) * between + below + above
    figure = Figure(figsize=(WIDTH, total))
    figure.subplots_adjust(
        left / WIDTH, below / total, 1.0 - right / WIDTH, 1.0 - above / total, hspace=between / height
    )
    panels = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    for panel in panels:
        panel.yaxis.set_label_coords(-0.72 * left / (WIDTH - left - right), 0.5)
    panels[-1].set_xlabel("time [s]")
    return figure, panels
