"""Mass properties of rigid bodies: in another frame, and lumped into one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Body:
    """Mass properties of a rigid body in some frame."""

    mass: float  # Mass, kg, greater than 0
    center_of_mass: Array  # Center of mass, shape (3,), m
    inertia: Array  # Inertia about the center of mass, axes of the frame, shape (3, 3), kg m^2

    def seen_from(self, pose: Sequence[float]) -> Body:
        """The body in the frame in which its own frame has pose q_{own/other}, 8 numbers, m."""
        matrix, position = (np.array(part) for part in poses.to_matrix(tuple(pose)))
        return Body(self.mass, position + matrix @ self.center_of_mass, matrix @ self.inertia @ matrix.T)


def lumped(bodies: Sequence[Body]) -> Body | None:
    """Lump bodies in one frame together, by the parallel axis theorem; None for none."""
    if len(bodies) < 2:
        return bodies[0] if bodies else None
    mass = sum(body.mass for body in bodies)
    center = sum((body.mass * body.center_of_mass for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        d = body.center_of_mass - center
        inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Body(mass, center, 0.5 * (inertia + inertia.T))


def balanced(inertia: Array) -> Array:
    """Raise the smallest principal moment until it and the middle one add up to the largest."""
    moments, axes = np.linalg.eigh(inertia)
    moments[0] = max(moments[0], moments[2] - moments[1])
    mended: Array = axes @ np.diag(moments) @ axes.T
    return 0.5 * (mended + mended.T)


def tidied(numbers: Array) -> Array:
    """Round to 15 digits of the largest number, against residues of rotations and translations."""
    largest = float(np.abs(numbers).max())
    if not 0.0 < largest < math.inf:
        return numbers
    # NumPy multiplies by this power of ten, which must be finite.
    return np.round(numbers, min(15 - math.ceil(math.log10(largest)), 300))
