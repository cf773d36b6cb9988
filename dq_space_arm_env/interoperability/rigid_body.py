"""Mass properties of rigid bodies in numbers: seen from another frame, and lumped into one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses

Array = NDArray[np.float64]

# As fractions of the largest moment; what a scene allows.
_TOLERANCE = 1e-9
_SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Body:
    """Mass properties of a rigid body in some frame.

    Attributes:
        mass: Mass, kg, greater than 0.
        center_of_mass: Center of mass, shape (3,), m.
        inertia: Inertia about the center of mass, axes of the frame, shape (3, 3), kg m^2.
    """

    mass: float
    center_of_mass: Array
    inertia: Array

    def seen_from(self, pose: Sequence[float]) -> Body:
        """The body in the frame in which its own has a given pose.

        Args:
            pose: Unit dual quaternion q_{own/other}, 8 numbers, m.

        Returns:
            Mass properties in the other frame.
        """
        matrix, position = (np.array(part) for part in poses.to_matrix(tuple(pose)))
        return Body(self.mass, position + matrix @ self.center_of_mass, matrix @ self.inertia @ matrix.T)


def lumped(bodies: Sequence[Body]) -> Body | None:
    """Bodies that move as one, by the parallel axis theorem.

    Args:
        bodies: Bodies in one frame.

    Returns:
        Their sum; None for no bodies.
    """
    if len(bodies) < 2:
        return bodies[0] if bodies else None
    mass = sum(body.mass for body in bodies)
    center = sum((body.mass * body.center_of_mass for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        d = body.center_of_mass - center
        inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Body(mass, center, 0.5 * (inertia + inertia.T))


def tidied(numbers: Array) -> Array:
    """Round away what turning and moving has left behind the digits that were given.

    Args:
        numbers: Any numbers of one kind, as the entries of an inertia.

    Returns:
        The same, to 15 decimals of the largest.
    """
    largest = float(np.abs(numbers).max())
    return np.round(numbers, 15 - math.ceil(math.log10(largest))) if 0.0 < largest < math.inf else numbers


def flaw_of(inertia: Array, *, rods: bool) -> str:
    """Say why no rigid body has an inertia.

    Args:
        inertia: Inertia about the center of mass, shape (3, 3), kg m^2.
        rods: Whether a moment may be 0, as that of a point or a thin rod: what it is fixed to may have one.

    Returns:
        Its principal moments and what is wrong with them; empty if nothing is.
    """
    least, middle, largest = np.linalg.eigvalsh(inertia)
    size = float(np.abs(inertia).max())
    moments = f"principal moments {least:.6g}, {middle:.6g}, {largest:.6g} kg m^2"
    if least < -_TOLERANCE * size or (not rods and least <= _SINGULAR * size):
        return f"{moments}, all must be {'0 or greater' if rods else 'greater than 0'}"
    if least + middle < largest * (1 - _TOLERANCE):
        return f"{moments}, of which the two smaller must add up to at least the largest"
    return ""
