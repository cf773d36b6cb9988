"""A scene's robot as MJCF, MuJoCo's format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.interoperability import mjcf_looks as looks
from dq_space_arm_env.interoperability.exporting import (
    depth_first,
    free_name,
    joint_limits,
    refuse,
    tip_on_its_body,
    words,
)
from dq_space_arm_env.interoperability.mjcf_looks import placed
from dq_space_arm_env.scene import Base, Link, Payload, Scene, StateLayout, load_scene
from dq_space_arm_env.scene.bodies import freedoms

_FORCE_GEARS = ("1 0 0 0 0 0", "0 1 0 0 0 0", "0 0 1 0 0 0")
_TORQUE_GEARS = ("0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1")


def scene_to_mjcf(scene: Scene | str | Path, *, wrist: Literal["refuse", "fixed"] = "refuse") -> str:
    """Write a scene's robot as MJCF.

    There is no gravity, and nothing collides. Geoms are there to be seen, and weigh nothing: the scene's
    shapes, or boxes and rods in the proportions of the project's pictures. Camera `overview` has start and
    target in view, light `sun` shines from over its shoulder. Body `target`, a mocap body, stands where the
    target's does at the start, with its shapes and site `target`, where the tip should be.
    Body `base` has the frame e0 and a free joint, called `base joint`; in a planar scene it slides along x
    and y and turns about z. Each link is a body with the frame of its joint, a hinge about z or a slide along
    it or a ball, called by the link's name and " joint", with the scene's damping, spring and limits of the
    joint; fixed links have none. A link called `world`, as MuJoCo's own body is, becomes `world_`.
    Where arms branch, MuJoCo's coordinates follow one arm after the other.
    A rotor is an armature, Coulomb friction a friction loss, which MuJoCo has without the smoothing speed.
    MuJoCo pushes joints back from their limits, the scene's kernels do not, and it has no limits of rates.
    Site `tip` has the frame G, body `payload` is held at the tip; other tips have sites by their names.

    Actuators are motors with the names, limits and order of the scene's inputs, without the wrist's rates;
    forces and torques act in base axes at e0. MuJoCo clips controls at the limits, the scene's kernels do
    not. What else the environment clips is left out: what exceeds a `slew_limit` or a motor's torque at its
    speed, pulses of thrusters that are too short. Key frame `start` holds the nominal start. The time step is
    the scene's; the integrator is MuJoCo's RK4, which on rotations is not the scene's to the last digit.

    State: with (w, v) the base twist in base axes, R from base to inertial axes, MuJoCo's free joint has
    qpos = (position, quaternion scalar first) and qvel = (R v, w), and qacc = (R (dv + w x v), dw).

    The massless wrist as three joints would have infinite accelerations; fixed at its initial angles it
    changes no acceleration, but the tip cannot turn.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        wrist: "refuse" makes a wrist an error, "fixed" writes it at its initial angles.

    Returns:
        The MJCF text, all numbers with 17 digits, in m, kg, s, rad.

    Raises:
        SceneError: If the scene has a wrist that is not to be fixed, a constant wrench at the tip, a screw
            joint, reaction wheels, a tank, an elastic gear, a rotor that turns with the body before its
            joint, an actuator that lags or delays, a joint that constraints leave no range, or phases that
            change the robot.
    """
    scene = load_scene(scene)
    refuse(scene, "MJCF", wrist, at_once=True)
    root = Element("mujoco", model=scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    SubElement(root, "option", gravity="0 0 0", timestep=words([scene.simulation.dt]), integrator="RK4")
    names = [link.name for link in scene.links]
    world = Element("worldbody")
    looks.add_surroundings(root, world, scene)
    root.append(world)
    base = SubElement(world, "body", name="base")
    _add_base_joint(base, scene)
    _add_inertial(base, scene.base, (0.0, 0.0, 0.0))
    looks.add_base(base, scene.base)
    SubElement(base, "site", name="e0")
    bodies = [base]
    limits = joint_limits(scene)
    for link, parent, (lower, upper, _) in zip(scene.links, scene.parent_bodies, limits, strict=True):
        name = free_name("world", ["world", *names]) if link.name == "world" else link.name
        body = _add_body(bodies[parent], name, link.joint.dual_quaternion)
        bodies.append(body)
        if not link.is_fixed:
            _add_joint(body, link, lower, upper)
        _add_inertial(body, link, link.center_of_mass)
    looks.add_arm(bodies, scene)
    target = free_name("target", names)
    sites = ["e0", "tip", target]
    names += [free_name("payload", names)]
    _add_tip(bodies[scene.tip_body], scene, "tip", tip_on_its_body(scene), (names[-1], scene.payload))
    for other in scene.other_tips:
        names += [free_name(f"{other.name} payload", names)]
        body, frame = bodies[scene.body_named(other.link)], other.frame.dual_quaternion
        sites += [free_name(other.name, sites)]
        _add_tip(body, scene, sites[-1], frame, (names[-1], other.payload))
    looks.add_target(world, scene, target)
    _add_actuators(root, scene)
    _add_start(root, scene)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_base_joint(base: Element, scene: Scene) -> None:
    if scene.base.motion == "spatial":
        links = [f"{link.name} joint" for link in scene.links]
        SubElement(base, "freejoint", name=free_name("base joint", links))
        return
    for name, kind, axis in (("x", "slide", "1 0 0"), ("y", "slide", "0 1 0"), ("z", "hinge", "0 0 1")):
        SubElement(base, "joint", name=f"base {kind} {name}", type=kind, axis=axis)


def _add_tip(
    body: Element, scene: Scene, name: str, pose: Sequence[float], held: tuple[str, Payload | None]
) -> None:
    """Mark a tip, and add what it holds."""
    looks.add_mark(body, scene, name, pose)
    name, payload = held
    if payload is not None:
        holding = _add_body(body, name, pose)
        _add_inertial(holding, payload, payload.center_of_mass)
        looks.add_payload(holding, payload)


def _add_body(parent: Element, name: str, pose: Sequence[float]) -> Element:
    return SubElement(parent, "body", {"name": name, **placed(pose)})


def _add_inertial(parent: Element, body: Base | Link | Payload, center_of_mass: Sequence[float]) -> None:
    """Add mass properties about principal axes; MuJoCo's own search for them stops at 1e-12 kg m^2."""
    inertia = np.array(body.inertia)
    moments, axes = np.diag(inertia), np.eye(3)
    if np.any(inertia != np.diag(moments)):
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
    # Rounding may leave the largest moment of a flat body above the sum of the others; MuJoCo refuses that.
    largest = int(np.argmax(moments))
    moments = np.where(
        np.arange(3) == largest, min(moments[largest], np.delete(moments, largest).sum()), moments
    )
    quaternion = rotations.from_matrix(axes.tolist())
    SubElement(
        parent,
        "inertial",
        pos=words(center_of_mass),
        quat=words(quaternion),
        mass=words([body.mass]),
        diaginertia=words(moments),
    )


def _add_joint(body: Element, link: Link, lower: float, upper: float) -> None:
    kind = "hinge" if link.turns else "slide"
    joint = SubElement(body, "joint", name=f"{link.name} joint", type="ball" if link.is_spherical else kind)
    if not link.is_spherical:
        joint.set("axis", "0 0 1")
    if math.isfinite(lower) or math.isfinite(upper):
        joint.set("range", words([lower, upper]))
    if link.damping:
        joint.set("damping", words([link.damping]))
    if link.stiffness:
        joint.set("stiffness", words([link.stiffness]))
        if not link.is_spherical:
            joint.set("springref", words([link.rest_angle]))
    if link.motor is not None and link.motor.inertia:
        joint.set("armature", words([link.motor.reflected_inertia]))
    if link.motor is not None and link.motor.friction:
        joint.set("frictionloss", words([link.motor.friction]))


def _add_actuators(root: Element, scene: Scene) -> None:
    layout = StateLayout.of(scene)
    control = layout.control
    planar = layout.planar
    at: dict[int, dict[str, str]] = {}
    for part, gears in (
        (control.base_force, _FORCE_GEARS[:2] if planar else _FORCE_GEARS),
        (control.base_torque, _TORQUE_GEARS[2:] if planar else _TORQUE_GEARS),
    ):
        for index, gear in zip(range(part.start, part.stop), gears, strict=False):
            at[index] = {"site": "e0", "gear": gear}
    for index, each in enumerate(scene.actuators.thrusters or (), control.thruster_force.start):
        at[index] = {"site": "e0", "gear": words([*each.unit_direction, *each.moment])}
    torques = range(control.joint_torque.start, control.joint_torque.stop)
    about = {" x": "1 0 0", " y": "0 1 0", " z": "0 0 1"}
    moving = freedoms(scene.links)
    for index, joint in zip(torques, layout.actuated_joints, strict=True):
        link, axis = moving[joint]
        at[index] = {"joint": f"{scene.links[link].name} joint"} | ({"gear": about[axis]} if axis else {})
    actuators = SubElement(root, "actuator")
    for index, transmission in sorted(at.items()):
        motor = SubElement(actuators, "motor", {"name": control.names[index], **transmission})
        limits = layout.lower_limits(layout.control_limit)[index], layout.control_limit[index]
        if any(map(math.isfinite, limits)):
            motor.set("ctrlrange", words(limits))


def _add_start(root: Element, scene: Scene) -> None:
    start, layout = scene.initial_state, StateLayout.of(scene)
    parts = (layout.state.joint_angles, layout.state.joint_rates)
    angles, rates = (iter(layout.initial_state[part].tolist()) for part in parts)
    joints = [
        ([*islice(angles, link.freedoms + link.is_spherical)], [*islice(rates, link.freedoms)])
        for link in scene.links
    ]
    order = [joints[link] for link in depth_first(scene)]
    rotation, position = poses.to_rotation_and_position(start.base_pose.dual_quaternion)
    angular, linear = start.base_velocity[:3], rotations.rotate(rotation, start.base_velocity[3:])
    if scene.base.motion == "planar":
        yaw, _, _ = rotations.to_euler_321(rotation)
        base, velocity = [*position[:2], yaw], [*linear[:2], angular[2]]
    else:
        base, velocity = [*position, *rotation], [*linear, *angular]
    SubElement(
        SubElement(root, "keyframe"),
        "key",
        name="start",
        qpos=words([*base, *(angle for joint, _ in order for angle in joint)]),
        qvel=words([*velocity, *(rate for _, joint in order for rate in joint)]),
    )
