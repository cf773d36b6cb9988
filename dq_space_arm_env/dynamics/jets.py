"""Thrusters on the base: their net force and torque."""

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


def net_wrench(jets: Sequence[Jet], forces: Sequence[Scalar]) -> tuple[Vector3, Vector3]:
    """Force [N] and torque [N m] of thrusters with given forces [N], base axes: sum b f, sum (p x b) f."""
    force: Vector3 = (0.0, 0.0, 0.0)
    torque: Vector3 = (0.0, 0.0, 0.0)
    for jet, size in zip(jets, forces, strict=True):
        force, torque = add(force, scale(size, jet.force)), add(torque, scale(size, jet.torque))
    return force, torque
