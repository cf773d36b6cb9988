"""From the tree of a URDF to a free base with a chain of revolute joints: what a scene can be made of.

The chain runs from the base link to the tip link. What hangs on it by fixed joints is lumped into the body
that carries it. Joints are turned about so that their axis is z, and the base's frame is moved to its center
of mass, as a scene has them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.algebra.quaternion import normalize
from dq_space_arm_env.interoperability.rigid_body import Array, Body, flaw_of, lumped
from dq_space_arm_env.interoperability.urdf_elements import MOVABLE, Pose, UrdfJoint, UrdfRobot
from dq_space_arm_env.scene import SceneError
from dq_space_arm_env.validation import did_you_mean

_HERE: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_MANY = 60


@dataclass(frozen=True, eq=False)
class ArmJoint:
    """A joint of the chain, and the body that it carries.

    Attributes:
        joint: The joint as the file has it.
        pose: Pose of the joint's frame, z along the axis, in the frame before, 8 numbers, m.
        body: The body that turns with it, in the joint's frame.
    """

    joint: UrdfJoint
    pose: Pose
    body: Body


@dataclass(frozen=True, eq=False)
class Arm:
    """A free base with a chain of revolute joints.

    Attributes:
        base: The base in its frame e0, whose origin is its center of mass and whose axes are the base link's.
        base_link: Name of the base link.
        base_center: Origin of e0 in the base link's frame, shape (3,), m.
        joints: Joints from base to tip.
        tip: Pose of the tip link's frame in the last joint's frame, 8 numbers, m.
        flaws: Of links whose inertia no rigid body has, though the body that they are part of has one.
    """

    base: Body
    base_link: str
    base_center: Array
    joints: tuple[ArmJoint, ...]
    tip: Pose
    flaws: tuple[str, ...]


class UrdfTree:
    """The links of a robot and what connects them."""

    def __init__(self, robot: UrdfRobot) -> None:
        """Check that the joints connect the links into one tree.

        Args:
            robot: The robot.

        Raises:
            SceneError: If they do not.
        """
        self.robot = robot
        self._above: dict[str, UrdfJoint] = {}
        self._joints_at: dict[str, list[UrdfJoint]] = {name: [] for name in robot.links}
        for joint in robot.joints.values():
            if joint.parent == joint.child:
                raise SceneError(f"URDF: joint {joint.name!r} connects link {joint.child!r} with itself")
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in robot.links:
                    raise SceneError(
                        f"URDF: joint {joint.name!r}: its {role} link {link!r} does not exist; "
                        f"{did_you_mean(link, robot.links)}the links are {_some(robot.links)}"
                    )
                self._joints_at[link].append(joint)
            other = self._above.setdefault(joint.child, joint)
            if other is not joint:
                raise SceneError(
                    f"URDF: link {joint.child!r} hangs on two joints, {other.name!r} and {joint.name!r}: "
                    "a closed loop, which a scene cannot hold"
                )
        roots = [name for name in robot.links if name not in self._above]
        if len(roots) != 1:
            found = "there are several" if roots else "the joints form a loop"
            found += f": {_some(roots or self.robot.joints)}"
            raise SceneError(f"URDF: exactly one link must be no joint's child, the root; {found}")
        self.root = roots[0]
        apart = set(robot.links) - set(self._below(self.root))
        for joint in robot.joints.values():
            if joint.child in apart:
                raise SceneError(f"URDF: joint {joint.name!r} is part of a loop of joints")

    def _below(self, link: str) -> Iterator[str]:
        """A link, and all that hangs on it."""
        waiting = [link]
        while waiting:
            here = waiting.pop()
            yield here
            waiting += [joint.child for joint in self._joints_at[here] if joint.parent == here]

    def _path(self, link: str) -> list[UrdfJoint]:
        """Joints from the root to a link."""
        path: list[UrdfJoint] = []
        while link != self.root:
            joint = self._above[link]
            path.append(joint)
            link = joint.parent
        return path[::-1]

    def _known(self, link: str, argument: str) -> None:
        if link in self.robot.links:
            return
        joint = self.robot.joints.get(link)
        hint = f"it is a joint, which carries link {joint.child!r}; " if joint else ""
        raise SceneError(
            f"{argument}: {link!r} is no link of {self.robot.name!r}; "
            f"{hint or did_you_mean(str(link), self.robot.links)}its links are {_some(self.robot.links)}"
        )

    def chain(self, tip: str, base: str) -> list[UrdfJoint]:
        """The movable joints between two links.

        Args:
            tip: Name of the last link.
            base: Name of the first link.

        Returns:
            The joints, base to tip.

        Raises:
            SceneError: If there is no such link, no movable joint, or one that no scene can hold.
        """
        self._known(tip, "tip")
        self._known(base, "base")
        up, down = self._path(base), self._path(tip)
        while up and down and up[0] is down[0]:
            del up[0], down[0]
        for joint in up:
            if joint.type != "fixed":
                raise SceneError(
                    f"tip: link {tip!r} does not hang on base {base!r}: joint {joint.name!r} carries the "
                    f"base and not the tip; choose link {joint.parent!r}, or one above it, as base"
                )
        if not down:
            raise SceneError(f"tip: link {tip!r} is the base: choose a link that the joints move")
        chain = [joint for joint in down if joint.type != "fixed"]
        if not chain:
            raise SceneError(f"tip: no joint moves link {tip!r} with respect to base {base!r}")
        for joint in chain:
            if joint.type not in MOVABLE:
                free = f": choose link {joint.child!r} as base" if joint.type == "floating" else ""
                raise SceneError(
                    f"URDF: joint {joint.name!r} on the way to link {tip!r} is {joint.type}; a scene has "
                    f"{', '.join(MOVABLE)} and fixed joints only{free}"
                )
            if joint.mimics is not None:
                raise SceneError(
                    f"URDF: joint {joint.name!r} on the way to link {tip!r} mimics joint {joint.mimics!r}; "
                    "in a scene every joint moves by itself"
                )
        return chain

    def carried(self, link: str, pose: Pose, chain: list[UrdfJoint], lock_branches: bool) -> dict[str, Pose]:
        """Everything that moves as one with a link.

        Args:
            link: Name of the link.
            pose: Its pose in some frame, 8 numbers, m.
            chain: The joints of the chain; they are not crossed.
            lock_branches: Whether other movable joints are held at zero.

        Returns:
            Poses of the links in that frame, by name.

        Raises:
            SceneError: If a movable joint that is not held, or that follows the chain, moves a mass.
        """
        found = {link: pose}
        waiting = [link]
        while waiting:
            here = waiting.pop()
            for joint in self._joints_at[here]:
                down = joint.parent == here
                there = joint.child if down else joint.parent
                if there in found or joint in chain:
                    continue
                if joint.type != "fixed":
                    if not self._has_mass_beyond(joint, here):
                        continue
                    self._check_branch(joint, chain, lock_branches)
                step = joint.origin if down else dual_quaternion.conjugate(joint.origin)
                found[there] = dual_quaternion.multiply(found[here], step)
                waiting.append(there)
        return found

    def _has_mass_beyond(self, joint: UrdfJoint, link: str) -> bool:
        return any(self.robot.links[name].body is not None for name in self._beyond(joint, link))

    def _beyond(self, joint: UrdfJoint, link: str) -> Iterator[str]:
        """Names of the links on the far side of a joint."""
        waiting = [(joint, joint.child if joint.parent == link else joint.parent)]
        while waiting:
            crossed, here = waiting.pop()
            yield here
            for other in self._joints_at[here]:
                if other is not crossed:
                    waiting.append((other, other.child if other.parent == here else other.parent))

    def _check_branch(self, joint: UrdfJoint, chain: list[UrdfJoint], lock_branches: bool) -> None:
        if joint.mimics is not None and any(joint.mimics == other.name for other in chain):
            raise SceneError(
                f"URDF: joint {joint.name!r} mimics joint {joint.mimics!r} of the chain: in a scene every "
                "joint moves by itself"
            )
        if not lock_branches:
            raise SceneError(
                f"URDF: joint {joint.name!r} ({joint.type}) moves a mass beside the chain from base to tip; "
                "a scene has no branches: lock_branches=True holds such joints at zero"
            )


def arm_of(robot: UrdfRobot, tip: str, base: str | None, lock_branches: bool, extra: Body | None) -> Arm:
    """Cut the chain from base to tip out of a robot.

    Args:
        robot: The robot.
        tip: Name of the tip link.
        base: Name of the base link; None for the root.
        lock_branches: Whether movable joints beside the chain are held at zero.
        extra: A body fixed to the base link, in its frame.

    Returns:
        The arm.

    Raises:
        SceneError: If the robot is no tree, or no scene can hold the chain.
    """
    tree = UrdfTree(robot)
    base = tree.root if base is None else base
    chain = tree.chain(tip, base)
    placed = tree.carried(base, _HERE, chain, lock_branches)
    bodies = [*_bodies(robot, placed), *([] if extra is None else [extra])]
    body = lumped(bodies)
    if body is None:
        raise SceneError(
            f"URDF: base link {base!r} has no mass, nor has anything fixed to it: an arm made to stand on "
            "the ground; give the spacecraft that carries it, spacecraft={'mass': ..., 'inertia': ...}"
        )
    flaws = _checked(robot, placed, body, base)
    center = body.center_of_mass
    to_center = poses.from_rotation_and_position((1.0, 0.0, 0.0, 0.0), tuple((-center).tolist()))
    placed = {name: dual_quaternion.multiply(to_center, pose) for name, pose in placed.items()}
    joints = []
    for joint in chain:
        turned = _turned_to(joint.axis)
        before = placed[joint.parent]
        pose = dual_quaternion.multiply(dual_quaternion.multiply(before, joint.origin), turned)
        placed = tree.carried(joint.child, dual_quaternion.conjugate(turned), chain, lock_branches)
        moved = lumped(_bodies(robot, placed))
        if moved is None:
            raise SceneError(
                f"URDF: link {joint.child!r}, moved by joint {joint.name!r}, has no mass, nor has anything "
                "fixed to it: its accelerations would be infinite; give it a mass and an inertia"
            )
        flaws += _checked(robot, placed, moved, joint.child)
        joints.append(ArmJoint(joint, pose, moved))
    at_center = Body(body.mass, np.zeros(3), body.inertia)
    return Arm(at_center, base, center, tuple(joints), placed[tip], tuple(flaws))


def _checked(robot: UrdfRobot, placed: dict[str, Pose], body: Body, link: str) -> list[str]:
    """Refuse what moves with a link if no scene can hold it; find flaws of its parts that others hide."""
    parts = {name: part for name in placed if (part := robot.links[name].body) is not None}
    flaws = [
        f"link {name!r}, <inertia>: {flaw}"
        for name, part in parts.items()
        if (flaw := flaw_of(part.inertia, rods=True))
    ]
    if flaw := flaw_of(body.inertia, rods=False):
        others = [name for name in parts if name != link]
        title = f"link {link!r}, with {_some(others)} fixed to it" if others else f"link {link!r}"
        of_parts = [f"; {part}" for part in flaws if others]
        raise SceneError(f"URDF: {title}, <inertia>: {flaw}{''.join(of_parts)}")
    return flaws


def _some(names: Collection[str]) -> str:
    """Names with commas between them, not more than a reader reads."""
    more = f" and {len(names) - _MANY} more" if len(names) > _MANY else ""
    return ", ".join(islice(names, _MANY)) + more


def _bodies(robot: UrdfRobot, placed: dict[str, Pose]) -> list[Body]:
    return [
        body.seen_from(pose) for name, pose in placed.items() if (body := robot.links[name].body) is not None
    ]


def _turned_to(axis: Array) -> Pose:
    """Rotation that takes z to an axis, as a pose without translation."""
    x, y, z = axis.tolist()
    # The shortest way from z; for an axis that points down, half a turn about x and the shortest way from -z.
    quaternion = (1.0 + z, -y, x, 0.0) if z >= 0 else (-y, 1.0 - z, 0.0, x)
    return poses.from_rotation_and_position(normalize(quaternion), (0.0, 0.0, 0.0))
