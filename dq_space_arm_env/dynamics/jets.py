"""Thrusters on the base: their net force and torque, and what they burn.

Propellant leaves its tank with the velocity that it has there, and the thrust is all that the gas gives to
the base: a robot with the mass that is left obeys M(m) a + bias = forces, m' = -sum F / (I_sp g0).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.algebra.vectors import add, scale

Scalar = Any
Vector3 = Sequence[Scalar]


class Jet(NamedTuple):
    """What a thruster does to the base per unit of its force."""

    force: tuple[float, float, float]  # unit vector, base axes
    torque: tuple[float, float, float]  # about the base's center of mass, base axes, m
    mass_flow: float = 0.0  # of the propellant that leaves, s/m


def net_wrench(jets: Sequence[Jet], forces: Sequence[Scalar]) -> tuple[Vector3, Vector3]:
    """Force [N] and torque [N m] of thrusters with given forces [N], base axes: sum b f, sum (p x b) f."""
    force: Vector3 = (0.0, 0.0, 0.0)
    torque: Vector3 = (0.0, 0.0, 0.0)
    for jet, size in zip(jets, forces, strict=True):
        force, torque = add(force, scale(size, jet.force)), add(torque, scale(size, jet.torque))
    return force, torque


def burnt(jets: Sequence[Jet], forces: Sequence[Scalar]) -> Scalar:
    """Propellant that thrusters with given forces [N] burn per time, kg/s."""
    total: Scalar = 0.0
    for jet, size in zip(jets, forces, strict=True):
        total = total + jet.mass_flow * size
    return total
