"""Forward dynamics by the articulated-body algorithm (ABA), rooted at any body.

An articulated body is a body together with everything its joints carry; its inertia maps an acceleration of
that body to the wrench it needs while the joints move freely (Featherstone, Rigid Body Dynamics Algorithms,
2008, chapter 7). From the ends of the tree, each body hands its articulated inertia across the joint to the
next, until they meet at the root, whose six accelerations are solved for; the joints follow on the way back.
The cost is linear in the number of joints.

The root is free, and rounding decides it. Eliminating a joint removes all inertia along its screw, exactly;
but rotated to other axes and added to a lighter body, the remainder of a heavy body buries the little inertia
that the light one has about that axis. Toward the heaviest body, light bodies are added to heavy ones
instead, and extreme mass ratios cost no digits. A root next to the heaviest body, across its own joint, is as
good while that body is not far heavier: the joint's axis is an axis of the root's frame, the last to be
solved for, but what the body hands across is rounded in proportion to its mass.

Reaction wrenches need no difference of accelerations: a joint transmits what the articulated body beyond it,
seen from the root, needs at the acceleration of the joint. Along the screw it needs nothing, and how fast a
light body turns there does not enter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    dot,
    matrix_vector,
    scale,
    skew_matrix,
    subtract,
    transpose,
    transposed_matrix_vector,
)
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, RigidBody, Rotor, Screw
from dq_space_arm_env.dynamics.linear import factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.minimal import ZERO, Accelerations, LinkFrame, along, shift_wrench

Scalar = Any
Vector3 = Sequence[Scalar]
Rows = Sequence[Vector3]
Wrench = tuple[Vector3, Vector3]


@dataclass(frozen=True)
class ArticulatedInertia:
    """Wrench per acceleration: force = M a + H' alpha, torque = H a + J alpha, about a frame's origin."""

    mass: Rows  # M, 3x3, symmetric, kg
    coupling: Rows  # H, 3x3, kg m
    inertia: Rows  # J, 3x3, symmetric, kg m^2

    @classmethod
    def of_body(cls, body: RigidBody) -> ArticulatedInertia:
        """Inertia of a rigid body without joints."""
        m = body.mass
        point = cls([[m, 0.0, 0.0], [0.0, m, 0.0], [0.0, 0.0, m]], [ZERO] * 3, body.inertia)
        return point.shifted(body.center_of_mass)

    def shifted(self, p: Vector3) -> ArticulatedInertia:
        """The same about another origin, in which the present one has position p."""
        skew = skew_matrix(p)
        coupling = [[self.coupling[i][j] + dot(skew[i], self.mass[j]) for j in range(3)] for i in range(3)]
        # J + [p] H'' - H [p] for the new H'' = H + [p] M, with [p]' = -[p].
        return ArticulatedInertia(
            self.mass,
            coupling,
            _symmetric(
                lambda i, j: self.inertia[i][j] + dot(skew[i], coupling[j]) + dot(self.coupling[i], skew[j])
            ),
        )

    def rotated(self, rotation: Rows) -> ArticulatedInertia:
        """The same in other axes, to which `rotation` maps."""
        mass, inertia = ([matrix_vector(part, row) for row in rotation] for part in (self.mass, self.inertia))
        coupling = [transposed_matrix_vector(self.coupling, row) for row in rotation]
        return ArticulatedInertia(
            _symmetric(lambda i, j: dot(rotation[i], mass[j])),
            [[dot(coupling[i], rotation[j]) for j in range(3)] for i in range(3)],
            _symmetric(lambda i, j: dot(rotation[i], inertia[j])),
        )

    def wrench(self, linear: Vector3, angular: Vector3) -> Wrench:
        """Force and torque that an acceleration needs."""
        force = add(matrix_vector(self.mass, linear), transposed_matrix_vector(self.coupling, angular))
        return force, add(matrix_vector(self.coupling, linear), matrix_vector(self.inertia, angular))

    def plus(self, other: ArticulatedInertia) -> ArticulatedInertia:
        pairs = ((self.mass, other.mass), (self.coupling, other.coupling), (self.inertia, other.inertia))
        return ArticulatedInertia(*([add(a, b) for a, b in zip(*pair, strict=True)] for pair in pairs))


@dataclass(frozen=True)
class _Joint:
    """An eliminated joint, with the wrench per acceleration of its coordinate, a screw about its z axis."""

    screw: Screw
    force: Vector3  # per acceleration, kg m
    torque: Vector3  # per acceleration, kg m^2
    inverse: Scalar  # of the inertia along the screw, 1/(kg m^2)
    remainder: ArticulatedInertia  # of the body across the joint, none along the screw but for a rotor
    rotor: Rotor | None

    @classmethod
    def eliminated(cls, body: ArticulatedInertia, screw: Screw, rotor: Rotor | None = None) -> _Joint:
        """Free a body along a screw about its z axis, with the rotor that turns as it does."""
        # I^a = I - U D^-1 U' with U = I s, D = s' I s and the screw s (Featherstone, table 7.1).
        turn, slide = screw
        force: Vector3 = body.coupling[2]
        torque: Vector3 = [row[2] for row in body.inertia]
        if slide:
            lever = [row[2] for row in body.coupling]
            force = add(scale(turn, force), scale(slide, [row[2] for row in body.mass]))
            torque = add(scale(turn, torque), scale(slide, lever))
        own = along(screw, force, torque)
        inertia: Rows = body.inertia
        if rotor is not None:
            own = own + rotor.reflected
        if rotor is not None and rotor.exact:
            # Its energy J_r (a'_z + N qdd)^2 / 2 adds J_r z z' to I, N J_r z to U and N^2 J_r to D.
            torque = (*torque[:2], torque[2] + rotor.inertia * rotor.gear)
            inertia = [*inertia[:2], (*inertia[2][:2], inertia[2][2] + rotor.inertia)]
        inverse = 1.0 / own
        by_force, by_torque = scale(inverse, force), scale(inverse, torque)
        mass = _symmetric(lambda i, j: body.mass[i][j] - force[i] * by_force[j])
        coupling = [[body.coupling[i][j] - by_torque[i] * force[j] for j in range(3)] for i in range(3)]
        left = _symmetric(lambda i, j: inertia[i][j] - torque[i] * by_torque[j])
        if rotor is None:
            _clear(screw, mass, coupling, left)
        return cls(screw, force, torque, inverse, ArticulatedInertia(mass, coupling, left), rotor)

    def passed(self, force: Vector3, torque: Vector3, own: Scalar) -> Wrench:
        """Share of a wrench on the body that crosses the joint.

        `own` is the joint's torque on the body plus the wrench's share along the screw, N m.
        """
        # The wrench on the body minus U D^-1 u.
        turning = own * self.inverse
        return subtract(force, scale(turning, self.force)), subtract(torque, scale(turning, self.torque))

    def acceleration(self, own: Scalar, linear: Vector3, angular: Vector3) -> Scalar:
        """Joint acceleration, given the acceleration of the body on the other side."""
        # qdd = D^-1 (u - U' a') (table 7.1).
        return (own - (dot(self.force, linear) + dot(self.torque, angular))) * self.inverse

    def moved(self, linear: Vector3, angular: Vector3, change: Scalar) -> tuple[Vector3, Vector3]:
        """Linear and angular acceleration beyond the joint, whose coordinate accelerates."""
        turn, slide = self.screw
        if slide:
            linear = (*linear[:2], linear[2] + slide * change)
        return linear, (*angular[:2], angular[2] + change) if turn else angular


class ArticulatedBodies:
    """Articulated inertias of a tree at given joint angles, with the root's factorized."""

    def __init__(self, tree: KinematicTree, frames: Sequence[LinkFrame], root: int = 0) -> None:
        """Eliminate all joints, from the ends of the tree to its root (0 is the base, i link i)."""
        self._planar, self._frames, self._root = tree.planar, frames, root
        self._parents = tree.parents
        self._inverted = tree.path_to(root)
        self._inward = _inward(tree, root)
        bodies = [ArticulatedInertia.of_body(body) for body in tree.bodies]
        self._joints: dict[int, _Joint] = {}
        for i in self._inward:
            (rotation, position), parent = frames[i], self._parents[i]
            screw, rotor = tree.links[i].screw, tree.links[i].rotor
            if i in self._inverted:  # the parent is carried by the joint, which moves backward
                body = bodies[parent].shifted(scale(-1.0, position)).rotated(transpose(rotation))
                self._joints[i] = _Joint.eliminated(body, screw, _backward(rotor, screw))
                bodies[i + 1] = bodies[i + 1].plus(self._joints[i].remainder)
            else:
                self._joints[i] = _Joint.eliminated(bodies[i + 1], screw, rotor)
                body = self._joints[i].remainder.rotated(rotation).shifted(position)
                bodies[parent] = bodies[parent].plus(body)
        self._factor = factorize_ldl(_root_block(bodies[self._root], self._free))

    @property
    def _free(self) -> Sequence[int]:
        """The root's accelerations: linear ones, then angular ones."""
        return (0, 1, 5) if self._planar else range(6)

    def accelerations(self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]) -> Accelerations:
        """See `forward.Inertia`."""
        return self._motion(wrenches, joints)[0]

    def reactions(self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]) -> list[Wrench]:
        """Wrench that each joint transmits to its link, in joint axes, under the same as `accelerations`."""
        solved, passed, reached = self._motion(wrenches, joints)
        reactions: list[Wrench] = []
        for i, (given, acceleration) in enumerate(zip(passed, reached, strict=True)):
            # The body beyond the joint is given I^a a' + p^a, where -p^a is passed on (Featherstone, 7.3).
            needed = self._joints[i].remainder.wrench(*acceleration)
            plus, minus = (given, needed) if i in self._inverted else (needed, given)
            force, torque = subtract(plus[0], minus[0]), subtract(plus[1], minus[1])
            rotor = self._joints[i].rotor
            if rotor is not None and rotor.exact and i not in self._inverted:  # of what carries it
                spinning = rotor.inertia * (acceleration[1][2] + rotor.gear * solved.joints[i])
                torque = (*torque[:2], torque[2] - spinning)
            reactions.append((force, torque))
        return reactions

    def _motion(
        self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]
    ) -> tuple[Accelerations, list[Wrench], list[tuple[Vector3, Vector3]]]:
        """Accelerations; per joint, the wrench passed to the root and the acceleration that reaches it."""
        acting, own = list(wrenches), list(joints)
        passed: list[Wrench] = [(ZERO, ZERO)] * len(joints)
        for i in self._inward:
            parent, joint, inverted = self._parents[i], self._joints[i], i in self._inverted
            force, torque = acting[parent] if inverted else acting[i + 1]
            if inverted:
                rotation, position = self._frames[i]
                torque = subtract(torque, cross(position, force))
                force = transposed_matrix_vector(rotation, force)
                torque = transposed_matrix_vector(rotation, torque)
            share = along(joint.screw, force, torque)
            own[i] = share - joints[i] if inverted else share + joints[i]
            passed[i] = joint.passed(force, torque, own[i])
            if inverted:
                acting[i + 1] = _sum(acting[i + 1], passed[i])
            else:
                acting[parent] = _sum(acting[parent], shift_wrench(*self._frames[i], *passed[i]))
        accelerations, reached = self._outward(acting[self._root], own)
        return accelerations, passed, reached

    def solve(self, force: Vector3, torque: Vector3, joints: Sequence[Scalar]) -> Accelerations:
        """See `forward.Inertia`."""
        return self.accelerations([(force, torque), *[(ZERO, ZERO)] * len(joints)], joints)

    def _outward(
        self, acting: Wrench, own: Sequence[Scalar]
    ) -> tuple[Accelerations, list[tuple[Vector3, Vector3]]]:
        """Accelerations of the root, then of everything it carries, and those that reach the joints."""
        both = [*acting[0], *acting[1]]
        six: list[Scalar] = [0.0] * 6
        for index, value in zip(
            self._free, solve_ldl(self._factor, [both[i] for i in self._free]), strict=True
        ):
            six[index] = value
        joints: list[Scalar] = [0.0] * len(own)
        reached: list[tuple[Vector3, Vector3]] = [(ZERO, ZERO)] * len(own)
        motions: dict[int, tuple[Vector3, Vector3]] = {self._root: (six[:3], six[3:])}
        for i in reversed(self._inward):
            (rotation, position), parent, joint = self._frames[i], self._parents[i], self._joints[i]
            if i in self._inverted:  # the body before the joint moves backward along the screw
                linear, angular = reached[i] = motions[i + 1]
                change = joint.acceleration(own[i], linear, angular)
                joints[i] = -change
                linear, angular = joint.moved(linear, angular, change)
                angular = matrix_vector(rotation, angular)
                motions[parent] = subtract(matrix_vector(rotation, linear), cross(angular, position)), angular
            else:
                linear, angular = motions[parent]
                linear = transposed_matrix_vector(rotation, add(linear, cross(angular, position)))
                angular = transposed_matrix_vector(rotation, angular)
                reached[i] = linear, angular
                joints[i] = joint.acceleration(own[i], linear, angular)
                motions[i + 1] = joint.moved(linear, angular, joints[i])
        linear, angular = motions[0]
        return Accelerations(angular, linear, joints), reached


def _inward(tree: KinematicTree, root: int) -> list[int]:
    """Order in which joints are eliminated: those of a body before the one that leads on to the root."""
    inverted, beyond = tree.path_to(root), {root}  # bodies that the root carries, with itself
    for i, parent in enumerate(tree.parents):
        beyond |= {i + 1} if parent in beyond else set()
    others = [i for i in range(len(tree.links)) if i not in inverted]
    aside = [i for i in others if i + 1 not in beyond]
    return [*reversed(aside), *inverted, *reversed([i for i in others if i + 1 in beyond])]


def _backward(rotor: Rotor | None, screw: Screw) -> Rotor | None:
    """The rotor per coordinate of a joint that turns its carrier backward instead of the link."""
    if rotor is None or not rotor.exact:
        return rotor
    # omega_z + N rate, with the link's omega_z less turn * rate in place of the carrier's.
    return rotor._replace(gear=screw.turn - rotor.gear)


def _clear(
    screw: Screw, mass: list[list[Scalar]], coupling: list[list[Scalar]], inertia: list[list[Scalar]]
) -> None:
    """Take from an eliminated body, exactly, what rounding leaves of its inertia along the screw."""
    for i in range(3):
        if screw.turn:  # s = (pitch z, z): the rows and columns of z follow from the others
            coupling[2][i] = -screw.slide * mass[2][i] if screw.slide else 0.0
        else:
            mass[2][i] = mass[i][2] = coupling[i][2] = 0.0
    if screw.turn:
        for i in range(3):
            inertia[2][i] = inertia[i][2] = -screw.slide * coupling[i][2] if screw.slide else 0.0


def _symmetric(entry: Callable[[int, int], Scalar]) -> list[list[Scalar]]:
    """Symmetric 3x3 matrix whose entries are computed once."""
    result: list[list[Scalar]] = [[0.0] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            result[i][j] = result[j][i] = entry(i, j)
    return result


def _sum(a: Wrench, b: Wrench) -> Wrench:
    return add(a[0], b[0]), add(a[1], b[1])


def _root_block(body: ArticulatedInertia, free: Sequence[int]) -> list[list[Scalar]]:
    """Inertia of the root: linear directions first, its joint's axis (if it moves) last."""
    upper = [[*body.mass[i], *(row[i] for row in body.coupling)] for i in range(3)]
    lower = [[*body.coupling[i], *body.inertia[i]] for i in range(3)]
    matrix = [*upper, *lower]
    return [[matrix[i][j] for j in free] for i in free]
