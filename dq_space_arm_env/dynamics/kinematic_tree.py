"""The constants of a robot: what the equations of motion need of a scene, as plain scalars.

A `KinematicTree` is a base, links that branch from it, an optional massless wrist, and a tip frame. Body 0 is
the base, body i+1 link i, and a parent comes before what it carries. Link frames are the joint frames of the
paper: frame i is fixed in the distal body i+1, with its z axis along the joint axis. Every joint is a screw
about and along that axis.

A spherical joint is three of them with the axes x, y and z of the link that it carries: the first takes the
joint's quaternion as its coordinate, the other two stand at zero, and the bodies between have no mass. Each
has its rate, the component of the link's angular velocity relative to its parent, in the link's axes. Only
the accelerations that these rates cause differ from those of three joints one after another.

A payload is merged into the body that holds it, and so is a link whose joint is fixed. Masses, inertias,
stiffness and damping are numbers, or symbols where they are parameters of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra.vectors import (
    add,
    dot,
    matrix_product,
    matrix_vector,
    scale,
    subtract,
    transpose,
)
from dq_space_arm_env.dynamics.jets import Jet
from dq_space_arm_env.dynamics.reaction_wheels import Wheel, free_inertia
from dq_space_arm_env.scene.parameters import center_name, inertia_name

if TYPE_CHECKING:
    from dq_space_arm_env.scene import Base, Link, Payload, Pose, Scene
    from dq_space_arm_env.scene.drives import Motor

Scalar = Any
Given = Mapping[str, Scalar]
Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True)
class RigidBody:
    """Mass properties of a body."""

    mass: Scalar  # kg
    center_of_mass: Sequence[Scalar]  # in the body's frame, m
    inertia: Sequence[Sequence[Scalar]]  # about the center of mass, body axes, 3x3, kg m^2


@dataclass(frozen=True)
class Placement:
    """Constant pose of one frame in another."""

    position: Vector  # of the origin, in the outer frame, m
    rotation: Matrix  # from inner to outer axes; entries of 0 and +-1 are exact
    dual_quaternion: tuple[float, ...]  # q_{inner/outer}

    def within(self, outer: Placement | None) -> Placement:
        """The same seen from the frame in which the outer one is placed; None for the outer frame itself."""
        if outer is None:
            return self
        x, y, z = add(outer.position, matrix_vector(outer.rotation, self.position))
        first, second, third = (
            (row[0], row[1], row[2]) for row in matrix_product(outer.rotation, self.rotation)
        )
        pose = dq.multiply(outer.dual_quaternion, self.dual_quaternion)
        return Placement((x, y, z), (first, second, third), tuple(pose))


class Screw(NamedTuple):
    """Motion of a link about and along the z axis of its frame, per unit of its joint's coordinate."""

    turn: float  # 1, or 0 for a prismatic joint
    slide: float  # 0 for a revolute joint, 1 for a prismatic one, or the pitch, m/rad


class Rotor(NamedTuple):
    """A motor's rotor on the body before a joint, which a gear turns about the joint's z axis."""

    inertia: Scalar  # J_r, about its axis, kg m^2; the body before the joint has the rest of its inertia
    gear: float  # N, turns of the rotor per coordinate of the joint, 1 or rad/m
    exact: bool  # energy J_r (a . omega + N rate)^2 / 2 with the body's omega, or J_r (N rate)^2 / 2

    @property
    def reflected(self) -> Scalar:
        """Inertia about the joint, N^2 J_r."""
        return self.inertia * (self.gear * self.gear)


class Friction(NamedTuple):
    """Coulomb friction of a joint, torque tanh(rate / speed)."""

    torque: Scalar  # N m
    speed: float  # rad/s


class Elasticity(NamedTuple):
    """An elastic gear between rotor and joint; on the joint's side."""

    inertia: Scalar  # of the rotor, B = N^2 J_r, kg m^2
    stiffness: Scalar  # N m/rad
    damping: Scalar  # N m s/rad
    friction: Friction | None  # of the rotor


SCREWS = {"revolute": Screw(1.0, 0.0), "prismatic": Screw(0.0, 1.0), "spherical": Screw(1.0, 0.0)}

# From the axes of each body of a spherical joint to those of the one before, or of the link to those of the
# first: z of one is x of the other, so that the z axes are x, y and z of the link.
TURNED_AXES = Placement(
    (0.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (0.5,) * 4 + (0.0,) * 4
)
_MASSLESS = RigidBody(0.0, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0),) * 3)


@dataclass(frozen=True)
class JointedLink:
    """A link and the joint that carries it.

    The units are those of a joint that turns; one that only slides has m and N instead of rad and N m.
    """

    body: RigidBody  # in the joint frame
    joint: Placement  # joint frame at zero in the parent's frame (base center of mass, or joint frame)
    screw: Screw
    parent: int  # body that carries it: 0 is the base, i+1 link i
    stiffness: Scalar  # N m/rad
    rest_angle: float  # of the spring, rad
    damping: Scalar  # N m s/rad
    rotor: Rotor | None = None
    friction: Friction | None = None
    elastic: Elasticity | None = None  # in place of rotor and friction
    spherical: int | None = None  # of a spherical joint: axis of its link, x, y or z, that is this one's z


@dataclass(frozen=True)
class KinematicTree:
    """A free base with its links."""

    base: RigidBody  # frame at the center of mass
    links: tuple[JointedLink, ...]  # each after its parent
    tip_body: int  # body that carries wrist and tip
    wrist: Placement | None  # wrist frame at zero angles, in the frame of that body
    tip: Placement  # tip frame G in the wrist frame, or in that body's without a wrist
    other_tips: tuple[tuple[int, Placement], ...]  # bodies that carry them, and their frames there
    tip_wrench: tuple[float, ...] | None  # force [N], torque [N m] at G, in G axes (16)
    planar: bool  # the base moves in its x-y plane only
    heaviest: int = 0  # body of greatest nominal mass: 0 is the base, i link i
    heavy_base: bool = False  # its nominal mass is beyond 100 times that of the first link and all it carries
    jets: tuple[Jet, ...] = ()  # thrusters
    wheels: tuple[Wheel, ...] = ()  # free to turn: the base's inertia is without their axial ones
    tank: Vector | None = None  # where propellant is that the base does not contain, in its frame, m
    # Where base and links of the scene are: the body that each is, or is fixed to, and its frame there.
    places: tuple[tuple[int, Placement | None], ...] = ()

    @property
    def bodies(self) -> list[RigidBody]:
        """Base and links, n + 1."""
        return [self.base, *(link.body for link in self.links)]

    @property
    def parents(self) -> list[int]:
        """Bodies that carry the links, n."""
        return [link.parent for link in self.links]

    def with_propellant(self, masses: Sequence[Scalar]) -> KinematicTree:
        """The tree whose base contains what is left in its tank, if it has one; masses in kg.

        The frame of the base stays where it is, off the center of mass.
        """
        if self.tank is None:
            return self
        (mass,) = masses
        propellant = RigidBody(mass, self.tank, ((0.0,) * 3,) * 3)
        return replace(self, base=_merged(self.base, propellant), tank=None)

    @property
    def has_spherical(self) -> bool:
        """Whether a joint is spherical."""
        return any(link.spherical is not None for link in self.links)

    def coordinates(self, values: Sequence[Scalar]) -> list[Any]:
        """One coordinate per link from those of a state: of spherical joints a quaternion, and two zeros."""
        given = iter(values)
        found: list[Any] = []
        for link in self.links:
            if link.spherical is None:
                found.append(next(given))
            else:
                found.append(0.0 if link.spherical else tuple(next(given) for _ in range(4)))
        return found

    def path_to(self, body: int) -> list[int]:
        """Indices of the links from the base to a body."""
        path: list[int] = []
        while body:
            path.insert(0, body - 1)
            body = self.links[body - 1].parent
        return path

    @classmethod
    def from_scene(cls, scene: Scene, given: Given | None = None) -> KinematicTree:
        """Collect a scene's constants; numbers `given` by name (`scene.parameters`) replace its own."""
        wrench, given = scene.tip_wrench, given or {}
        places, bodies, masses = _bodies(scene, given)
        wheels = tuple(Wheel(wheel.unit_axis, wheel.inertia) for wheel in scene.actuators.wheels or ())
        tank = scene.actuators.tank
        tip_body, at = places[scene.tip_body]
        wrist = None if scene.wrist is None else _placement(scene.wrist.frame).within(at)
        tip = _placement(scene.tip)
        links = tuple(_links(scene, given, places, bodies))
        others = [(places[scene.body_named(each.link)], _placement(each.frame)) for each in scene.other_tips]
        return cls(
            base=replace(bodies[0], inertia=free_inertia(bodies[0].inertia, wheels)) if wheels else bodies[0],
            links=links,
            tip_body=tip_body,
            wrist=wrist,
            tip=tip if wrist is not None else tip.within(at),
            other_tips=tuple((body, frame.within(place)) for (body, place), frame in others),
            tip_wrench=None if wrench is None else (*wrench.force, *wrench.torque),
            planar=scene.base.motion == "planar",
            heaviest=masses.index(max(masses)),
            heavy_base=masses[0] > 100.0 * _carried_mass(links, masses),
            jets=tuple(
                Jet(each.unit_direction, each.moment, 0.0 if tank is None else each.mass_flow)
                for each in scene.actuators.thrusters or ()
            ),
            wheels=wheels,
            tank=None if tank is None else tank.position,
            places=tuple(places),
        )


def _carried_mass(links: Sequence[JointedLink], masses: Sequence[float]) -> float:
    """Nominal mass of the first link and of what it carries; 0 without links."""
    carried = {1}
    for body, link in enumerate(links, 1):
        if link.parent in carried:
            carried.add(body)
    return sum(masses[body] for body in carried) if links else 0.0


Places = list[tuple[int, Placement | None]]


def _bodies(scene: Scene, given: Given) -> tuple[Places, list[RigidBody], list[float]]:
    """Places of base and links; bodies with payloads and what is fixed to them; their nominal masses, kg."""
    places: Places = [(0, None)]
    bodies, masses = [rigid_body(scene.base, "base", (0.0, 0.0, 0.0), given)], [scene.base.mass]
    if scene.actuators.tank is not None:
        masses[0] += scene.actuators.tank.propellant

    def add_to(body: int, nominal: float, part: RigidBody) -> None:
        bodies[body] = _merged(bodies[body], part)
        masses[body] += nominal

    for index, link in enumerate(scene.links):
        own = rigid_body(link, f"links.{index}", link.center_of_mass, given)
        if link.is_fixed:
            parent, at = places[scene.parent_bodies[index]]
            place = _placement(link.joint).within(at)
            places.append((parent, place))
            add_to(parent, link.mass, _moved(own, place))
            continue
        bodies += [*[_MASSLESS] * (link.freedoms - 1), own]
        masses += [*[0.0] * (link.freedoms - 1), link.mass]
        places.append((len(bodies) - 1, None))
    held = [(scene.tip_body, scene.payload, scene.tip, "payload")]
    for tip in scene.other_tips:  # a place of no parameters
        held.append((scene.body_named(tip.link), tip.payload, tip.frame, ""))
    for carrier, payload, frame, name in held:
        if payload is not None:
            body, at = places[carrier]
            own = rigid_body(payload, name, payload.center_of_mass, given)
            add_to(body, payload.mass, _moved(own, _placement(frame).within(at)))
    return places, bodies, masses


def _links(scene: Scene, given: Given, places: Places, bodies: Sequence[RigidBody]) -> Iterator[JointedLink]:
    """The joints that move, with the bodies that they carry."""
    body = 0
    for index, link in enumerate(scene.links):
        parent, at = places[scene.parent_bodies[index]]
        joint = _placement(link.joint).within(at)
        passive = (
            given.get(f"links.{index}.stiffness", link.stiffness),
            link.rest_angle,
            given.get(f"links.{index}.damping", link.damping),
        )
        drive = _drive(link.motor, f"links.{index}.motor", given)
        screw = SCREWS.get(link.joint_type) or Screw(1.0, link.pitch)
        for axis in range(link.freedoms):
            body += 1
            if axis:
                parent, joint = body - 1, TURNED_AXES
            spherical = axis if link.is_spherical else None
            yield JointedLink(bodies[body], joint, screw, parent, *passive, *drive, spherical)


def rigid_body(body: Base | Link | Payload, place: str, center_of_mass: Vector, given: Given) -> RigidBody:
    """Mass properties of the body at a place of the scene."""
    return RigidBody(
        given.get(f"{place}.mass", body.mass),
        tuple(given.get(center_name(place, i), entry) for i, entry in enumerate(center_of_mass)),
        tuple(
            tuple(given.get(inertia_name(place, i, j), entry) for j, entry in enumerate(row))
            for i, row in enumerate(body.inertia)
        ),
    )


def _drive(
    motor: Motor | None, place: str, given: Given
) -> tuple[Rotor | None, Friction | None, Elasticity | None]:
    """Rotor, friction and elasticity of a joint's motor, as far as it has them."""
    if motor is None:
        return None, None, None
    values = {name: given.get(f"{place}.{name}", getattr(motor, name)) for name in motor.varying}
    rotor = Rotor(values["inertia"], motor.gear, motor.coupling == "exact") if motor.inertia else None
    friction = Friction(values["friction"], motor.friction_speed) if motor.friction else None
    if motor.stiffness is None or rotor is None:
        return rotor, friction, None
    damping = values.get("damping", 0.0)
    return None, None, Elasticity(rotor.reflected, values["stiffness"], damping, friction)


def _placement(pose: Pose) -> Placement:
    return Placement(pose.position, pose.rotation_matrix, pose.dual_quaternion)


def _moved(body: RigidBody, place: Placement) -> RigidBody:
    """Mass properties in the frame in which the body's own frame is placed."""
    rotation = place.rotation
    inertia = matrix_product(matrix_product(rotation, body.inertia), transpose(rotation))
    return RigidBody(body.mass, add(place.position, matrix_vector(rotation, body.center_of_mass)), inertia)


def _merged(a: RigidBody, b: RigidBody) -> RigidBody:
    """Mass properties of two bodies that move as one, by the parallel axis theorem."""
    mass = a.mass + b.mass
    moments = add(scale(a.mass, a.center_of_mass), scale(b.mass, b.center_of_mass))
    # About the common center of mass, the two act like their reduced mass at their distance.
    d = subtract(b.center_of_mass, a.center_of_mass)
    reduced = a.mass * b.mass / mass
    inertia = [[0.0] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i + 1):
            entry = a.inertia[i][j] + b.inertia[i][j] - reduced * (d[i] * d[j])
            inertia[i][j] = inertia[j][i] = entry + reduced * dot(d, d) if i == j else entry
    return RigidBody(mass, scale(1.0 / mass, moments), tuple(map(tuple, inertia)))
