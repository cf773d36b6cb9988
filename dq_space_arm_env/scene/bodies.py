"""Bodies of a scene: base, links, wrist and payload, and the physics that constrains their numbers."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from dq_space_arm_env.scene.drives import Motor
from dq_space_arm_env.scene.pose import Matrix3, Pose
from dq_space_arm_env.scene.shapes import Shape, geometry_field
from dq_space_arm_env.validation.fields import (
    INERTIAS,
    Angle,
    ControlWeight,
    Finite,
    Flag,
    Limit,
    Mass,
    Name,
    NonNegative,
    Position,
    Range,
    Three,
    read_numbers,
)
from dq_space_arm_env.validation.problems import Model, Problem, problem

_TOLERANCE = 1e-9  # fractions of the largest moment
_SINGULAR = 1e-12
_ENTRIES = Range(0.0, INERTIAS.most)  # before anything is computed with them
_FORMS = "3 numbers (diagonal) or 3x3"
BASE = "base"  # its name among those of the bodies


def _read_inertia(value: Any) -> Matrix3:
    """Read 3 numbers (the diagonal) or a 3x3 matrix, and check that a rigid body can have it."""
    matrix = _read_matrix(value)
    if np.abs(matrix - matrix.T).max() > _TOLERANCE * np.abs(matrix).max():
        raise problem("must be symmetric")
    matrix = 0.5 * (matrix + matrix.T)
    if flaw := flaw_of(matrix):
        raise problem(f"no rigid body has it: {flaw}")
    INERTIAS.check(*np.linalg.eigvalsh(matrix).tolist())
    first, second, third = (_three(row) for row in matrix)
    return (first, second, third)


def flaw_of(inertia: np.ndarray[Any, np.dtype[np.float64]], *, rods: bool = False) -> str:
    """Say why no rigid body has an inertia, or nothing; `rods` allows a moment of 0, as of a thin rod."""
    least, middle, largest = np.linalg.eigvalsh(inertia)
    size = float(np.abs(inertia).max())
    moments = f"principal moments {least:.6g}, {middle:.6g}, {largest:.6g} kg m^2"
    if least < -_TOLERANCE * size or (not rods and least <= _SINGULAR * size):
        return f"{moments}, all must be {'0 or greater' if rods else 'greater than 0'}"
    if least + middle < largest * (1 - _TOLERANCE):
        return f"{moments}, of which the two smaller must add up to at least the largest"
    return ""


def _read_matrix(value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise problem(f"must be {_FORMS}")
    if any(isinstance(row, list | tuple | np.ndarray) for row in value):
        return np.array([read_numbers(row, 3, _ENTRIES) for row in value])
    return np.diag(read_numbers(value, 3, _ENTRIES))


def _three(row: Any) -> Three:
    x, y, z = (float(number) + 0.0 for number in row)
    return (x, y, z)


Inertia = Annotated[Matrix3, BeforeValidator(_read_inertia)]


class Base(Model):
    """The spacecraft: a free rigid body whose frame e0 sits at its center of mass."""

    mass: Mass = Field(description="mass of the base, kg")
    inertia: Inertia = Field(
        description=f"inertia of the base about its center of mass, base axes, kg m^2: {_FORMS}"
    )
    motion: Literal["spatial", "planar"] = Field(
        default="spatial",
        description="'spatial': six degrees of freedom; 'planar': motion in the x-y plane, rotation about z",
    )
    geometry: tuple[Shape, ...] = geometry_field("the box of its inertia, with wings")


JointType = Literal["revolute", "prismatic", "screw", "spherical", "fixed"]


class Link(Model):
    """A link and the joint that carries it; the joint moves about and along the z axis of its own frame.

    Its coordinate is an angle, rad, and its effort a torque, N m; those of a prismatic joint are a distance,
    m, and a force, N. A spherical joint turns about all axes of its frame: its coordinates are a quaternion,
    its rates and torques have three components in the link's axes, and its spring pulls along the rotation
    vector. A fixed one makes link and parent one body.
    """

    _elsewhere: ClassVar[Mapping[str, str]] = {
        "axis": "a joint turns about the z axis of its frame: turn that with joint.rotation, a quaternion or "
        "{axis: [x, y, z], angle: degrees}"
    }

    name: Name = Field(description="name of the link, unique in the scene")
    parent: Name | None = Field(
        default=None,
        exclude_if=lambda parent: parent is None,
        description="link before this one that carries it, or base; absent: the link right before (of the "
        "first link: the base)",
    )
    mass: Mass = Field(description="mass of the link, kg")
    inertia: Inertia = Field(
        description=f"inertia of the link about its center of mass, joint-frame axes, kg m^2: {_FORMS}"
    )
    center_of_mass: Position = Field(description="center of mass of the link in its joint frame, m")
    joint: Pose = Field(
        description="pose of the joint frame at zero (angle or distance) in the parent's frame, m (base: "
        "frame e0 at the center of mass; link: its joint frame)"
    )
    joint_type: JointType = Field(
        default="revolute",
        exclude_if=lambda joint_type: joint_type == "revolute",
        description="'revolute': the joint turns about z; 'prismatic': it slides along z; 'screw': both, by "
        "its pitch; 'spherical': it turns about any axis; 'fixed': it holds the link",
    )
    pitch: Finite = Field(
        default=0.0,
        exclude_if=lambda pitch: pitch == 0.0,
        description="slide of a screw joint along z per angle about z, m/rad",
    )
    actuated: Flag = Field(
        default=True, description="whether a motor drives the joint; false: the joint is passive"
    )
    torque_limit: Limit | None = Field(
        default=None,
        description="largest motor torque of this joint, N m (prismatic: force, N); absent: the limit of "
        "actuators.joint_torque",
    )
    torque_weight: ControlWeight | None = Field(
        default=None,
        exclude_if=lambda weight: weight is None,
        description="weight on the motor torque of this joint, 1/(N m)^2 (prismatic: force, 1/N^2); absent: "
        "cost.joint_torque",
    )
    stiffness: NonNegative = Field(default=0.0, description="stiffness of the joint spring, N m/rad (N/m)")
    rest_angle: Angle = Field(default=0.0, description="joint angle at which the spring is at rest, rad (m)")
    damping: NonNegative = Field(default=0.0, description="viscous damping of the joint, N m s/rad (N s/m)")
    motor: Motor | None = Field(
        default=None,
        exclude_if=lambda motor: motor is None,
        description="rotor, gear and friction of the joint's motor; absent: an ideal torque",
    )
    geometry: tuple[Shape, ...] = geometry_field("a joint, and a rod to the next one")

    @property
    def turns(self) -> bool:
        """Whether the joint's coordinate is an angle."""
        return self.joint_type != "prismatic"

    @property
    def is_fixed(self) -> bool:
        """Whether the link is one body with what carries it."""
        return self.joint_type == "fixed"

    @property
    def is_spherical(self) -> bool:
        """Whether the joint turns about all axes."""
        return self.joint_type == "spherical"

    @property
    def freedoms(self) -> int:
        """Degrees of freedom of the joint."""
        return {"spherical": 3, "fixed": 0}.get(self.joint_type, 1)

    @property
    def is_elastic(self) -> bool:
        """Whether the gear of the joint's motor is a spring."""
        return self.motor is not None and self.motor.is_elastic

    @property
    def coordinates(self) -> list[tuple[str, str]]:
        """Names and units of the joint's coordinates."""
        if self.is_spherical:
            return [(f"q_{index}", "1") for index in range(4)]
        return [("angle" if self.turns else "displacement", self.unit)] * self.freedoms

    @property
    def unit(self) -> str:
        """Unit of the joint's coordinate."""
        return "rad" if self.turns else "m"

    @property
    def effort_unit(self) -> str:
        """Unit of the joint's effort."""
        return "N m" if self.turns else "N"

    def _problems(self) -> Iterator[Problem]:
        if self.joint_type == "screw" and self.pitch == 0.0:
            yield Problem(("pitch",), 0.0, "a screw joint needs one; without it the joint is revolute")
        if self.joint_type != "screw" and self.pitch != 0.0:
            yield Problem(("pitch",), self.pitch, f"a {self.joint_type} joint has none; a screw has one")
        without: tuple[str, ...] = ()
        if self.is_spherical:
            without = ("rest_angle", "motor")
        elif self.is_fixed:
            without = ("torque_limit", "torque_weight", "stiffness", "rest_angle", "damping", "motor")
        for name in without:
            if getattr(self, name):
                yield Problem((name,), getattr(self, name), f"a {self.joint_type} joint has none: remove it")


def freedoms(links: Sequence[Link]) -> list[tuple[int, str]]:
    """List the degrees of freedom of links, base to tip.

    Args:
        links: The links of a scene.

    Returns:
        Index of its link, and " x", " y" or " z" where it is one of a spherical joint's three.
    """
    axes = {0: (), 1: ("",), 3: (" x", " y", " z")}
    return [(index, axis) for index, link in enumerate(links) for axis in axes[link.freedoms]]


def parent_bodies(links: Sequence[Link]) -> list[int | None]:
    """Find what carries each link.

    Args:
        links: The links of a scene.

    Returns:
        One number per link: 0 for the base, i + 1 for link i; None where no link before it has the name.
    """
    found: list[int | None] = []
    bodies = {BASE: 0}
    for index, link in enumerate(links):
        found.append(index if link.parent is None else bodies.get(link.parent))
        bodies[link.name] = index + 1
    return found


class Wrist(Model):
    """A massless spherical joint, commanded by its 3-2-1 Euler rates psi, theta, phi."""

    frame: Pose = Field(
        default_factory=Pose,
        description="pose of the wrist frame at zero angles in the last link's (or the base's) frame, m",
    )


class Payload(Model):
    """A body held rigidly at the tip."""

    mass: Mass = Field(description="mass of the payload, kg")
    inertia: Inertia = Field(
        description=f"inertia of the payload about its center of mass, tip axes, kg m^2: {_FORMS}"
    )
    center_of_mass: Position = Field(
        default=(0.0, 0.0, 0.0), description="center of mass of the payload in the tip frame, m"
    )
    geometry: tuple[Shape, ...] = geometry_field("the box of its inertia")
