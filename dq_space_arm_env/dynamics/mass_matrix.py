"""The mass matrix in minimal coordinates by the composite-rigid-body algorithm (CRBA), and its factorization.

Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 6 and section 9.4. It also gives the system's
momentum, and the base velocity for a given momentum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dq_space_arm_env.algebra.vectors import add, cross, dot, matrix_vector, scale, subtract
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree, Matrix, RigidBody, Screw
from dq_space_arm_env.dynamics.linear import LDLFactor, factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.minimal import (
    ZERO,
    Accelerations,
    LinkFrame,
    along,
    passed_to_base,
    shift_wrench,
)

Scalar = Any
Vector3 = Sequence[Scalar]


class MassMatrix:
    """The mass matrix at given joint angles, factorized; `center` is the center of mass, base frame, m.

    The base's linear acceleration is eliminated first (its block is the total mass), which leaves a symmetric
    positive definite system for the base's angular and the joints' accelerations. LDL' is backward stable on
    such a matrix in any order of elimination. But each entry is a sum over bodies, in which light ones are
    lost in the rounding of heavy ones: the accelerations of a base lighter than its arm are off by rounding
    over the mass ratio.
    """

    def __init__(self, tree: KinematicTree, frames: Sequence[LinkFrame]) -> None:
        """Assemble (CRBA, Featherstone tables 6.2 and 9.6) and factorize."""
        self._tree, self._frames = tree, frames
        self._axes = (2,) if tree.planar else (0, 1, 2)
        mass, moment, inertia, columns, joint_block = _composite_bodies(tree, frames)
        self._mass = mass
        self.center = scale(1.0 / mass, moment)
        # Joint columns of the mass matrix in the base frame: force, and torque about the system's center of
        # mass.
        self._forces = [force for force, _ in columns]
        self._torques = [subtract(torque, cross(self.center, force)) for force, torque in columns]
        about_center = self._inertia = _shifted_inertia(inertia, -mass, self.center, ZERO)
        # With a = (f - sum F_j qdd_j) / m + c x alpha eliminated, rows and columns are (alpha, qdd):
        # [J_c, T; T', H - F' F / m], F and T the columns' forces and torques about the center of mass.
        axes, n = self._axes, len(columns)
        reduced: list[list[Scalar]] = [[0.0] * (len(axes) + n) for _ in range(len(axes) + n)]
        for row, axis in enumerate(axes):
            for column, other in enumerate(axes):
                reduced[row][column] = about_center[axis][other]
            for j in range(n):
                reduced[row][len(axes) + j] = reduced[len(axes) + j][row] = self._torques[j][axis]
        for i in range(n):
            for j in range(i, n):
                entry = joint_block[i][j] - dot(self._forces[i], self._forces[j]) * (1.0 / mass)
                reduced[len(axes) + i][len(axes) + j] = reduced[len(axes) + j][len(axes) + i] = entry
        self._reduced = reduced
        self._factor = factorize_ldl(reduced)

    def accelerations(
        self, wrenches: Sequence[tuple[Vector3, Vector3]], joints: Sequence[Scalar]
    ) -> Accelerations:
        """See `forward.Inertia`."""
        total = passed_to_base(self._tree, self._frames, wrenches)
        both = [own + other for own, other in zip(joints, total.joints, strict=True)]
        return self.solve(total.force, total.torque, both)

    def solve(self, force: Vector3, torque: Vector3, joints: Sequence[Scalar]) -> Accelerations:
        """See `forward.Inertia`."""
        inverse_mass = 1.0 / self._mass
        about_center = subtract(torque, cross(self.center, force))
        right = [about_center[axis] for axis in self._axes]
        right += [
            tau - dot(column, force) * inverse_mass for tau, column in zip(joints, self._forces, strict=True)
        ]
        solution = solve_ldl(self._factor, right)
        angular: list[Scalar] = [0.0, 0.0, 0.0]
        for axis, value in zip(self._axes, solution, strict=False):
            angular[axis] = value
        rates = solution[len(self._axes) :]
        # a = f / m + c x alpha - sum F_j qdd_j / m.
        linear = add(scale(inverse_mass, force), cross(self.center, angular))
        for column, rate in zip(self._forces, rates, strict=True):
            linear = subtract(linear, scale(rate * inverse_mass, column))
        return Accelerations(angular, linear, rates)

    def canonical_momenta(
        self, angular_velocity: Vector3, joint_rates: Sequence[Scalar]
    ) -> tuple[Vector3, list[Scalar]]:
        """Angular momentum about the center of mass, base axes, 3, and the joints' momenta dT/d(rates), n."""
        count, velocities = len(self._axes), [*(angular_velocity[axis] for axis in self._axes), *joint_rates]
        products = []
        for row in self._reduced:
            value: Scalar = 0.0
            for entry, velocity in zip(row, velocities, strict=True):
                value = value + entry * velocity
            products.append(value)
        angular: list[Scalar] = [0.0, 0.0, 0.0]
        for axis, value in zip(self._axes, products, strict=False):
            angular[axis] = value
        return angular, products[count:]

    def velocities(self, angular: Vector3, joint_momenta: Sequence[Scalar]) -> Accelerations:
        """Angular velocity and joint rates for given momenta: the inverse of `canonical_momenta`."""
        return self.solve(ZERO, angular, joint_momenta)

    def _locked_factor(self) -> LDLFactor:
        """Factors of the locked inertia, the leading block of the factorized matrix."""
        n = len(self._axes)
        return LDLFactor(self._factor.lower[:n], self._factor.inverse_diagonal[:n])

    def momentum(
        self, angular_velocity: Vector3, velocity: Vector3, joint_rates: Sequence[Scalar]
    ) -> tuple[Vector3, Vector3]:
        """Linear momentum and angular momentum about the system's center of mass, base axes, 3 each."""
        # p = m (v + omega x c) + sum F_j qd_j, L_c = J_c omega + sum T_j qd_j.
        linear = scale(self._mass, add(velocity, cross(angular_velocity, self.center)))
        angular: Vector3 = matrix_vector(self._inertia, angular_velocity)
        for force, torque, rate in zip(self._forces, self._torques, joint_rates, strict=True):
            linear = add(linear, scale(rate, force))
            angular = add(angular, scale(rate, torque))
        return linear, angular

    def base_velocity(
        self, linear: Vector3, angular: Vector3, joint_rates: Sequence[Scalar]
    ) -> tuple[Vector3, Vector3]:
        """Angular and linear velocity of the base for a given momentum: the inverse of `momentum`.

        About the center of mass, the angular momentum involves the angular velocity and the joint rates only.
        """
        for force, torque, rate in zip(self._forces, self._torques, joint_rates, strict=True):
            linear = subtract(linear, scale(rate, force))
            angular = subtract(angular, scale(rate, torque))
        omega: list[Scalar] = [0.0, 0.0, 0.0]
        solution = solve_ldl(self._locked_factor(), [angular[axis] for axis in self._axes])
        for axis, value in zip(self._axes, solution, strict=True):
            omega[axis] = value
        # Divided: a reciprocal's rounding would be the same at every step.
        return omega, subtract([entry / self._mass for entry in linear], cross(omega, self.center))


def mass_matrix(tree: KinematicTree, frames: Sequence[LinkFrame]) -> list[list[Scalar]]:
    """The mass matrix by (angular, linear, joints), the base's about the origin of its frame, (6 + n, 6 + n).

    [J, [d]x, T; [d]x', m E, F; T', F', H] with the first moment d of all bodies and the joints' columns T, F.
    """
    mass, moment, inertia, columns, joint_block = _composite_bodies(tree, frames)
    n = len(columns)
    result: list[list[Scalar]] = [[0.0] * (6 + n) for _ in range(6 + n)]
    for i in range(3):
        unit = [1.0 if j == i else 0.0 for j in range(3)]
        lever = cross(moment, unit)  # torque per unit of linear acceleration
        for j in range(3):
            result[i][j] = inertia[i][j]
            result[j][3 + i] = result[3 + i][j] = lever[j]
        result[3 + i][3 + i] = mass
    for i, (force, torque) in enumerate(columns):
        for j, entry in enumerate((*torque, *force)):
            result[6 + i][j] = result[j][6 + i] = entry
        result[6 + i][6:] = joint_block[i]
    return result


def _shifted_inertia(inertia: Sequence[Vector3], mass: Scalar, p: Vector3, d: Vector3) -> list[list[Scalar]]:
    """Add mass (p.p E - p p') + 2 p.d E - p d' - d p': parallel axes for a shift p and first moment d."""
    trace = mass * dot(p, p) + 2.0 * dot(p, d)
    result: list[list[Scalar]] = [[0.0] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            entry = inertia[i][j] - (mass * (p[i] * p[j]) + p[i] * d[j] + d[i] * p[j])
            result[i][j] = result[j][i] = entry + trace if i == j else entry
    return result


def _rotated_inertia(rotation: Sequence[Vector3], inertia: Sequence[Vector3]) -> list[list[Scalar]]:
    """R I R', computed once above the diagonal."""
    half = [matrix_vector(inertia, row) for row in rotation]
    result: list[list[Scalar]] = [[0.0] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            result[i][j] = result[j][i] = dot(rotation[i], half[j])
    return result


def _wrench_along(
    screw: Screw, mass: Scalar, moment: Vector3, inertia: Sequence[Vector3]
) -> tuple[Vector3, Vector3]:
    """Force and torque per acceleration along a screw, of a body with a first moment and an inertia."""
    turn, slide = screw
    force: Vector3 = (-moment[1], moment[0], 0.0)
    torque: Vector3 = (inertia[0][2], inertia[1][2], inertia[2][2])
    if slide:
        force = add(scale(turn, force), (0.0, 0.0, slide * mass))
        torque = add(scale(turn, torque), (slide * moment[1], -slide * moment[0], 0.0))
    return force, torque


def _composite_bodies(
    tree: KinematicTree, frames: Sequence[LinkFrame]
) -> tuple[Scalar, Vector3, Sequence[Vector3], list[tuple[Vector3, Vector3]], list[list[Scalar]]]:
    """Composite mass, first moment, inertia at the base; each joint's column (force, torque); joint block."""

    def about_origin(body: RigidBody) -> tuple[Scalar, Vector3, Sequence[Vector3]]:
        c = body.center_of_mass
        inertia: Matrix | list[list[Scalar]] = _shifted_inertia(body.inertia, body.mass, c, ZERO)
        return body.mass, scale(body.mass, c), inertia

    n = len(tree.links)
    composite = [about_origin(body) for body in tree.bodies]
    columns: list[tuple[Vector3, Vector3]] = []
    block: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    for i, parent in reversed([*enumerate(tree.parents)]):
        # A unit acceleration of joint i needs this wrench on the composite body beyond it.
        mass, moment, inertia = composite[i + 1]
        column = _wrench_along(tree.links[i].screw, mass, moment, inertia)
        block[i][i] = along(tree.links[i].screw, *column)
        rotor = tree.links[i].rotor
        if rotor is not None:
            block[i][i] = block[i][i] + rotor.reflected
        if rotor is not None and rotor.exact:  # carried by the body before the joint, about the joint's axis
            force, torque = column
            column = force, (*torque[:2], torque[2] + rotor.inertia * rotor.gear)
            inertia = [*inertia[:2], (*inertia[2][:2], inertia[2][2] + rotor.inertia)]
        carried = i
        for ancestor in reversed(tree.path_to(parent)):
            column = shift_wrench(*frames[carried], *column)
            block[ancestor][i] = block[i][ancestor] = along(tree.links[ancestor].screw, *column)
            carried = ancestor
        columns.insert(0, shift_wrench(*frames[carried], *column))
        rotation, p = frames[i]
        rotated_moment = matrix_vector(rotation, moment)
        shifted = _shifted_inertia(_rotated_inertia(rotation, inertia), mass, p, rotated_moment)
        parent_mass, parent_moment, parent_inertia = composite[parent]
        composite[parent] = (
            parent_mass + mass,
            add(parent_moment, add(rotated_moment, scale(mass, p))),
            [list(add(row, other)) for row, other in zip(parent_inertia, shifted, strict=True)],
        )
    return *composite[0], columns, block
