"""Forward dynamics: accelerations and reactions from everything that acts on the robot.

Accelerations come by a choice of formulations, reactions by articulated bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from dq_space_arm_env.algebra.vectors import subtract
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import ZERO, Accelerations, LinkFrame, body_wrenches

Scalar = Any
Vector3 = Sequence[Scalar]
Wrench = tuple[Vector3, Vector3]


class Inertia(Protocol):
    """Response to forces of a robot at rest, at given joint angles."""

    def accelerations(self, wrenches: Sequence[Wrench], joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations from wrenches on base and links and from joint torques [N m], without velocity terms.

        Each of the n + 1 wrenches is a force [N] and a torque [N m] about the origin of the body's frame, in
        its axes.
        """
        ...

    def solve(self, force: Vector3, torque: Vector3, joints: Sequence[Scalar]) -> Accelerations:
        """Accelerations from generalized forces: M^-1 (force, torque, joints), the base's in base axes."""
        ...


def inertia_of(
    formulation: str, tree: KinematicTree, frames: Sequence[LinkFrame], *, many: bool = False
) -> Inertia:
    """Inertia in the scene's formulation; `many`: for many right-hand sides, as derivatives have."""
    if formulation == "minimal_coordinates":
        return MassMatrix(tree, frames)
    if formulation != "articulated_body":
        raise ValueError(
            f"formulation: {formulation!r} is unknown; it must be articulated_body or minimal_coordinates"
        )
    root = tree.heaviest
    first = tree.links[0].spherical is None if tree.links else False
    if root == 0 and first and (tree.planar or not many) and not tree.heavy_base:
        # The first link is as good a root, and a faster one but for many right-hand sides in space.
        root = 1
    return ArticulatedBodies(tree, frames, root)


def forward_dynamics(
    tree: KinematicTree,
    inertia: Inertia,
    frames: Sequence[LinkFrame],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acting: Sequence[Wrench],
    joints: Sequence[Scalar],
) -> Accelerations:
    """Accelerations of a motion under external wrenches (as in `Inertia.accelerations`) and joint torques."""
    return inertia.accelerations(*_left(tree, frames, angular_velocity, joint_rates, acting, joints))


def reaction_wrenches(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acting: Sequence[Wrench],
    joints: Sequence[Scalar],
) -> list[Wrench]:
    """Wrench that each joint transmits to its link, in joint axes, under the same as `forward_dynamics`.

    Rooted at the heaviest body, whatever the masses: a light base may accelerate a million times faster than
    the link that drives it, and the link's acceleration would be their difference.
    """
    left = _left(tree, frames, angular_velocity, joint_rates, acting, joints)
    return ArticulatedBodies(tree, frames, tree.heaviest).reactions(*left)


def _left(
    tree: KinematicTree,
    frames: Sequence[LinkFrame],
    angular_velocity: Vector3,
    joint_rates: Sequence[Scalar],
    acting: Sequence[Wrench],
    joints: Sequence[Scalar],
) -> tuple[list[Wrench], list[Scalar]]:
    """External wrenches and joint torques, less those that the motion needs at zero acceleration.

    Wrenches are subtracted body by body: summed over the tree, what acts on a light body would drown in what
    a heavy one needs.
    """
    rest = Accelerations(ZERO, ZERO, [0.0] * len(tree.links))
    needed, rotors = body_wrenches(tree, frames, angular_velocity, joint_rates, rest)
    return (
        [(subtract(a[0], b[0]), subtract(a[1], b[1])) for a, b in zip(acting, needed, strict=True)],
        [torque - rotor for torque, rotor in zip(joints, rotors, strict=True)],
    )
