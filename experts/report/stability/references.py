"""Forward dynamics with 50 digits: an independent formulation, and how far accelerations are from solving it.

The mass matrix and the bias forces are those of Kane's equations, each body's Newton-Euler equation projected
on the Jacobian of its motion. No recursion and no elimination is shared with the code under test.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mpmath
import numpy as np
from mpmath import mpf

from dq_space_arm_env.dynamics.chain import Chain, RevoluteLink
from experts.problem import FloatArray

DIGITS = 50

Matrix = Any  # an mpmath matrix
Vector = Any  # an mpmath matrix with one column


class Motion(NamedTuple):
    """A state and its inputs, as far as accelerations depend on them.

    Attributes:
        joint_angles: Shape (n,), rad.
        angular: Angular velocity of the base, base axes, shape (3,), rad/s.
        linear: Velocity of the base, base axes, shape (3,), m/s.
        joint_rates: Shape (n,), rad/s.
        force: On the base, base axes, shape (3,), N.
        torque: On the base, base axes, shape (3,), N m.
        joint_torques: Of the motors, shape (n,), N m.
    """

    joint_angles: FloatArray
    angular: FloatArray
    linear: FloatArray
    joint_rates: FloatArray
    force: FloatArray
    torque: FloatArray
    joint_torques: FloatArray


class LinearSystem(NamedTuple):
    """M a = f for the accelerations a: angular and inertial linear one of the base, joints.

    Attributes:
        mass_matrix: M, (6 + n, 6 + n).
        right: f, 6 + n.
        sizes: Sum of the magnitudes of the terms that f consists of, 6 + n.
    """

    mass_matrix: Matrix
    right: Vector
    sizes: Vector


def column(values: Sequence[Any] | FloatArray) -> Vector:
    """A vector of exact numbers.

    Args:
        values: n numbers.

    Returns:
        The same, with 50 digits.
    """
    return mpmath.matrix([mpf(value) for value in values])


def _square(rows: Sequence[Sequence[Any]]) -> Matrix:
    return mpmath.matrix([[mpf(entry) for entry in row] for row in rows])


def _skew(v: Vector) -> Matrix:
    return mpmath.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _cross(a: Vector, b: Vector) -> Vector:
    return _skew(a) * b


def _turned(link: RevoluteLink, angle: float) -> Matrix:
    c, s = mpmath.cos(mpf(angle)), mpmath.sin(mpf(angle))
    return _square(link.joint.rotation) * mpmath.matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def linear_system(chain: Chain, motion: Motion) -> LinearSystem:
    """Assemble Kane's equations, all vectors in base axes.

    Args:
        chain: The robot; its base moves in space, nothing acts on its tip.
        motion: State and inputs.

    Returns:
        The system, with 50 digits.
    """
    with mpmath.workdps(DIGITS):
        return _linear_system(chain, motion)


def _linear_system(chain: Chain, motion: Motion) -> LinearSystem:
    n = len(chain.links)
    size = 6 + n
    omega, alpha, a = column(motion.angular), mpmath.zeros(3, 1), mpmath.zeros(3, 1)
    rotation, origin = mpmath.eye(3), mpmath.zeros(3, 1)
    axes: list[Vector] = []
    origins: list[Vector] = []
    mass_matrix, bias, sizes = mpmath.zeros(size), mpmath.zeros(size, 1), mpmath.zeros(size, 1)
    for index in range(n + 1):
        body = chain.base if index == 0 else chain.links[index - 1].body
        if index:
            link = chain.links[index - 1]
            arm = rotation * column(link.joint.position)
            a = a + _cross(alpha, arm) + _cross(omega, _cross(omega, arm))
            origin = origin + arm
            rotation = rotation * _turned(link, motion.joint_angles[index - 1])
            axis = rotation[:, 2]
            rate = mpf(motion.joint_rates[index - 1])
            alpha = alpha + _cross(omega, axis) * rate
            omega = omega + axis * rate
            axes.append(axis)
            origins.append(origin)
        lever = rotation * column(body.center_of_mass)
        center = origin + lever
        turning, moving = mpmath.zeros(3, size), mpmath.zeros(3, size)
        turning[:, 0:3], moving[:, 0:3], moving[:, 3:6] = mpmath.eye(3), -_skew(center), mpmath.eye(3)
        for j, (axis, where) in enumerate(zip(axes, origins, strict=True)):
            turning[:, 6 + j], moving[:, 6 + j] = axis, _cross(axis, center - where)
        mass = mpf(body.mass)
        inertia = rotation * _square(body.inertia) * rotation.T
        force = mass * (a + _cross(alpha, lever) + _cross(omega, _cross(omega, lever)))
        torque = inertia * alpha + _cross(omega, inertia * omega)
        spinning = _absolute(_skew(omega))
        force_size = mass * (_absolute(a) + _absolute(_skew(alpha)) * _absolute(lever))
        force_size += mass * (spinning * (spinning * _absolute(lever)))
        torque_size = _absolute(inertia) * _absolute(alpha)
        torque_size += spinning * (_absolute(inertia) * _absolute(omega))
        mass_matrix += mass * (moving.T * moving) + turning.T * inertia * turning
        bias += moving.T * force + turning.T * torque
        sizes += _absolute(moving.T) * force_size + _absolute(turning.T) * torque_size
    passive = [
        -mpf(link.stiffness) * (mpf(angle) - mpf(link.rest_angle)) - mpf(link.damping) * mpf(rate)
        for link, angle, rate in zip(chain.links, motion.joint_angles, motion.joint_rates, strict=True)
    ]
    motors = [mpf(value) + other for value, other in zip(motion.joint_torques, passive, strict=True)]
    applied = column([*motion.torque, *motion.force, *motors])
    return LinearSystem(mass_matrix, applied - bias, sizes + _absolute(applied))


def _absolute(matrix: Matrix) -> Matrix:
    return matrix.apply(abs)


def accelerations(system: LinearSystem, motion: Motion) -> FloatArray:
    """Solve a system with 50 digits.

    Args:
        system: From `linear_system`.
        motion: State and inputs.

    Returns:
        Dual acceleration of the base, angular [rad/s^2] then linear [m/s^2], joint accelerations [rad/s^2],
        shape (6 + n,), rounded.
    """
    with mpmath.workdps(DIGITS):
        solution = mpmath.lu_solve(system.mass_matrix, system.right)
        turning = _cross(column(motion.angular), column(motion.linear))
        for axis in range(3):
            solution[3 + axis] -= turning[axis]
        return np.array([float(value) for value in solution])


class Errors(NamedTuple):
    """How wrong accelerations are.

    Attributes:
        backward: |M a - f| / (|M| |a| + |f|), infinity norms, dimensionless.
        by_row: The largest quotient of an entry of M a - f and of |M| |a| + |f| with magnitudes of entries
            (Oettli & Prager), dimensionless; f counts with the magnitudes of its terms, and so does the
            acceleration of the base, a dual one plus the turning of its axes.
        forward: Largest error of an acceleration, relative to the largest acceleration, dimensionless.
    """

    backward: float
    by_row: float
    forward: float


def errors(system: LinearSystem, motion: Motion, found: FloatArray) -> Errors:
    """Judge accelerations.

    Args:
        system: From `linear_system`.
        motion: State and inputs.
        found: Dual acceleration of the base and joint accelerations, shape (6 + n,), rad/s^2 and m/s^2.

    Returns:
        Their errors.
    """
    exact = accelerations(system, motion)
    with mpmath.workdps(DIGITS):
        matrix, size = system.mass_matrix, len(found)
        a = column(found)
        turning = _cross(column(motion.angular), column(motion.linear))
        for axis in range(3):
            a[3 + axis] += turning[axis]
        residual = matrix * a - system.right
        scale = mpmath.mnorm(matrix, mpmath.inf) * mpmath.norm(a, mpmath.inf)
        scale += mpmath.norm(system.right, mpmath.inf)
        terms = _absolute(a)
        for axis in range(3):
            terms[3 + axis] = abs(mpf(found[3 + axis])) + abs(turning[axis])
        sizes = _absolute(matrix) * terms + system.sizes
        backward = float(mpmath.norm(residual, mpmath.inf) / scale) if scale else 0.0
        by_row = max(float(abs(residual[i]) / sizes[i]) if sizes[i] else 0.0 for i in range(size))
    largest = float(np.abs(exact).max())
    forward = float(np.abs(found - exact).max()) / largest if largest else 0.0
    return Errors(backward, by_row, forward)
