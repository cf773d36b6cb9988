"""A scene beside the paper's section V: numbers that the paper prints, and choices that it leaves open."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.scene import Pose, StateLayout

Value = float | str | tuple[float, ...]

ABSENT = "absent"


class Comparison(NamedTuple):
    """A number of section V and the scene's; one number where all components are equal."""

    quantity: str
    unit: str
    paper: Value
    scene: Value

    @property
    def agrees(self) -> bool:
        """Whether the two are the same, up to rounding."""
        if isinstance(self.paper, str) or isinstance(self.scene, str):
            return self.paper == self.scene
        paper, scene = np.atleast_1d(self.paper), np.atleast_1d(self.scene)
        return paper.shape == scene.shape and bool(np.allclose(paper, scene, rtol=1e-9, atol=1e-9))


def compare_with_paper(scene: Scene) -> list[Comparison]:
    """Compare a scene with each number that section V prints."""
    simulation, cost, actuators = scene.simulation, scene.cost, scene.actuators
    target = scene.target.pose.dual_quaternion

    def weight(name: str) -> Value:
        return ABSENT if getattr(actuators, name) is None else _collapsed(np.ravel(getattr(cost, name)))

    return [
        Comparison("arm", "", "3 revolute joints, spherical wrist", _arm(scene)),
        Comparison("target q_D/I, real part", "1", (0.5, 0.5, -0.5, -0.5), target[:4]),
        Comparison("target q_D/I, dual part", "m", (0.25, 2.25, 0.25, 2.25), target[4:]),
        Comparison("desired base velocity", "rad/s, m/s", 0.0, _collapsed(scene.target.base_velocity)),
        Comparison("weight W_k,q, tip pose", "", 15.0, _collapsed(cost.pose)),
        Comparison("weight W_f,q, tip pose at T", "", 150.0, _collapsed(cost.terminal_pose)),
        Comparison("weight W_k,ω, base velocity", "", 1.0, _collapsed(cost.base_velocity)),
        Comparison("weight W_f,ω, base velocity at T", "", 1.0, _collapsed(cost.terminal_base_velocity)),
        Comparison("weight in R, base force", "1/N²", 10.0, weight("base_force")),
        Comparison("weight in R, base torque", "1/(N m)²", 1.0, weight("base_torque")),
        Comparison("weight in R, joint torques", "1/(N m)²", 0.01, weight("joint_torque")),
        Comparison("weight in R, Euler rates", "s²/rad²", 0.1, weight("wrist_rate")),
        Comparison("duration T", "s", 15.0, simulation.steps * simulation.dt),
        Comparison("time step Δt", "s", 0.015, simulation.dt),
        Comparison("number of steps N", "", 1000.0, float(simulation.steps)),
    ]


def own_choices(scene: Scene) -> dict[str, str]:
    """The scene's values, with units, of what the paper leaves open."""
    start = scene.initial_state
    bodies = ["base", *(link.name for link in scene.links)]
    inertias = [scene.base.inertia, *(link.inertia for link in scene.links)]
    masses = [scene.base.mass, *(link.mass for link in scene.links)]
    choices = {
        "masses": _listed(bodies, (f"{mass:g}" for mass in masses), "kg"),
        "inertias": _listed(bodies, (_inertia(inertia) for inertia in inertias), "kg m²"),
        "centers of mass": _listed(bodies[1:], (numbers(link.center_of_mass) for link in scene.links), "m"),
        "joint frames": _listed(bodies[1:], (_pose(link.joint) for link in scene.links), "m"),
    }
    if scene.wrist is not None:
        choices["wrist frame"] = f"{_pose(scene.wrist.frame)} m"
    choices["tip frame"] = f"{_pose(scene.tip)} m"
    if scene.payload is not None:
        payload = scene.payload
        choices["payload"] = (
            f"{payload.mass:g} kg, {_inertia(payload.inertia)} kg m² at {numbers(payload.center_of_mass)} m"
        )
    if scene.tip_wrench is not None:
        wrench = scene.tip_wrench
        choices["wrench at the tip"] = f"{numbers(wrench.force)} N, {numbers(wrench.torque)} N m"
    choices["base at the start"] = f"{_pose(start.base_pose)} m"
    choices["base velocity at the start"] = (
        f"{numbers(start.base_velocity[:3])} rad/s, {numbers(start.base_velocity[3:])} m/s"
    )
    if scene.links:
        choices["joints at the start"] = (
            f"{numbers(start.joint_angles)} rad, {numbers(start.joint_rates)} rad/s"
        )
    if scene.wrist is not None:
        choices["wrist at the start"] = f"{numbers(start.wrist_angles)} rad"
    choices["limits"] = _limits(scene)
    choices["integrator"] = scene.simulation.integrator
    return choices


def numbers(values: Iterable[float]) -> str:
    """A vector as text, such as "(0.3, -2.9, 4.4)"; "0" for zeros."""
    components = [f"{value:.6g}" for value in values]
    return "0" if set(components) <= {"0", "-0"} else f"({', '.join(components)})"


def _collapsed(values: Sequence[float] | Any) -> Value:
    """One number for a vector of equal components."""
    components = tuple(float(value) for value in values)
    return components[0] if len(set(components)) == 1 else components


def _arm(scene: Scene) -> str:
    count = len(scene.links)
    kinds = {link.joint_type for link in scene.links} or {"revolute"}
    joints = f"{count} {'/'.join(sorted(kinds))} joint{'' if count == 1 else 's'}"
    motion = ", base in the plane" if scene.base.motion == "planar" else ""
    return f"{joints}, {'spherical wrist' if scene.wrist else 'no wrist'}{motion}"


def _listed(names: Iterable[str], values: Iterable[str], unit: str) -> str:
    return "; ".join(f"{name} {value}" for name, value in zip(names, values, strict=True)) + f" {unit}"


def _inertia(matrix: Sequence[Sequence[float]]) -> str:
    array = np.array(matrix)
    if np.count_nonzero(array - np.diag(np.diag(array))) == 0:
        return f"diag{numbers(np.diag(array))}"
    return f"[{', '.join(numbers(row) for row in array)}]"


def _pose(pose: Pose) -> str:
    axis, angle = rotations.to_axis_angle(pose.rotation)
    turned = f" turned {math.degrees(angle):.4g}° about {numbers(axis)}" if angle else ""
    return f"{numbers(pose.position)}{turned}"


def _limits(scene: Scene) -> str:
    layout = StateLayout.of(scene)
    entries = {
        "base force": layout.control.base_force,
        "base torque": layout.control.base_torque,
        "joint torque": layout.control.joint_torque,
        "Euler rate": layout.control.wrist_rate,
        "wheel torque": layout.control.wheel_torque,
        "thruster force": layout.control.thruster_force,
    }
    texts = []
    for name, place in entries.items():
        limits = layout.control_limit[place]
        if len(limits):
            value = _collapsed(limits)
            text = f"{value:g}" if isinstance(value, float) else numbers(limits)
            texts.append(f"{name} {text} {layout.control.unit(place)}")
    return "; ".join(texts)
