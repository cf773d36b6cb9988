"""From the tree of a URDF to a free base with joints that branch from it, as a scene has them.

A chain of joints runs from the base link to the tip link; others that move a mass branch from it, or are
locked. Fixed bodies are lumped into those that carry them. Joint frames are turned until z is the axis, and
the base frame moves to the center of mass.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NoReturn

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.algebra.quaternion import normalize
from dq_space_arm_env.dynamics.kinematic_tree import SCREWS
from dq_space_arm_env.dynamics.kinematics import joint_motion
from dq_space_arm_env.interoperability.rigid_body import Array, Body, balanced, lumped
from dq_space_arm_env.interoperability.urdf_elements import MOVABLE, UNLIMITED, Pose, UrdfJoint, UrdfRobot
from dq_space_arm_env.scene import SceneError
from dq_space_arm_env.scene.bodies import flaw_of
from dq_space_arm_env.validation import did_you_mean

HERE: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_MANY = 60
_MADE_UP_FOR = "it is used as it is: the bodies that the link is fixed to make up for it"


@dataclass(frozen=True, eq=False)
class ArmJoint:
    """A joint, and the body that it carries."""

    joint: UrdfJoint
    parent: int  # body that carries the joint: 0 for the base, i + 1 for that of joint i
    pose: Pose  # of the joint frame, z along the axis, in the frame of that body, 8 numbers, m
    body: Body  # in the joint frame


@dataclass(frozen=True, eq=False)
class Arm:
    """A free base with joints that branch from it."""

    base: Body  # in e0: origin at the center of mass, axes of the spacecraft or, without one, the base link
    base_link: str
    base_center: Array  # origin of e0 in the frame of the spacecraft or, without one, the base link, (3,), m
    joints: tuple[ArmJoint, ...]  # base to tip, then those of branches, each after its parent
    way: int  # number of joints from base to tip
    tip: Pose  # of the tip link in the frame of the last of these, 8 numbers, m
    flaws: tuple[str, ...]  # of the robot's inertias, with what was done about them


class UrdfTree:
    """Links and joints of a robot, checked to form one tree."""

    def __init__(self, robot: UrdfRobot) -> None:
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
        """A link, and all its descendants."""
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

    def ways(self, base: str | None) -> dict[str, list[UrdfJoint]]:
        """Joints from the base, by default the root, to each link above which it is."""
        base = self.root if base is None else base
        self._known(base, "base")
        before = len(self._path(base))
        return {link: self._path(link)[before:] for link in self._below(base)}

    def mimicked(self) -> set[str]:
        """Names of the joints that others, which move a mass, mimic."""
        joints = self.robot.joints.values()
        return {each.mimics for each in joints if each.mimics and self._has_mass_beyond(each, each.parent)}

    def _known(self, link: str, argument: str) -> None:
        is_name = isinstance(link, str)
        if is_name and link in self.robot.links:
            return
        joint = self.robot.joints.get(link) if is_name else None
        hint = f"it is a joint, which carries link {joint.child!r}; " if joint else ""
        raise SceneError(
            f"{argument}: {link!r} is not a link of {self.robot.name!r}; "
            f"{hint or did_you_mean(str(link), self.robot.links)}its links are {_some(self.robot.links)}"
        )

    def chain(self, tip: str, base: str) -> list[UrdfJoint]:
        """Movable joints between two links, base to tip."""
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
                beyond = joint.type == "floating" and joint is not chain[-1]
                free = f": choose link {joint.child!r} as base" if beyond else ""
                raise SceneError(
                    f"URDF: joint {joint.name!r} on the way to link {tip!r} is {joint.type}; a scene has "
                    f"{', '.join(MOVABLE)} and fixed joints only{free}"
                )
            if joint.mimics is not None:
                nearer = (
                    f": choose a tip before it, as link {joint.parent!r}" if joint is not chain[0] else ""
                )
                raise SceneError(
                    f"URDF: joint {joint.name!r} on the way to link {tip!r} mimics joint {joint.mimics!r}; "
                    f"in a scene every joint moves by itself{nearer}"
                )
        return chain

    def branches(
        self, base: str, chain: list[UrdfJoint], locked: Collection[str], motorless: Collection[str]
    ) -> list[UrdfJoint]:
        """Other joints that move a mass, each after those that carry it, but for the locked ones.

        The message about joints that a scene cannot have also names those without an effort, so that one
        more try is enough; those in `motorless` need none.
        """
        for name in locked:
            joints = self.robot.joints.values()
            known = [each.name for each in joints if each.type != "fixed" and each not in chain]
            if name not in known:
                there = f"these are {_some(known)}" if known else "there is none"
                raise SceneError(
                    f"lock_branches: {name!r} is not a movable joint beside the way from base to tip; "
                    f"{did_you_mean(str(name), known)}{there}"
                )
        rank = {name: index for index, name in enumerate(self.robot.joints)}
        found: list[UrdfJoint] = []
        refused: dict[str, str] = {}
        bodies = [base, *(joint.child for joint in chain)]
        for body in bodies:  # it grows
            at_body = self._hanging(body, [*chain, *found], locked)
            for joint in sorted(at_body, key=lambda each: rank[each.name]):
                if reason := self._unfit(joint, at_body[joint], chain):
                    refused[joint.name] = reason
                found.append(joint)
                bodies.append(joint.child if at_body[joint] else joint.parent)
        for name in locked:
            joint = self.robot.joints[name]
            follows = any(joint.mimics == each.name for each in found)
            if follows and self._has_mass_beyond(joint, joint.parent):
                refused[name] = f"mimics joint {joint.mimics!r}"
        if refused:
            self._refuse(refused, [*chain, *found], motorless)
        return found

    def _refuse(
        self, reasons: dict[str, str], moving: list[UrdfJoint], motorless: Collection[str]
    ) -> NoReturn:
        """Name all joints that a scene cannot have, and how to hold them."""
        held = [*reasons]
        for name in held:  # it grows: what is mimicked must not move either
            mimicked = self.robot.joints.get(self.robot.joints[name].mimics or "")
            if mimicked is not None and mimicked.type != "fixed" and mimicked.name not in held:
                held.append(mimicked.name)
        named = ", ".join(f"joint {name!r} {reason}" for name, reason in reasons.items())
        driven = [each for each in moving if each.name not in motorless and each.name not in held]
        missing = missing_efforts(driven)
        raise SceneError(
            f"URDF: beside the way from base to tip, where it moves a mass, {named}; in a scene every joint "
            f"moves by itself and is {', '.join(MOVABLE)} or fixed; lock_branches={held} holds such joints, "
            f"lock_branches=True all{missing and f'; {missing}'}"
        )

    def _hanging(self, body: str, moving: list[UrdfJoint], locked: Collection[str]) -> dict[UrdfJoint, bool]:
        """Other joints at a link and what is fixed to it that move a mass, each with whether it is below."""
        found: dict[UrdfJoint, bool] = {}
        reached, waiting = {body}, [body]
        while waiting:
            here = waiting.pop(0)
            for joint in self._joints_at[here]:
                down = joint.parent == here
                there = joint.child if down else joint.parent
                if there in reached or joint in moving:
                    continue
                if joint.type == "fixed" or joint.name in locked:
                    reached.add(there)
                    waiting.append(there)
                elif self._has_mass_beyond(joint, here):
                    found[joint] = down
        return found

    def carried(self, link: str, pose: Pose, moving: list[UrdfJoint]) -> dict[str, Pose]:
        """Poses of all links that move as one with a link; the given joints are not crossed."""
        found = {link: pose}
        waiting = [link]
        while waiting:
            here = waiting.pop()
            for joint in self._joints_at[here]:
                down = joint.parent == here
                there = joint.child if down else joint.parent
                if there in found or joint in moving:
                    continue
                if joint.type != "fixed":
                    if not self._has_mass_beyond(joint, here):
                        continue
                    self._check_locked(joint, moving)
                step = self._held(joint)
                found[there] = dual_quaternion.multiply(
                    found[here], step if down else dual_quaternion.conjugate(step)
                )
                waiting.append(there)
        return found

    def _held(self, joint: UrdfJoint) -> Pose:
        """Pose of a joint's child in its parent, fixed or locked."""
        coordinate = 0.0 if joint.type == "fixed" else self._locked_at(joint)
        if coordinate == 0.0:
            return joint.origin
        along = _turned_to(joint.axis)
        motion = joint_motion(SCREWS[joint.joint_type], coordinate)
        back = dual_quaternion.multiply(motion, dual_quaternion.conjugate(along))
        return dual_quaternion.multiply(joint.origin, dual_quaternion.multiply(along, back))

    def _locked_at(self, joint: UrdfJoint) -> float:
        """Coordinate of a locked joint: zero or its nearest limit, or what it mimics makes of that."""
        followed, ratio, offset = [joint], 1.0, 0.0
        while (leader := self.robot.joints.get(followed[-1].mimics or "")) and leader not in followed:
            offset += ratio * followed[-1].offset
            ratio *= followed[-1].ratio
            followed.append(leader)
        lower, upper = followed[-1].limits or (0.0, 0.0)
        return ratio * min(max(0.0, lower), upper) + offset

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

    def _unfit(self, joint: UrdfJoint, down: bool, chain: list[UrdfJoint]) -> str:
        """Why a scene cannot have a joint beside the chain; empty where it can."""
        self._check_locked(joint, chain)  # not even locked
        if joint.mimics is not None:
            return f"mimics joint {joint.mimics!r}"
        if joint.type not in MOVABLE:
            return f"is {joint.type}"
        return "" if down else f"carries the base (choose link {joint.parent!r}, or one above it, as base)"

    def _check_locked(self, joint: UrdfJoint, moving: list[UrdfJoint]) -> None:
        if joint.mimics is not None and any(joint.mimics == other.name for other in moving):
            raise SceneError(
                f"URDF: joint {joint.name!r} mimics joint {joint.mimics!r} of the chain: in a scene every "
                "joint moves by itself"
            )


def missing_efforts(driven: Collection[UrdfJoint]) -> str:
    """Say which of the joints have no effort, or a placeholder; empty for none."""
    absent = [joint.name for joint in driven if joint.effort is None and joint.written_effort < UNLIMITED]
    huge = [
        f"effort {joint.written_effort:g} of joint {joint.name}"
        for joint in driven
        if joint.written_effort >= UNLIMITED
    ]
    parts = [f"no effort limit for joint {', '.join(absent)}"] if absent else []
    if huge:
        parts.append(
            f"{', '.join(huge)} {'is a placeholder' if len(huge) == 1 else 'are placeholders'} (1e4 and more)"
        )
    if not parts:
        return ""
    return (
        f"{'; '.join(parts)}: give joint_torque, N m, for all joints without one, or name those without a "
        "motor in passive"
    )


def arm_of(
    robot: UrdfRobot,
    tip: str,
    base: str | None,
    lock_branches: bool | Collection[str],
    extra: Body | None,
    mount: Pose = HERE,
    balance: bool = False,
    motorless: Collection[str] = (),
) -> Arm:
    """Free a robot at its base link, to which `extra` is fixed; the chain from base to tip comes first.

    `mount` is the pose of the base link in the frame of `extra`; `balance` mends inertias that violate the
    triangle inequality; joints in `motorless` need no effort.
    """
    tree = UrdfTree(robot)
    base = tree.root if base is None else base
    chain = tree.chain(tip, base)
    moving = chain
    if lock_branches is not True:
        moving = [*chain, *tree.branches(base, chain, lock_branches or (), motorless)]
    placed = tree.carried(base, mount, moving)
    bodies = [*_bodies(robot, placed), *([] if extra is None else [extra])]
    body = lumped(bodies)
    flaws: list[str] = []
    if body is None:
        raise SceneError(
            f"URDF: base link {base!r} has no mass, nor has anything fixed to it: the arm is made to stand "
            "on the ground; give the spacecraft that carries it, spacecraft={'mass': ..., 'inertia': ...}"
        )
    body = _checked(robot, placed, body, base, balance, flaws)
    center = body.center_of_mass
    to_center = poses.from_rotation_and_position((1.0, 0.0, 0.0, 0.0), tuple((-center).tolist()))
    of_bodies: list[dict[str, Pose]] = [
        {name: dual_quaternion.multiply(to_center, pose) for name, pose in placed.items()}
    ]
    joints, massless = [], list[str]()
    for joint in moving:
        turned = _turned_to(joint.axis)
        parent = next(index for index, links in enumerate(of_bodies) if joint.parent in links)
        before = of_bodies[parent][joint.parent]
        pose = dual_quaternion.multiply(dual_quaternion.multiply(before, joint.origin), turned)
        placed = tree.carried(joint.child, dual_quaternion.conjugate(turned), moving)
        of_bodies.append(placed)
        moved = lumped(_bodies(robot, placed))
        if moved is None:
            massless.append(f"link {joint.child!r}, moved by joint {joint.name!r}")
            continue
        moved = _checked(robot, placed, moved, joint.child, balance, flaws)
        joints.append(ArmJoint(joint, parent, pose, moved))
    if massless:
        one = len(massless) == 1
        lacking = "has no mass, nor has anything fixed to it: its" if one else "have no masses: their"
        raise SceneError(
            f"URDF: {'; '.join(massless)}, {lacking} accelerations would be infinite; give a mass and an "
            "inertia, <inertial>"
        )
    at_center = Body(body.mass, np.zeros(3), body.inertia)
    way = len(chain)
    return Arm(at_center, base, center, tuple(joints), way, of_bodies[way][tip], tuple(flaws))


def _checked(
    robot: UrdfRobot, placed: dict[str, Pose], body: Body, link: str, balance: bool, flaws: list[str]
) -> Body:
    """Refuse or mend an impossible inertia of bodies that move as one; add flaws that are no obstacle."""
    parts = {name: part for name in placed if (part := robot.links[name].body) is not None}
    flaws += [
        f"link {name!r}: its mass is 0: its inertia is left out"
        for name in placed
        if robot.links[name].stands
    ]
    hidden = [
        f"link {name!r}, <inertia>: {flaw}"
        for name, part in parts.items()
        if (flaw := flaw_of(part.inertia, rods=True))
    ]
    flaw = flaw_of(body.inertia, rods=False)
    if not flaw:
        flaws += [f"{each}; {_MADE_UP_FOR}" for each in hidden]
        return body
    others = [name for name in parts if name != link]
    title = f"link {link!r}, with {_some(others)} fixed to it" if others else f"link {link!r}"
    least, middle, largest = np.linalg.eigvalsh(body.inertia)
    mended = Body(body.mass, body.center_of_mass, balanced(body.inertia))
    if least <= 0 or flaw_of(mended.inertia, rods=False):
        raise SceneError(f"URDF: {title}, <inertia>: {flaw}{_listed(hidden if others else [])}")
    if not balance:
        raise SceneError(
            f"URDF: {title}, <inertia>: {flaw}; balance_inertias=True raises the smallest to "
            f"{largest - middle:.6g} kg m^2{_listed(hidden if others else [])}"
        )
    flaws.append(f"{title}, <inertia>: {flaw}; the smallest was raised to {largest - middle:.6g} kg m^2")
    return mended


def _listed(flaws: Collection[str]) -> str:
    return "".join(f"; {flaw}" for flaw in flaws)


def _some(names: Collection[str]) -> str:
    """Names separated by commas, up to sixty."""
    more = f" and {len(names) - _MANY} more" if len(names) > _MANY else ""
    return ", ".join(islice(names, _MANY)) + more


def _bodies(robot: UrdfRobot, placed: dict[str, Pose]) -> list[Body]:
    return [
        body.seen_from(pose) for name, pose in placed.items() if (body := robot.links[name].body) is not None
    ]


def _turned_to(axis: Array) -> Pose:
    """Rotation from z to an axis, as a pose without translation."""
    x, y, z = axis.tolist()
    # The shortest way from z; for an axis that points down, half a turn about x and the shortest way from -z.
    quaternion = (1.0 + z, -y, x, 0.0) if z >= 0 else (-y, 1.0 - z, 0.0, x)
    return poses.from_rotation_and_position(normalize(quaternion), (0.0, 0.0, 0.0))
