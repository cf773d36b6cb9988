"""Price of each actuator and mechanism: a robot with one of them more, in states and operations.

What a robot does not have is in neither its state nor its code; counts do not depend on the machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from dq_space_arm_env import Scene
from dq_space_arm_env.scene.layout import StateLayout
from scripts.benchmarks.harness import Row
from scripts.benchmarks.scene_cost.sizes import trace_program

_ROTOR = {"inertia": 2e-5, "gear": 100}  # kg m^2
_JETS = [
    {"position": [x, y, z], "direction": [-x, -y, z], "force": 5, "specific_impulse": 220}  # m, N, s
    for x in (0.35, -0.35)
    for y in (0.35, -0.35)
    for z in (0.45, -0.45)
]
_BRANCH = {  # an appendage on the base, on a spring
    "name": "branch",
    "parent": "base",
    "mass": 3.0,
    "inertia": [0.1, 0.4, 0.4],
    "center_of_mass": [0.5, 0.0, 0.0],
    "joint": {"position": [0.35, 0.0, 0.0]},
    "actuated": False,
    "stiffness": 10.0,
}


_PROGRAMS = {
    "dynamics": "forward_dynamics",
    "step": "step",
    "derivatives": "linearize",
    "environment": "environment_step",
}
_STEPS = ("step", "derivatives", "environment")


def mechanisms(scene: Scene) -> dict[str, Scene]:
    """A serial robot as it is, and with one mechanism more, by title."""

    def motors(**fields: Any) -> Mapping[str, Any]:
        return {f"links.{i}.motor": fields for i in range(len(scene.links))}

    def actuators(**fields: Any) -> Mapping[str, Any]:
        names = ("base_force", "base_torque", "joint_torque", "wrist_rate")
        given = [name for name in names if getattr(scene.actuators, name) is not None]
        return {f"actuators.{name}.{field}": value for name in given for field, value in fields.items()}

    last = scene.links[-1].name
    branch = {
        "links": [*scene.links, _BRANCH],
        "tip_link": last,
        "initial_state.joint_angles": [*scene.initial_state.joint_angles, 0.0],
        "initial_state.joint_rates": [*scene.initial_state.joint_rates, 0.0],
    }
    limits = {"kind": "joint_limits", "name": "limits", "lower": [-3.0], "upper": [3.0]}
    other = {"name": "elbow", "link": scene.links[-2].name, "goal": {}, "terminal_pose": 1.0}
    added: dict[str, Mapping[str, Any]] = {
        "four wheels": {"actuators.wheels": {"set": "pyramid", "inertia": 0.01, "torque": 0.5}},
        "eight thrusters": {"actuators.thrusters": _JETS},
        "eight thrusters and their tank": {
            "actuators.thrusters": _JETS,
            "actuators.tank": {"propellant": 5.0, "position": [0.1, 0.0, 0.2]},
        },
        "rotors as armature": motors(**_ROTOR, coupling="armature"),
        "rotors, coupled exactly": motors(**_ROTOR),
        "friction": motors(friction=0.1, friction_speed=0.05),
        "elastic gears": motors(**_ROTOR, coupling="armature", stiffness=1e4),
        "lag of every actuator": actuators(time_constant=0.05),
        "delay of every actuator by a step": actuators(delay=1),
        "slew limits of every actuator": actuators(slew_limit=10.0),
        "a passive branch on the base": branch,
        "another tip": {"other_tips": [other]},
        "joint limits as a constraint": {"constraints": [limits]},
    }
    variants = {title: scene.replace(changes) for title, changes in added.items()}
    return {f"{scene.name}, as it is": scene, **variants}


def mechanism_rows(scene: Scene) -> Iterator[Row]:
    """States, inputs and operations of each, with ratios to the scene as it is."""
    first: Row = {}
    for title, variant in mechanisms(scene).items():
        layout = StateLayout.of(variant)
        row: Row = {"table": "mechanisms", "title": title, "states": layout.n_x, "inputs": layout.n_u}
        for key, program in _PROGRAMS.items():
            row[key] = trace_program(variant, program, "rk4" if key in _STEPS else "").operation_count
        first = first or row
        row["step_ratio"] = row["step"] / first["step"]
        yield row
