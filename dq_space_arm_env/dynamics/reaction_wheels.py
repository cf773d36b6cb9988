"""Balanced reaction wheels in the base: momentum, gyroscopic torque, energy.

A wheel with axis g and axial inertia J turns relative to the base at the rate Omega. Its axial momentum

    h = J (Omega + g . omega),  h' = u,

changes by the motor's torque u alone. Locked wheels are part of the base's inertia I; free ones leave it
I* = I - sum J g g', and the base feels - sum g u - omega x sum g h.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.algebra.vectors import add, cross, dot, scale

Scalar = Any
Vector3 = Sequence[Scalar]
ZERO = (0.0, 0.0, 0.0)


class Wheel(NamedTuple):
    """A balanced rotor in the base."""

    axis: tuple[float, float, float]  # unit vector, base axes
    inertia: float  # about the axis, kg m^2


def free_inertia(
    inertia: Sequence[Sequence[Scalar]], wheels: Sequence[Wheel]
) -> tuple[tuple[Scalar, ...], ...]:
    """Inertia of the base, I*, in which the wheels turn freely about their axes, 3x3, kg m^2."""
    rows = [list(row) for row in inertia]
    for g, axial in wheels:
        for i in range(3):
            for j in range(3):
                if g[i] and g[j]:
                    rows[i][j] = rows[i][j] - axial * (g[i] * g[j])
    return tuple(map(tuple, rows))


def along_axes(wheels: Sequence[Wheel], values: Sequence[Scalar]) -> Vector3:
    """Sum of g v over the wheels, base axes: of momenta [N m s], or of torques [N m]."""
    total: Vector3 = ZERO
    for wheel, value in zip(wheels, values, strict=True):
        total = add(total, scale(value, wheel.axis))
    return total


def speeds(wheels: Sequence[Wheel], momenta: Sequence[Scalar], angular: Vector3) -> list[Scalar]:
    """Rates Omega = h / J - g . omega relative to the base, rad/s."""
    return [
        h * (1.0 / wheel.inertia) - dot(wheel.axis, angular) for wheel, h in zip(wheels, momenta, strict=True)
    ]


def torque_on_base(
    wheels: Sequence[Wheel], torques: Sequence[Scalar], momenta: Sequence[Scalar], angular: Vector3
) -> Vector3:
    """Reaction to the motors (none are given: zero torques) and gyroscopic torque, base axes, N m."""
    gyroscopic = cross(along_axes(wheels, momenta), angular)
    return add(gyroscopic, along_axes(wheels, [-u for u in torques])) if torques else gyroscopic


def energy(wheels: Sequence[Wheel], momenta: Sequence[Scalar]) -> Scalar:
    """Kinetic energy sum h^2 / 2 J besides that of the base with I*, J."""
    return sum((h * h * (0.5 / wheel.inertia) for wheel, h in zip(wheels, momenta, strict=True)), 0.0)
