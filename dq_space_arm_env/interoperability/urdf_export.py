"""A scene's robot as URDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.interoperability.exporting import (
    free_name,
    joint_limits,
    refuse,
    tip_on_its_body,
    words,
)
from dq_space_arm_env.interoperability.urdf_elements import UNLIMITED
from dq_space_arm_env.scene import Base, Link, Payload, Scene, Shape, load_scene
from dq_space_arm_env.scene.shapes import COLORS, color_of
from dq_space_arm_env.validation.fields import Three


def scene_to_urdf(scene: Scene | str | Path, *, wrist: Literal["refuse", "fixed"] = "refuse") -> str:
    """Write a scene's robot as URDF.

    The root link `base` has the frame e0, at the center of mass; tell the simulator that it floats
    (Pinocchio: `JointModelFreeFlyer`). Each further link has the frame of its joint and carries the scene's
    name; its joint turns about z, or slides along it, and is called by the link's name and " joint". A link
    `tip` without mass, or with that of the payload, has the frame G; so have other tips, by their names.
    Torque limits become efforts, 0 for a joint without motor, viscous damping and Coulomb friction its
    `dynamics`, which has no smoothing speed. The scene's joint limits, without their margins, make a joint
    revolute, others are continuous; 1e4 rad (m), rad/s (m/s) and N m (N) stand for none where URDF asks for a
    number. It has no thrusters, wheels, start, task or other constraints. Shapes become visuals.

    Features that URDF lacks and that change the motion are refused: joint springs, rotors, screw and
    spherical joints, a wrench at the tip, a planar base, reaction wheels, a tank, phases that change the
    robot. The massless wrist as three joints would have infinite accelerations; fixed at its initial angles
    it changes no acceleration, but the tip cannot turn.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        wrist: "refuse" makes a wrist an error, "fixed" writes it at its initial angles.

    Returns:
        The URDF text, all numbers with 17 digits; `scene_from_urdf` reads it.

    Raises:
        SceneError: If URDF lacks a feature of the scene, or its constraints leave a joint no range.
    """
    scene = load_scene(scene)
    refuse(scene, "URDF", wrist, springs=True, planar=True, rotors=True, spherical=True)
    root = Element("robot", name=scene.name)
    names = [link.name for link in scene.links]
    others = [tip.name for tip in scene.other_tips]
    bodies = ["base", *names]
    _add_link(root, bodies[0], scene.base, (0.0, 0.0, 0.0))
    limits = joint_limits(scene)
    for link, parent, effort, bounds in zip(
        scene.links, scene.parent_bodies, _efforts(scene), limits, strict=True
    ):
        _add_link(root, link.name, link, link.center_of_mass)
        _add_joint(root, link, bodies[parent], effort, bounds)
    tip = free_name("tip", [*names, *others])
    _add_tip(root, tip, bodies[scene.tip_body], tip_on_its_body(scene), scene.payload)
    for other in scene.other_tips:
        body = bodies[scene.body_named(other.link)]
        _add_tip(root, other.name, body, other.frame.dual_quaternion, other.payload)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_tip(root: Element, name: str, body: str, pose: Sequence[float], payload: Payload | None) -> None:
    _add_link(root, name, payload, (0.0, 0.0, 0.0) if payload is None else payload.center_of_mass)
    joint = SubElement(root, "joint", name=f"{name} joint", type="fixed")
    _connect(joint, body, name, pose)


def _efforts(scene: Scene) -> list[float]:
    """Largest motor torques of the joints; 0 for those without motor, inf for unlimited ones."""
    motors = scene.actuators.joint_torque
    return [
        0.0
        if motors is None or not link.actuated
        else (motors.limit if link.torque_limit is None else link.torque_limit)
        for link in scene.links
    ]


def _add_link(
    root: Element, name: str, body: Base | Link | Payload | None, center_of_mass: Sequence[float]
) -> None:
    link = SubElement(root, "link", name=name)
    if body is None:
        return
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=words(center_of_mass), rpy="0 0 0")
    SubElement(inertial, "mass", value=words([body.mass]))
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": words([body.inertia[i][j]]) for i in range(3) for j in range(i, 3)}
    SubElement(inertial, "inertia", entries)
    color = COLORS["foil" if isinstance(body, Base) else "white" if isinstance(body, Link) else "teal"]
    for index, shape in enumerate(body.geometry):
        _add_visual(link, shape, color, f"{name} {index}")


def _add_visual(link: Element, shape: Shape, default: Three, material: str) -> None:
    visual = SubElement(link, "visual")
    _add_origin(visual, shape.pose.dual_quaternion)
    geometry = SubElement(visual, "geometry")
    if shape.cylinder is None:
        SubElement(geometry, "box", size=words(shape.edges))
    else:
        radius, length = words([shape.cylinder.radius]), words([shape.cylinder.length])
        SubElement(geometry, "cylinder", radius=radius, length=length)
    color = words([*color_of(shape, default), 1.0])
    SubElement(SubElement(visual, "material", name=material), "color", rgba=color)


def _add_joint(
    root: Element, link: Link, parent: str, effort: float, limits: tuple[float, float, float]
) -> None:
    if link.is_fixed:
        fixed = SubElement(root, "joint", name=f"{link.name} joint", type="fixed")
        _connect(fixed, parent, link.name, link.joint.dual_quaternion)
        return
    lower, upper, rate = limits
    has_range = math.isfinite(lower) or math.isfinite(upper)
    kind = ("revolute" if has_range else "continuous") if link.turns else "prismatic"
    joint = SubElement(root, "joint", name=f"{link.name} joint", type=kind)
    _connect(joint, parent, link.name, link.joint.dual_quaternion)
    SubElement(joint, "axis", xyz="0 0 1")
    has_range = has_range or kind == "prismatic"  # URDF wants one
    if has_range or math.isfinite(effort) or math.isfinite(rate):
        # URDF wants effort and velocity in every <limit>.
        numbers = {"effort": effort, "velocity": rate}
        if has_range:
            numbers |= {"lower": lower, "upper": upper}
        SubElement(joint, "limit", {key: words([_finite(value)]) for key, value in numbers.items()})
    rubbing = {"damping": link.damping, "friction": link.motor.friction if link.motor else 0.0}
    if any(rubbing.values()):
        SubElement(joint, "dynamics", {key: words([value]) for key, value in rubbing.items() if value})


def _finite(limit: float) -> float:
    return limit if math.isfinite(limit) else math.copysign(UNLIMITED, limit)


def _connect(joint: Element, parent: str, child: str, pose: Sequence[float]) -> None:
    _add_origin(joint, pose)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)


def _add_origin(element: Element, pose: Sequence[float]) -> None:
    yaw, pitch, roll, position = poses.to_euler_321(dual_quaternion.normalize(tuple(pose)))
    SubElement(element, "origin", xyz=words(position), rpy=words([roll, pitch, yaw]))
