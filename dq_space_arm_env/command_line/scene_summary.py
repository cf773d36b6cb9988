"""Summary of a scene: bodies, state, inputs, task, and the parts that it leaves out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

from rich.console import Console
from rich.text import Text

from dq_space_arm_env.common.shown_text import yaml_like
from dq_space_arm_env.common.tables import TextTable
from dq_space_arm_env.scene import Link, Pose, Scene, StateLayout, Success
from dq_space_arm_env.scene.constraint_rows import path_rows
from dq_space_arm_env.scene.parameters import is_part
from dq_space_arm_env.scene.path import first_velocity
from dq_space_arm_env.task.step_report import observation_entries

_ACTUATORS = {
    "base_force": "thrusters: no force on the base",
    "base_torque": "wheels: no torque on the base",
    "joint_torque": "joint motors: all joints are passive",
    "wrist_rate": "motors of the wrist: its angles are constant",
}


def record(scene: Scene) -> dict[str, Any]:
    """Describe a scene for programs."""
    layout = StateLayout.of(scene)
    return {
        "name": scene.name,
        "description": scene.description,
        "content_hash": scene.content_hash(),
        "bodies": [dict(zip(("name", "mass_kg", "role"), body, strict=True)) for body in _bodies(scene)],
        "observation": _entries(*zip(*observation_entries(scene), strict=True)),
        "states": _entries(layout.state.names, layout.state.units),
        "tangent": _entries(layout.tangent.names, layout.tangent.units),
        "inputs": [
            {**entry, "limit": float(limit), "weight": float(weight)}
            for entry, limit, weight in zip(
                _entries(layout.control.names, layout.control.units),
                layout.control_limit,
                layout.control_weight,
                strict=True,
            )
        ],
        "parameters": [
            {**entry, "nominal": nominal}
            for entry, nominal in zip(
                _entries(layout.parameters.names, layout.parameters.units),
                layout.parameters.nominal.tolist(),
                strict=True,
            )
        ],
        "left_out": list(left_out(scene)),
        "scene": scene.model_dump(mode="json"),
    }


def print_scene(console: Console, scene: Scene) -> None:
    """Describe a scene for people."""
    layout = StateLayout.of(scene)
    console.print(
        Text(f"{scene.name}: {scene.description}" if scene.description else scene.name, style="bold")
    )
    bodies = [(name, f"{mass:g}", role) for name, mass, role in _bodies(scene)]
    _print(console, "Bodies", ("", "kg", ""), bodies, right=(1,))
    states = [
        (_range(part), title, str(part.stop - part.start), unit)
        for title, part, unit in _state_parts(layout)
        if part.stop > part.start
    ]
    title = f"State, {layout.n_x} numbers; tangent, {layout.n_t}"
    _print(console, title, ("entries", "", "numbers", "unit"), states, right=(2,))
    inputs = [
        (str(i), name, _limit(float(limit)), unit, f"{weight:g}")
        for i, (name, unit, limit, weight) in enumerate(
            zip(
                layout.control.names,
                layout.control.units,
                layout.control_limit,
                layout.control_weight,
                strict=True,
            )
        )
    ]
    heading = ("entry", "", "limit", "unit", "weight")
    jets = scene.actuators.thrusters is not None
    title = f"Inputs, {layout.n_u} numbers{'; forces of thrusters are 0 or more' if jets else ''}"
    _print(console, title, heading, inputs, right=(2, 4))
    observed = [(str(i), *entry) for i, entry in enumerate(observation_entries(scene))]
    title = f"Observation, {len(observed)} numbers; actions are inputs over their limits, in [-1, 1]"
    title += "; thrusters are off at 0 and below" if jets else ""
    _print(console, title, ("entry", "", "unit"), observed)
    varies = layout.parameters
    if varies.names:
        rows = [
            (str(i), name, f"{_whole(nominal) if is_part(name, 'target') else nominal:g}", unit)
            for i, (name, nominal, unit) in enumerate(
                zip(varies.names, varies.nominal, varies.units, strict=True)
            )
        ]
        title = f"Parameters, {layout.n_p} numbers that vary"
        _print(console, title, ("entry", "", "nominal", "unit"), rows, right=(2,))
    _print(console, "Task", ("", ""), list(_task(scene)))
    if scene.phases:
        headings = ("", "steps", "changes", "caught within")
        _print(console, "Phases", headings, list(_phases(scene)), right=(1,))
    absent = [(part,) for part in left_out(scene)] or [("nothing",)]
    _print(console, "Not in this scene: no states, no operations", ("",), absent)


def left_out(scene: Scene) -> Iterator[str]:
    """List the parts that a scene could have and does not."""
    if scene.base.motion == "planar":
        yield "three degrees of freedom of the base: it moves in the plane"
    if not scene.links:
        yield "links: the tip is fixed to the base"
    if scene.wrist is None:
        yield "wrist"
    if scene.payload is None:
        yield "payload"
    if scene.tip_wrench is None:
        yield "wrench at the tip"
    for name, meaning in _ACTUATORS.items():
        needs = {"joint_torque": bool(scene.links), "wrist_rate": scene.wrist is not None}
        one_by_one = {"base_torque": scene.actuators.wheels, "base_force": scene.actuators.thrusters}
        if one_by_one.get(name) is not None:
            continue
        if getattr(scene.actuators, name) is None and needs.get(name, True):
            yield meaning
    passive = [link.name for link in scene.links if not (link.actuated or link.is_fixed)]
    if passive:
        yield f"motors of {', '.join(passive)}"
    if scene.links and not any(link.stiffness or link.damping for link in scene.links):
        yield "springs and dampers of the joints"
    if scene.links and not any(link.motor for link in scene.links):
        yield "rotors, friction and elastic gears of the joints"
    drawn = {name for name, width in scene.spread.model_dump(exclude={"observed"}).items() if width}
    target = {name for name in drawn if name.startswith(("target", "grasp"))}
    masses = {name for name in drawn if "mass" in name or "inertia" in name}
    groups = {"start": drawn - target - masses, "target": target, "masses and inertias": masses}
    same = [part for part, names in groups.items() if not names]
    if same:
        yield f"random draws of {' and of '.join(same)}: the same in every episode"


def _bodies(scene: Scene) -> Iterator[tuple[str, float, str]]:
    yield "base", scene.base.mass, "floats freely" if scene.base.motion == "spatial" else "moves in the plane"
    for link in scene.links:
        drive = "driven joint" if link.actuated and scene.actuators.joint_torque else "passive joint"
        drive = drive if link.joint_type == "revolute" else f"{link.joint_type}, {drive}"
        drive = "fixed" if link.is_fixed else drive
        spring = f", spring of {link.stiffness:g} {link.effort_unit}/{link.unit}" if link.stiffness else ""
        damper = f", damper of {link.damping:g} {link.effort_unit} s/{link.unit}" if link.damping else ""
        yield link.name, link.mass, f"{drive}{spring}{damper}{_motor(link)}"
    if scene.wrist is not None:
        yield "wrist", 0.0, "spherical joint, commanded by its Euler rates"
    held = [("payload", "the tip", scene.payload)]
    held += [(f"payload of {tip.name}", tip.name, tip.payload) for tip in scene.other_tips]
    for name, tip_name, payload in held:
        if payload is not None:
            yield name, payload.mass, f"held rigidly at {tip_name}"


def _motor(link: Link) -> str:
    motor, words = link.motor, ""
    if motor is not None and motor.inertia:
        words += f", rotor of {motor.reflected_inertia:g} {'kg m^2' if link.turns else 'kg'} at the joint"
    if motor is not None and motor.stiffness is not None:
        words += f" behind a gear of {motor.stiffness:g} {link.effort_unit}/{link.unit}"
    if motor is not None and motor.friction:
        words += f", friction of {motor.friction:g} {link.effort_unit}"
    return words


def _state_parts(layout: StateLayout) -> list[tuple[str, slice, str]]:
    state = layout.state
    units = [_units(state.units[part]) for part in (state.joint_angles, state.joint_rates)]
    return [
        ("pose of the base q_{e0/I}", state.pose, "1, m"),
        ("joint angles", state.joint_angles, units[0]),
        ("wrist angles psi, theta, phi", state.wrist_angles, "rad"),
        ("angular velocity of the base, base axes", state.angular_velocity, "rad/s"),
        ("linear velocity of the base, base axes", state.linear_velocity, "m/s"),
        ("joint rates", state.joint_rates, units[1]),
        ("motor angles of elastic joints", state.motor_angles, _units(state.units[state.motor_angles])),
        ("motor rates of elastic joints", state.motor_rates, _units(state.units[state.motor_rates])),
        ("axial momenta of the wheels", state.wheel_momenta, "N m s"),
        ("mass of the propellant", state.propellant, "kg"),
        ("previous controls", state.actuators, _units(state.units[state.actuators])),
        ("commands on their way and outputs", state.drives, _units(state.units[state.drives])),
    ]


def _units(units: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(units))


def _task(scene: Scene) -> Iterator[tuple[str, str]]:
    simulation, success = scene.simulation, scene.success
    seconds = simulation.steps * simulation.dt
    yield "duration", f"{seconds:g} s: {simulation.steps} steps of {simulation.dt:g} s"
    yield "integrator", f"{simulation.integrator}, {simulation.precision}"
    position, rotation = scene.target.pose.position, scene.target.pose.rotation
    yield "target", f"{_vector(position)} m, rotation {_vector(rotation)}"
    if scene.target.grasp != Pose():
        position, rotation = scene.target.grasp.position, scene.target.grasp.rotation
        yield "grasp frame", f"{_vector(position)} m, rotation {_vector(rotation)}"
    for tip in scene.other_tips:
        position, rotation = tip.goal.position, tip.goal.rotation
        where = "of the target" if tip.relative_to == "target" else "in space"
        yield f"goal of {tip.name}", f"{_vector(position)} m, rotation {_vector(rotation)}, {where}"
    if scene.target.motion is not None:
        twist = first_velocity(scene)
        at_start = f"{_vector(twist[:3])} rad/s, {_vector(twist[3:])} m/s at the start, body axes"
        yield "target's motion", f"{scene.target.motion.kind}, {at_start}"
    largest = _tolerances(success)
    yield "success", f"within {', '.join(largest[:-1])} and {largest[-1]} at the end"
    for constraint in scene.constraints:
        rows = len(path_rows(scene.model_copy(update={"constraints": (constraint,)})))
        what = f", {rows} row{'s' * (rows > 1)} along the path"
        if not rows:
            what = ", at the end" if constraint.kind == "terminal" else ", no row: its volumes never meet"
        yield "constraint", f"{constraint.name}: {constraint.kind.replace('_', ' ')}{what}"


def _tolerances(success: Success) -> list[str]:
    largest = [f"{success.attitude_error_deg:g} degrees", f"{success.position_error:g} m"]
    if success.angular_velocity_error_deg is not None:
        largest.append(f"{success.angular_velocity_error_deg:g} deg/s")
    if success.velocity_error is not None:
        largest.append(f"{success.velocity_error:g} m/s")
    return largest


def _phases(scene: Scene) -> Iterator[tuple[str, str, str, str]]:
    """Name and steps of each phase, beside and below them a change or a tolerance of its catch a row."""
    for phase in scene.phases:
        changes = [f"{path}: {yaml_like(value)}" for path, value in phase.changes] or ["nothing"]
        caught = [] if phase.catch is None else _tolerances(phase.catch)
        first = phase.name, str(phase.steps)
        for change, tolerance in zip_longest(changes, caught, fillvalue=""):
            yield *first, change, tolerance
            first = "", ""


def _range(part: slice) -> str:
    first, last = part.start, part.stop - 1
    return str(first) if first == last else f"{first}-{last}"


def _vector(values: Sequence[float]) -> str:
    return f"({', '.join(f'{_whole(value):.6g}' for value in values)})"


def _whole(value: float) -> float:
    """A coordinate of a pose or a velocity without what rounding leaves of a zero."""
    return round(value, 15) + 0.0


def _limit(limit: float) -> str:
    return "unlimited" if math.isinf(limit) else f"{limit:g}"


def _entries(names: Sequence[str], units: Sequence[str]) -> list[dict[str, str]]:
    return [{"name": name, "unit": unit} for name, unit in zip(names, units, strict=True)]


def _print(
    console: Console,
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    right: Sequence[int] = (),
) -> None:
    table = TextTable(title, tuple(headings), tuple(map(tuple, rows)), right)
    console.print(table.for_terminal())
