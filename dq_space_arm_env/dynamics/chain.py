"""The constants of a robot: what the equations of motion need of a scene, as plain numbers.

A `Chain` is a base, revolute links in a row, perhaps a massless wrist, and a tip frame. Link frames are the
joint frames of the
paper: frame i is fixed in the distal body i+1, its z axis lies along the joint axis. A payload is merged into
the body that holds it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dq_space_arm_env.scene import Payload, Pose, Scene

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True)
class RigidBody:
    """Mass properties of a body.

    Attributes:
        mass: Mass, kg.
        center_of_mass: Center of mass in the body's frame, m.
        inertia: Inertia about the center of mass, body axes, 3x3, kg m^2.
    """

    mass: float
    center_of_mass: Vector
    inertia: Matrix


@dataclass(frozen=True)
class Placement:
    """A constant pose of one frame in another.

    Attributes:
        position: Origin in the outer frame, m.
        rotation: Rotation matrix from inner to outer axes; entries that are 0 or +-1 are exactly so.
        dual_quaternion: The same as a unit dual quaternion, q_{inner/outer}, 8 numbers.
    """

    position: Vector
    rotation: Matrix
    dual_quaternion: tuple[float, ...]


@dataclass(frozen=True)
class RevoluteLink:
    """A link and the revolute joint that carries it.

    Attributes:
        body: Mass properties in the joint frame.
        joint: Joint frame at zero angle in the parent's frame (base center of mass, or previous joint frame).
        stiffness: Torsional spring, N m/rad.
        rest_angle: Angle at which the spring is relaxed, rad.
        damping: Viscous friction, N m s/rad.
    """

    body: RigidBody
    joint: Placement
    stiffness: float
    rest_angle: float
    damping: float


@dataclass(frozen=True)
class Chain:
    """A free base with a chain of revolute links.

    Attributes:
        base: The base; its frame sits at its center of mass.
        links: Links from base to tip.
        wrist: Wrist frame at zero angles in the last link's frame, None without a wrist.
        tip: Tip frame G in the wrist frame, or in the last link's frame without one.
        tip_wrench: Force [N] and torque [N m] acting at G, in G axes (16); None where nothing acts.
        planar: Whether the base moves in its x-y plane only.
    """

    base: RigidBody
    links: tuple[RevoluteLink, ...]
    wrist: Placement | None
    tip: Placement
    tip_wrench: tuple[float, ...] | None
    planar: bool

    @classmethod
    def from_scene(cls, scene: Scene) -> Chain:
        """Collect a scene's constants.

        Args:
            scene: A validated scene.

        Returns:
            The chain.
        """
        bodies = [RigidBody(link.mass, link.center_of_mass, link.inertia) for link in scene.links]
        base = RigidBody(scene.base.mass, (0.0, 0.0, 0.0), scene.base.inertia)
        if scene.payload is not None:
            if bodies:
                bodies[-1] = _merged(bodies[-1], scene.payload, scene.tip)
            else:
                raise ValueError("payload: a scene without links cannot hold one; add its mass to the base")
        wrench = scene.tip_wrench
        return cls(
            base=base,
            links=tuple(
                RevoluteLink(body, _placement(link.joint), link.stiffness, link.rest_angle, link.damping)
                for body, link in zip(bodies, scene.links, strict=True)
            ),
            wrist=None if scene.wrist is None else _placement(scene.wrist.frame),
            tip=_placement(scene.tip),
            tip_wrench=None if wrench is None else (*wrench.force, *wrench.torque),
            planar=scene.base.motion == "planar",
        )


def _placement(pose: Pose) -> Placement:
    return Placement(pose.position, pose.rotation_matrix, pose.dual_quaternion)


def _merged(body: RigidBody, payload: Payload, tip: Pose) -> RigidBody:
    """Mass properties of a body and the payload it holds, by the parallel axis theorem."""
    rotation = np.array(tip.rotation_matrix)
    masses = np.array([body.mass, payload.mass])
    centers = np.array([body.center_of_mass, np.array(tip.position) + rotation @ payload.center_of_mass])
    inertias = [np.array(body.inertia), rotation @ np.array(payload.inertia) @ rotation.T]
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, position, own in zip(masses, centers, inertias, strict=True):
        arm = position - center
        inertia += own + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    inertia = 0.5 * (inertia + inertia.T)
    rows = tuple(tuple(float(entry) for entry in row) for row in inertia)
    return RigidBody(float(masses.sum()), tuple(float(c) for c in center), rows)  # type: ignore[arg-type]
