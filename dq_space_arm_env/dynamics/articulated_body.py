"""Accelerations by the articulated-body algorithm: one joint after the other is eliminated, no matrix of all.

An articulated body is a body with everything that its joints carry; its inertia says which wrench an
acceleration of that body needs while the joints move freely (Featherstone, Rigid Body Dynamics Algorithms,
2008, chapter 7). From both ends of the chain, each body hands its articulated inertia over the joint to the
next, until they meet at the root, whose six accelerations are solved for; joints follow on the way back. The
effort grows linearly with the number of joints.

Any body can be the root, and rounding decides which. Eliminating a joint takes off all inertia about its
axis, exactly; but turned to other axes and added to a lighter body, what is left of a heavy one buries the
little that the light one has about that axis. Toward the heaviest body, light ones are added to heavy ones
instead, and extreme mass ratios cost no digits. A root next to the heaviest body, on the far side of its own
joint, is as good: the axis of that joint is an axis of the root's frame, the last to be solved for.
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
from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.dynamics.linear import factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.minimal import ZERO, Accelerations, shift_wrench

Scalar = Any
Vector3 = Sequence[Scalar]
Rows = Sequence[Vector3]
Wrench = tuple[Vector3, Vector3]


@dataclass(frozen=True)
class ArticulatedInertia:
    """Wrench per acceleration: force = M a + H' alpha, torque = H a + J alpha, all about a frame's origin.

    Attributes:
        mass: M, 3x3, symmetric, kg.
        coupling: H, 3x3, kg m.
        inertia: J, 3x3, symmetric, kg m^2.
    """

    mass: Rows
    coupling: Rows
    inertia: Rows

    @classmethod
    def of_body(cls, body: RigidBody) -> ArticulatedInertia:
        """Inertia of a rigid body that carries nothing."""
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
        """The same in other axes; the matrix maps to them."""
        mass, inertia = ([matrix_vector(part, row) for row in rotation] for part in (self.mass, self.inertia))
        coupling = [transposed_matrix_vector(self.coupling, row) for row in rotation]
        return ArticulatedInertia(
            _symmetric(lambda i, j: dot(rotation[i], mass[j])),
            [[dot(coupling[i], rotation[j]) for j in range(3)] for i in range(3)],
            _symmetric(lambda i, j: dot(rotation[i], inertia[j])),
        )

    def plus(self, other: ArticulatedInertia) -> ArticulatedInertia:
        """Sum of two inertias."""
        pairs = ((self.mass, other.mass), (self.coupling, other.coupling), (self.inertia, other.inertia))
        return ArticulatedInertia(*([add(a, b) for a, b in zip(*pair, strict=True)] for pair in pairs))


@dataclass(frozen=True)
class _Joint:
    """An eliminated joint: what it takes to turn the body that it carries about its z axis.

    Attributes:
        force: Force per angular acceleration, 3, kg m.
        torque: Torque per angular acceleration, 3, kg m^2.
        inverse: 1 over the inertia about the axis, 1/(kg m^2).
    """

    force: Vector3
    torque: Vector3
    inverse: Scalar

    @classmethod
    def eliminated(cls, body: ArticulatedInertia) -> tuple[_Joint, ArticulatedInertia]:
        """Let a body turn freely about the z axis: nothing is left of its inertia about it."""
        force, torque = body.coupling[2], [row[2] for row in body.inertia]
        joint = cls(force, torque, 1.0 / torque[2])
        by_force, by_torque = scale(joint.inverse, force), scale(joint.inverse, torque)
        mass = _symmetric(lambda i, j: body.mass[i][j] - force[i] * by_force[j])
        coupling = [[body.coupling[i][j] - by_torque[i] * force[j] for j in range(3)] for i in range(2)]
        inertia = _symmetric(
            lambda i, j: 0.0 if 2 in (i, j) else body.inertia[i][j] - torque[i] * by_torque[j]
        )
        return joint, ArticulatedInertia(mass, [*coupling, ZERO], inertia)

    def passed(self, force: Vector3, torque: Vector3, own: Scalar) -> Wrench:
        """What of a wrench on the body reaches the other side of the joint, given the joint's own torque.

        Args:
            force: 3, N.
            torque: 3, N m.
            own: Sum of the joint's torque on the body and the wrench's about the axis, N m.

        Returns:
            Force and torque, in the same frame.
        """
        turning = own * self.inverse
        return subtract(force, scale(turning, self.force)), subtract(torque, scale(turning, self.torque))

    def acceleration(self, own: Scalar, linear: Vector3, angular: Vector3) -> Scalar:
        """Acceleration of the joint, given that of the body on its other side."""
        return (own - (dot(self.force, linear) + dot(self.torque, angular))) * self.inverse


class ArticulatedBodies:
    """The articulated inertias of a chain at given joint angles, and the root's, factorized."""

    def __init__(self, chain: Chain, rotations: Sequence[Rows], root: int = 0) -> None:
        """Eliminate all joints, from both ends of the chain to its root.

        Args:
            chain: The robot.
            rotations: From `minimal.joint_rotations`, n.
            root: Body at which the recursions from both ends meet: 0 is the base, i link i.
        """
        self._planar, self._rotations, self._root = chain.planar, rotations, root
        self._positions = [link.joint.position for link in chain.links]
        bodies = [
            ArticulatedInertia.of_body(body) for body in (chain.base, *(link.body for link in chain.links))
        ]
        self._joints: dict[int, _Joint] = {}
        for i in range(self._root):
            body = bodies[i].shifted(scale(-1.0, self._positions[i])).rotated(transpose(rotations[i]))
            self._joints[i], body = _Joint.eliminated(body)
            bodies[i + 1] = bodies[i + 1].plus(body)
        for i in reversed(range(self._root, len(rotations))):
            self._joints[i], body = _Joint.eliminated(bodies[i + 1])
            bodies[i] = bodies[i].plus(body.rotated(rotations[i]).shifted(self._positions[i]))
        self._factor = factorize_ldl(_root_block(bodies[self._root], self._free))

    @property
    def _free(self) -> Sequence[int]:
        """Accelerations that the root has: linear ones, then angular ones."""
        return (0, 1, 5) if self._planar else range(6)

    def accelerations(self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations that wrenches on the bodies and torques in the joints produce.

        Args:
            wrenches: Force [N] and torque [N m] on base and links about the origins of their frames, in their
                axes, n + 1 pairs.
            joints: Joint torques, n, N m.

        Returns:
            The accelerations, without any velocity-dependent term.
        """
        acting, own = list(wrenches), list(joints)
        for i in range(self._root):
            force, torque = acting[i]
            torque = subtract(torque, cross(self._positions[i], force))
            force = transposed_matrix_vector(self._rotations[i], force)
            torque = transposed_matrix_vector(self._rotations[i], torque)
            own[i] = torque[2] - joints[i]
            acting[i + 1] = _sum(acting[i + 1], self._joints[i].passed(force, torque, own[i]))
        for i in reversed(range(self._root, len(joints))):
            force, torque = acting[i + 1]
            own[i] = torque[2] + joints[i]
            passed = self._joints[i].passed(force, torque, own[i])
            acting[i] = _sum(acting[i], shift_wrench(self._rotations[i], self._positions[i], *passed))
        return self._outward(acting[self._root], own)

    def solve(self, force: Vector3, torque: Vector3, joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations that generalized forces produce, the mass matrix's inverse times them.

        Args:
            force: Force on the base, base axes, 3, N.
            torque: Torque on the base about its center of mass, 3, N m.
            joints: Joint torques, n, N m.

        Returns:
            The accelerations, without any velocity-dependent term.
        """
        return self.accelerations([(force, torque), *[(ZERO, ZERO)] * len(joints)], joints)

    def _outward(self, acting: Wrench, own: Sequence[Scalar]) -> Accelerations:
        """Accelerations of the root, then of everything that it carries."""
        both = [*acting[0], *acting[1]]
        six: list[Scalar] = [0.0] * 6
        for index, value in zip(
            self._free, solve_ldl(self._factor, [both[i] for i in self._free]), strict=True
        ):
            six[index] = value
        joints: list[Scalar] = [0.0] * len(own)
        linear: Vector3 = six[:3]
        angular: Vector3 = six[3:]
        for i in range(self._root, len(own)):
            rotation, position = self._rotations[i], self._positions[i]
            linear = transposed_matrix_vector(rotation, add(linear, cross(angular, position)))
            angular = transposed_matrix_vector(rotation, angular)
            joints[i] = self._joints[i].acceleration(own[i], linear, angular)
            angular = (*angular[:2], angular[2] + joints[i])
        linear, angular = six[:3], six[3:]
        for i in reversed(range(self._root)):
            # The body before the joint turns backward about the axis.
            turning = self._joints[i].acceleration(own[i], linear, angular)
            joints[i] = -turning
            angular = matrix_vector(self._rotations[i], (*angular[:2], angular[2] + turning))
            linear = subtract(matrix_vector(self._rotations[i], linear), cross(angular, self._positions[i]))
        return Accelerations(angular, linear, joints)


def _symmetric(entry: Callable[[int, int], Scalar]) -> list[list[Scalar]]:
    """A symmetric matrix 3x3, its entries computed once."""
    result: list[list[Scalar]] = [[0.0] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            result[i][j] = result[j][i] = entry(i, j)
    return result


def _sum(a: Wrench, b: Wrench) -> Wrench:
    return add(a[0], b[0]), add(a[1], b[1])


def _root_block(body: ArticulatedInertia, free: Sequence[int]) -> list[list[Scalar]]:
    """Inertia of the root, linear directions first, its joint's axis last, where it moves."""
    upper = [[*body.mass[i], *(row[i] for row in body.coupling)] for i in range(3)]
    lower = [[*body.coupling[i], *body.inertia[i]] for i in range(3)]
    matrix = [*upper, *lower]
    return [[matrix[i][j] for j in free] for i in free]
