"""The joints of the paper's formulation: what each transmits, and what it forbids.

A dual vector has 8 slots, as in `newton_euler`. A spherical joint is a single one here: the massless bodies
that a `KinematicTree` has between its degrees of freedom have no equations of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.dynamics.kinematic_tree import JointedLink, KinematicTree, RigidBody

Scalar = Any

# E_158 keeps what a revolute joint can transmit, E_145 the velocities that it forbids (counted from zero).
TRANSMITTED, FORBIDDEN = (1, 2, 3, 5, 6), (1, 2, 5, 6, 7)
# A prismatic joint transmits a torque about its axis, and no force along it.
PRISMATIC_TRANSMITTED, PRISMATIC_FORBIDDEN = (1, 2, 5, 6, 7), (1, 2, 3, 5, 6)
# A spherical joint transmits a force alone, and forbids no turning.
SPHERICAL_TRANSMITTED, SPHERICAL_FORBIDDEN = (1, 2, 3), (5, 6, 7)


class Joint(NamedTuple):
    """A joint of the paper: a spherical one is a single one, without massless bodies."""

    link: JointedLink  # of its first degree of freedom
    first: int  # number of that
    parent: int  # number of the body before it, among those with mass
    body: RigidBody  # that it carries
    row: int  # of its first constraint in (20)

    @property
    def forbidden(self) -> tuple[int, ...]:
        """Velocities that it forbids; as many wrenches are transmitted."""
        if self.link.spherical is not None:
            return SPHERICAL_FORBIDDEN
        return FORBIDDEN if self.link.screw.turn else PRISMATIC_FORBIDDEN

    @property
    def free(self) -> tuple[int, ...]:
        """Entries of a dual velocity, or of a wrench's swap, along its degrees of freedom."""
        if self.link.spherical is not None:
            return (1, 2, 3)
        return (3,) if self.link.screw.turn else (7,)


def joints_of(tree: KinematicTree) -> list[Joint]:
    """The joints of a tree, base to tip."""
    found: list[Joint] = []
    numbers, row = [0], 0  # of the bodies with mass
    for index, link in enumerate(tree.links):
        if not link.spherical:
            last = index if link.spherical is None else index + 2
            found.append(Joint(link, index, numbers[link.parent], tree.links[last].body, row))
            row += len(found[-1].forbidden)
        numbers.append(len(found))
    return found


def bodies_of(tree: KinematicTree) -> list[RigidBody]:
    """Base and links, those with mass."""
    return [tree.base, *(joint.body for joint in joints_of(tree))]


def tip_body_of(tree: KinematicTree) -> int:
    """Number of the body that carries the tip among them."""
    return sum(1 for link in tree.links[: tree.tip_body] if not link.spherical)


def count_of_coordinates(tree: KinematicTree) -> int:
    """Number of the joints' coordinates."""
    return sum(1 if joint.link.spherical is None else 4 for joint in joints_of(tree))


def transmitted(joint: Joint, row: Sequence[Scalar]) -> list[Scalar]:
    """Combine a row's columns into those of the wrenches that a joint transmits."""
    if joint.link.spherical is not None:
        return [row[column] for column in SPHERICAL_TRANSMITTED]
    screw = joint.link.screw
    kept = [row[column] for column in (TRANSMITTED if screw.turn else PRISMATIC_TRANSMITTED)]
    if screw.turn and screw.slide:  # a force along the axis comes with a torque: no work along the screw
        kept[2] = kept[2] - screw.slide * row[7]
    return kept


def forbidden(joint: Joint, rows: Sequence[Sequence[Scalar]]) -> list[list[Scalar]]:
    """Combine the rows of a dual velocity into those of the velocities that a joint forbids."""
    screw = joint.link.screw
    kept = [list(rows[row]) for row in joint.forbidden]
    if screw.turn and screw.slide:
        kept[4] = [along - screw.slide * about for along, about in zip(rows[7], rows[3], strict=True)]
    return kept
