"""Reader of URDF files: checked plain data of links with their masses and joints with their frames.

It uses Python's expat. The URDF parsers on PyPI either require a mesh library (yourdfpy, urchin) or are
unmaintained (urdf-parser-py), and all accept files that give a wrong robot. Namespaces are not resolved:
robots ship with undeclared prefixes such as `drake:acceleration`. Document type declarations are refused,
and with them the attacks that XML allows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.algebra.quaternion import normalize
from dq_space_arm_env.common.bounded_formats import parse_xml
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_bytes
from dq_space_arm_env.common.shown_text import printable, shortened
from dq_space_arm_env.interoperability.rigid_body import Array, Body
from dq_space_arm_env.scene import SceneError

MOVABLE = ("revolute", "continuous", "prismatic")
TYPES = (*MOVABLE, "fixed", "planar", "floating")  # the last two where they move no mass

_MOST = 10_000  # links or joints, a hundred times those of a humanoid
_LONGEST_NAME = 200  # characters
_LARGEST = 1e15  # number, whose square times another's has digits to spare
_UNIT_TOLERANCE = 1e-3  # of the norm of a quaternion, which files write with few digits

UNLIMITED = 1e4
"""Limit of an angle, a rate or an effort, rad, rad/s and N m, from which it limits nothing."""

Pose = tuple[float, ...]


@dataclass(frozen=True, eq=False)
class UrdfLink:
    """A link."""

    name: str
    body: Body | None  # in the link's frame; None for a link without mass
    stands: bool = False  # whether it has an inertia without a mass, many files' word for a fixed base


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint."""

    name: str
    type: str  # one of TYPES
    parent: str
    child: str
    origin: Pose  # pose of the joint frame, and of the child at zero angle, in the parent's, 8 numbers, m
    axis: Array  # unit vector in the joint frame, shape (3,)
    effort: float | None  # largest torque, N m; None for none, UNLIMITED, or 0: many files' word for unknown
    written_effort: float  # as in the file, N m; 0 for none
    limits: tuple[float, float] | None  # smallest and largest angle, rad; infinite or None for none
    rate: float  # largest rate, rad/s; infinite for none
    damping: float  # viscous, N m s/rad
    friction: float  # Coulomb, N m
    mimics: str | None  # the joint that it follows: its coordinate times `ratio`, and `offset`
    ratio: float
    offset: float  # rad (m)

    @property
    def slides(self) -> bool:
        """Whether it moves along its axis; its units are then m and N instead of rad and N m."""
        return self.type == "prismatic"

    @property
    def unit(self) -> str:
        """Unit of its coordinate."""
        return "m" if self.slides else "rad"

    @property
    def joint_type(self) -> str:
        """Its type in a scene."""
        return "prismatic" if self.slides else "revolute"


@dataclass(frozen=True)
class UrdfRobot:
    """A robot."""

    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    shapes: int = 0  # that links are drawn as, and which are left out


def read_robot(source: str | Path) -> UrdfRobot:
    """Read a URDF file, given by its path or its text; shapes, transmissions and settings are left out."""
    root = _parse(_content(source))
    if root.tag != "robot":
        raise SceneError(
            f"URDF: the outermost element is <{shorten(printable(root.tag), 40)}>, it must be <robot>"
        )
    links = [_read_link(element) for element in root.iterfind("link")]
    joints = [_read_joint(element) for element in root.iterfind("joint")]
    if not links:
        raise SceneError("URDF: there is no <link> in <robot>; a robot needs at least two, and a joint")
    for kind, names in (("link", [link.name for link in links]), ("joint", [joint.name for joint in joints])):
        if len(names) > _MOST:
            raise SceneError(f"URDF: there are {len(names)} {kind}s, a robot should have at most {_MOST}")
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            raise SceneError(f"URDF: two {kind}s are named {name!r}: each needs its own name")
    return UrdfRobot(
        name=root.get("name", "").strip() or "robot",
        links={link.name: link for link in links},
        joints={joint.name: joint for joint in joints},
        shapes=len(root.findall("link/visual")),
    )


def without_effort(robot: UrdfRobot) -> list[str]:
    """Links on joints of which the file does not say how strong they are."""
    return [joint.child for joint in robot.joints.values() if joint.effort is None]


def _content(source: str | Path) -> str | bytes:
    """The text, or the bytes of the file, whose encoding the XML parser detects."""
    if not isinstance(source, str | Path):
        raise SceneError(f"URDF: {shortened(source, 40)} is neither the path nor the text of a URDF file")
    if isinstance(source, str):
        text = source.removeprefix("\ufeff").lstrip()
        if text.startswith("<"):
            return text
        if not text or "\n" in text:
            raise SceneError(
                f"URDF: the text {shorten(text, 40)!r} must begin with '<', or be the path of a file"
            )
    try:
        content = read_bytes(source)
    except UnreadableError as error:
        raise SceneError(f"URDF: {shorten(str(error), 300)}") from error
    if not content.strip():
        raise SceneError(f"URDF: {source} is empty")
    if b"<" not in content:
        raise SceneError(f"URDF: {source} is not XML: it must be a text file that begins with '<'")
    return content


def shorten(text: str, width: int) -> str:
    """Cut a text to a width, with "..."."""
    return text if len(text) <= width else f"{text[:width]}..."


def _parse(content: str | bytes) -> Element:
    try:
        return parse_xml(content, "URDF", _refuse_xacro)
    except UnreadableError as error:
        raise SceneError(str(error)) from error


def _refuse_xacro(tag: str, attributes: Mapping[str, str]) -> None:
    if tag.startswith("xacro:") or any("${" in value or "$(" in value for value in attributes.values()):
        raise SceneError(
            f"URDF: <{tag}> belongs to xacro, a macro language; expand the file first, with ROS: "
            "xacro robot.urdf.xacro > robot.urdf"
        )


def _read_link(element: Element) -> UrdfLink:
    name = _name(element)
    inertial = _only(element, "inertial", f"link {name!r}")
    if inertial is None:
        return UrdfLink(name, None)
    where = f"link {name!r}, <inertial>"
    mass = _number(_child(inertial, "mass", where), "value", f"{where}, <mass>")
    tensor = _child(inertial, "inertia", where)
    xx, xy, xz, yy, yz, zz = (
        _number(tensor, key, f"{where}, <inertia>") for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass < 0:
        raise SceneError(f"URDF: {where}: mass = {mass:g} kg, it must be 0 or greater")
    if mass == 0:
        return UrdfLink(name, None, stands=bool(inertia.any()))
    return UrdfLink(name, Body(mass, np.zeros(3), inertia).seen_from(_origin(inertial, where)))


def _read_joint(element: Element) -> UrdfJoint:
    name = _name(element)
    where = f"joint {name!r}"
    kind = element.get("type", "")
    if kind not in TYPES:
        known = f"{', '.join(TYPES[:-2])}, or where it moves no mass {' or '.join(TYPES[-2:])}"
        raise SceneError(f"URDF: {where}: type = {shortened(kind)}, it must be one of {known}")
    unit = "m" if kind == "prismatic" else "rad"
    limit, dynamics, mimic = (_only(element, tag, where) for tag in ("limit", "dynamics", "mimic"))
    effort = _limit(limit, "effort", where)
    damping, friction = (_optional(dynamics, key, f"{where}, <dynamics>") for key in ("damping", "friction"))
    for key, value in (("effort", effort), ("damping", damping), ("friction", friction)):
        if value < 0:
            raise SceneError(f"URDF: {where}: {key} = {value:g}, it must be 0 or greater")
    return UrdfJoint(
        name=name,
        type=kind,
        parent=_required(_child(element, "parent", where), "link", f"{where}, <parent>"),
        child=_required(_child(element, "child", where), "link", f"{where}, <child>"),
        origin=_origin(element, where),
        axis=_axis(element, where) if kind in MOVABLE else np.array([0.0, 0.0, 1.0]),
        effort=effort if effort and effort < UNLIMITED else None,
        written_effort=effort,
        limits=_limits(limit, where, unit) if kind in ("revolute", "prismatic") else None,
        rate=_rate(limit, where, unit) if kind in MOVABLE else math.inf,
        damping=damping,
        friction=friction,
        mimics=None if mimic is None else _required(mimic, "joint", f"{where}, <mimic>"),
        ratio=_optional(mimic, "multiplier", f"{where}, <mimic>", 1.0),
        offset=_optional(mimic, "offset", f"{where}, <mimic>"),
    )


def _limits(limit: Element | None, where: str, unit: str) -> tuple[float, float] | None:
    """Smallest and largest coordinate; none where both are 0, which many files write for unknown."""
    lower, upper = (_limit(limit, key, where) for key in ("lower", "upper"))
    if lower > upper:
        raise SceneError(f"URDF: {where}: lower = {lower:g} {unit} is greater than upper = {upper:g} {unit}")
    if lower == upper == 0.0:
        return None
    return lower if lower > -UNLIMITED else -math.inf, upper if upper < UNLIMITED else math.inf


def _rate(limit: Element | None, where: str, unit: str) -> float:
    """Largest rate; none where it is 0, which many files write for unknown."""
    rate = _limit(limit, "velocity", where)
    if rate < 0:
        raise SceneError(f"URDF: {where}: velocity = {rate:g} {unit}/s, it must be 0 or greater")
    return rate if 0.0 < rate < UNLIMITED else math.inf


def _limit(limit: Element | None, key: str, where: str) -> float:
    """A limit of any size: simulators write 1e16, or the largest number there is, for none."""
    if limit is None or key not in limit.attrib:
        return 0.0
    where = f"{where}, <limit>"
    return _numbers(_required(limit, key, where), 1, key, where, largest=math.inf)[0]


def _axis(element: Element, where: str) -> Array:
    axis = _only(element, "axis", where)
    vector = np.array((1.0, 0.0, 0.0) if axis is None else _direction(axis, where))
    largest = float(np.abs(vector).max())
    if largest == 0:
        raise SceneError(f"URDF: {where}: the axis has zero length; it must give a direction")
    # In two steps: squares of large numbers, and of small ones, would not be finite, or be zero.
    direction: Array = vector / largest
    return direction / np.linalg.norm(direction)


def _origin(element: Element, where: str) -> Pose:
    origin = _only(element, "origin", where)
    if origin is None:
        return poses.from_rotation_and_position((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    where = f"{where}, <origin>"
    position, (roll, pitch, yaw) = (
        _vector(origin, key, where) if key in origin.attrib else (0.0, 0.0, 0.0) for key in ("xyz", "rpy")
    )
    if "quat_xyzw" not in origin.attrib:
        return poses.from_rotation_and_position(rotations.from_euler_321(yaw, pitch, roll), position)
    if "rpy" in origin.attrib:
        raise SceneError(f"URDF: {where}: rpy and quat_xyzw both say how it is turned: keep one")
    x, y, z, w = _vector(origin, "quat_xyzw", where, 4)
    if abs(math.hypot(w, x, y, z) - 1.0) > _UNIT_TOLERANCE:
        text = shortened(origin.get("quat_xyzw"))
        raise SceneError(f"URDF: {where}: quat_xyzw = {text}, it must be a unit quaternion within 1e-3")
    return poses.from_rotation_and_position(normalize((w, x, y, z)), position)


def _name(element: Element) -> str:
    name = _required(element, "name", f"a <{element.tag}>")
    if len(name) > _LONGEST_NAME:
        raise SceneError(
            f"URDF: a <{element.tag}>: name = {shortened(name, 40)} of {len(name):,} characters, it should "
            f"have at most {_LONGEST_NAME}"
        )
    return name


def _only(element: Element, tag: str, where: str) -> Element | None:
    children = element.findall(tag)
    if len(children) > 1:
        raise SceneError(f"URDF: {where}: there are {len(children)} <{tag}>, at most one is allowed")
    return children[0] if children else None


def _child(element: Element, tag: str, where: str) -> Element:
    child = _only(element, tag, where)
    if child is None:
        raise SceneError(f"URDF: {where}: <{tag}> is missing")
    return child


def _required(element: Element, key: str, where: str) -> str:
    value = element.get(key)
    if not value or value.isspace():
        raise SceneError(f"URDF: {where}: the attribute {key!r} is missing")
    return value


def _number(element: Element, key: str, where: str) -> float:
    return _numbers(_required(element, key, where), 1, key, where)[0]


def _optional(element: Element | None, key: str, where: str, default: float = 0.0) -> float:
    return default if element is None or key not in element.attrib else _number(element, key, where)


def _direction(element: Element, where: str) -> tuple[float, ...]:
    where = f"{where}, <axis>"
    return _numbers(_required(element, "xyz", where), 3, "xyz", where, largest=math.inf)


def _vector(element: Element, key: str, where: str, count: int = 3) -> tuple[float, ...]:
    return _numbers(_required(element, key, where), count, key, where)


def _numbers(text: str, count: int, key: str, where: str, *, largest: float = _LARGEST) -> tuple[float, ...]:
    numbers: tuple[float, ...] = ()
    if text.isascii() and "_" not in text:  # which Python would read
        with suppress(ValueError):
            numbers = tuple(float(word) for word in text.split())
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise SceneError(f"URDF: {where}: {key} = {shortened(text)}, it must be {wanted}")
    if any(abs(number) > largest for number in numbers):
        raise SceneError(f"URDF: {where}: {key} = {shortened(text)}, it must be within {_LARGEST:g}")
    return numbers
