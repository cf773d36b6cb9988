"""The curves beside the robot, as in the paper's plots: errors of the tip, and inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.viewing.replay.flights import FloatArray, ShownFlight

_ACTUATORS = {
    "base_force": "Force on the base",
    "base_torque": "Torque on the base",
    "joint_torque": "Joint torques",
    "wrist_rate": "Wrist rates",
    "wheel_torque": "Torques on the wheels",
    "thruster_force": "Forces of the thrusters",
}
_EULER_RATES = ("ψ̇", "θ̇", "φ̇")
_SMALL = 0.1  # inputs below this are shown in thousandths of their unit
_APART = 30.0  # times the smallest limit, beyond which inputs are shown as shares of their own


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves of one quantity, of all flights."""

    title: str
    unit: str
    note: str  # limits or tolerance
    names: tuple[str, ...]  # of the curves of a flight
    steps: bool  # whether values hold for a time step; otherwise they belong to instants
    bounds: tuple[float, ...]  # lines to draw where they are in view
    curves: tuple[FloatArray, ...]  # by flight, shape (curves, M) if `steps`, else (curves, M + 1)
    disturbed: tuple[FloatArray | None, ...]  # the same with noise; None without


def panels(flights: Sequence[ShownFlight], scene: Scene) -> list[Panel]:
    """Errors of the tip, then the scene's actuators in the order of the controls."""
    layout, success = StateLayout.of(scene), scene.success
    quiet = (None,) * len(flights)
    angles = tuple(flight.angle[None] for flight in flights)
    distances = tuple(flight.distance[None] for flight in flights)
    tolerances = (success.attitude_error_deg,), (success.position_error,)
    result = [
        _error("Attitude error", "°", tolerances[0], angles, quiet),
        _error("Position error", "m", tolerances[1], distances, quiet),
    ]
    for actuator, title in _ACTUATORS.items():
        entries = getattr(layout.control, actuator)
        if entries.stop > entries.start:
            result.append(_inputs(actuator, title, entries, layout, flights))
    return result


def _error(
    title: str, unit: str, tolerance: tuple[float], curves: tuple[FloatArray, ...], quiet: tuple[None, ...]
) -> Panel:
    return Panel(title, unit, f"tolerance {tolerance[0]:g}", ("",), False, tolerance, curves, quiet)


def _inputs(
    actuator: str, title: str, entries: slice, layout: StateLayout, flights: Sequence[ShownFlight]
) -> Panel:
    limits = layout.control_limit[entries]
    inputs = [each for flight in flights for each in (flight.controls, flight.noise) if each is not None]
    largest = max(float(np.abs(each[:, entries]).max()) for each in inputs)
    scale, prefix = (1e3, "m") if 0.0 < largest < _SMALL else (1.0, "")
    factors: FloatArray = np.full((len(limits), 1), scale)
    unit, shown = layout.control.unit(entries), layout.control.unit(entries, prefix)
    if _APART * limits.min() < limits.max() < np.inf:  # one scale would hide the weak ones
        factors, shown = 100.0 / limits[:, None], "% of each limit"
    sides = (0.0, 1.0) if actuator == "thruster_force" else (-1.0, 1.0)
    ends = (factors[:, 0] * limits)[np.isfinite(limits)]
    bounds = sorted({side * end for end in np.round(ends, 9) for side in sides})
    return Panel(
        title=title,
        unit=shown,
        note=_limit_note(limits, "" if shown == unit else f" {unit}", "" if sides[0] == 0.0 else "±"),
        names=_names(actuator, entries, layout),
        steps=True,
        bounds=tuple(bounds),
        curves=tuple(factors * flight.controls[:, entries].T for flight in flights),
        disturbed=tuple(
            None if flight.noise is None else factors * (flight.controls + flight.noise)[:, entries].T
            for flight in flights
        ),
    )


def _limit_note(limits: FloatArray, unit: str, sign: str) -> str:
    sizes = sorted(set(limits.tolist()))
    if np.isinf(sizes[-1]):
        return "no limit" if len(sizes) == 1 else "some without limit"
    smallest, largest = f"{sizes[0]:g}", f"{sizes[-1]:g}"
    if len(sizes) == 1:
        return f"limit {sign}{largest}{unit}"
    return f"limits {sign}{smallest} to {sign}{largest}{unit}"


def _names(actuator: str, entries: slice, layout: StateLayout) -> tuple[str, ...]:
    """Axes, numbers of joints, or Euler angles."""
    if actuator == "joint_torque":
        return tuple(f"{joint + 1}" for joint in layout.actuated_joints)
    if actuator == "wrist_rate":
        return _EULER_RATES
    if actuator in ("wheel_torque", "thruster_force"):
        return tuple(
            name.rpartition(" ")[0].removeprefix("wheel ").removeprefix("thruster ")
            for name in layout.control.names[entries]
        )
    return tuple(name[-1] for name in layout.control.names[entries])
