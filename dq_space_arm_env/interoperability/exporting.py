"""Shared by the exports: numbers as text, names, and features that the formats lack."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator

from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.dynamics.kinematics import wrist_rotation
from dq_space_arm_env.scene import INTEGRATORS, Scene, SceneError
from dq_space_arm_env.scene.actuator_chains import chains
from dq_space_arm_env.scene.constraint_rows import sides
from dq_space_arm_env.scene.constraints import JointLimits
from dq_space_arm_env.scene.parameters import is_part
from dq_space_arm_env.validation import did_you_mean


def words(numbers: Iterable[float]) -> str:
    """Write numbers with all their digits, separated by blanks."""
    # Adding zero turns -0.0 into 0.0, and whole numbers lose their ".0".
    return " ".join(repr(float(number) + 0.0).removesuffix(".0") for number in numbers)


def free_name(wanted: str, taken: Collection[str]) -> str:
    """Append underscores to a name until it is free."""
    while wanted in taken:
        wanted += "_"
    return wanted


def integrator_name(scene: Scene, integrator: str | None) -> str:
    """The scene's integrator, or the named one; ValueError if it is unknown."""
    name = scene.simulation.integrator if integrator is None else integrator
    if not isinstance(name, str) or name not in INTEGRATORS:
        known = f"it must be one of {', '.join(INTEGRATORS)}"
        raise ValueError(f"integrator: {name!r} is unknown; {did_you_mean(str(name), INTEGRATORS, known)}")
    return name


def coupled_rotors(scene: Scene) -> Iterator[str]:
    """Say of elastic gears, and of rotors that turn with the body before their joint, that it has none."""
    elastic = [link.name for link in scene.links if link.is_elastic]
    if elastic:
        yield f"it has no elastic gears, and link {elastic[0]!r} has one: remove its motor's stiffness"
    for link in scene.links:
        if link.motor is not None and link.motor.inertia and link.motor.coupling == "exact":
            yield (
                "it has no rotors that turn with the body before the joint, and "
                f"link {link.name!r} has one: set its motor's coupling to armature"
            )
            return


def changed_robots(scene: Scene) -> Iterator[str]:
    """Say of a robot that phases change, in its bodies, joints or motors, that it stays as it is."""
    for name in scene.staged.values:
        of_robot = any(is_part(name, part) for part in ("base", "links", "payload"))
        if of_robot and not name.endswith((".torque_limit", ".torque_weight")):
            yield f"its robot stays as it is, and phases change {name}: set phases to []"
            return


def refuse(
    scene: Scene,
    language: str,
    wrist: str,
    *,
    springs: bool = False,
    planar: bool = False,
    rotors: bool = False,
    spherical: bool = False,
    at_once: bool = False,
) -> None:
    """Refuse a scene that the format cannot represent without changing its motion.

    `springs`, `planar`, `rotors`, `spherical`: formats without joint springs, planar bases, rotors of any
    kind, and spherical joints; `at_once`: with actuators that neither lag nor delay.
    """
    if wrist not in ("refuse", "fixed"):
        raise ValueError(f"wrist: {wrist!r}, it must be 'refuse' or 'fixed'")
    problems = []
    if scene.wrist is not None and wrist == "refuse":
        problems.append(
            "the wrist has joints without mass, whose accelerations would be infinite: wrist='fixed' writes "
            "it at its initial angles, which changes no acceleration but holds the tip"
        )
    if scene.tip_wrench is not None:
        problems.append("it has no constant wrench at the tip: set tip_wrench to null")
    stiff = [link.name for link in scene.links if link.stiffness]
    if springs and stiff:
        problems.append(f"it has no joint springs, and link {stiff[0]!r} has one: set its stiffness to 0")
    if planar and scene.base.motion == "planar":
        problems.append("it has no base that moves in a plane: set base.motion to spatial")
    screws = [link.name for link in scene.links if link.joint_type == "screw"]
    if screws:
        problems.append(f"it has no screw joints, and link {screws[0]!r} has one")
    balls = [link.name for link in scene.links if link.is_spherical]
    if spherical and balls:
        problems.append(f"it has no spherical joints, and link {balls[0]!r} has one")
    if scene.actuators.wheels is not None:
        problems.append("it has no reaction wheels: set actuators.wheels to null")
    if scene.actuators.tank is not None:
        problems.append("it has no tank that empties: set actuators.tank to null")
    problems += changed_robots(scene)
    for link, (lower, upper, _) in zip(scene.links, joint_limits(scene), strict=True):
        if lower >= upper:  # MuJoCo would ignore them, Pinocchio lock the joint
            problems.append(
                f"constraints limit joint {link.name!r} to {lower:g} {link.unit} or more and to {upper:g} "
                f"{link.unit} or less, which leaves it no range: change one of them"
            )
    geared = [link.name for link in scene.links if link.motor is not None and link.motor.inertia]
    if rotors and geared and not any(link.is_elastic for link in scene.links):
        problems.append(f"it has no rotors, and link {geared[0]!r} has one: set its motor's inertia to 0")
    elif geared:
        problems += coupled_rotors(scene)
    late = [chain.name for chain in chains(scene)]
    if at_once and late:
        problems.append(
            f"its actuators act at once, and {late[0]} lags or delays: remove time_constant and delay"
        )
    if problems:
        raise SceneError("\n  - ".join([f"scene {scene.name!r} cannot be written as {language}:", *problems]))


def joint_limits(scene: Scene) -> list[tuple[float, float, float]]:
    """Smallest and largest coordinate, rad or m, and largest rate of each joint; infinite for none."""
    limits = [[-math.inf, math.inf, math.inf] for _ in scene.links]
    for constraint in scene.constraints:
        for side in sides(scene, constraint) if isinstance(constraint, JointLimits) else ():
            of_joint = limits[side.link]
            if side.is_rate:
                of_joint[2] = min(of_joint[2], side.bound)
            elif side.sign > 0:
                of_joint[1] = min(of_joint[1], side.bound)
            else:
                of_joint[0] = max(of_joint[0], -side.bound)
    return [(lower, upper, rate) for lower, upper, rate in limits]


def depth_first(scene: Scene) -> list[int]:
    """Links in the order of other programs' coordinates: each right before what it carries."""

    def carried_by(body: int) -> list[int]:
        links = [link for link, parent in enumerate(scene.parent_bodies) if parent == body]
        return [each for link in links for each in (link, *carried_by(link + 1))]

    return carried_by(0)


def tip_on_its_body(scene: Scene) -> tuple[float, ...]:
    """Pose of the tip in the frame of the body that carries it, with the wrist at its initial angles."""
    if scene.wrist is None:
        return scene.tip.dual_quaternion
    turned = wrist_rotation(scene.initial_state.wrist_angles)
    wrist = dual_quaternion.multiply(scene.wrist.frame.dual_quaternion, turned)
    return tuple(dual_quaternion.multiply(wrist, scene.tip.dual_quaternion))
