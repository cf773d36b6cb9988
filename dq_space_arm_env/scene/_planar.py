"""What a planar scene must not contain: whatever leaves the x-y plane or turns about another axis than z."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from dq_space_arm_env.scene._problems import Problem
from dq_space_arm_env.scene.pose import Matrix3, Pose

if TYPE_CHECKING:
    from dq_space_arm_env.scene.schema import Scene

_PLANAR = 'base.motion is "planar"'
Location = tuple[str | int, ...]


def planar_problems(scene: "Scene") -> Iterator[Problem]:
    """Find what would take a planar scene out of its plane.

    Args:
        scene: A scene whose base moves in the plane.

    Yields:
        One problem for each offending field.
    """
    if scene.wrist is not None:
        yield Problem(("wrist",), scene.wrist, f"{_PLANAR}: remove the wrist, it turns out of the plane")
    yield from _inertia_problems(("base", "inertia"), scene.base.inertia)
    for index, link in enumerate(scene.links):
        here: Location = ("links", index)
        yield from _pose_problems((*here, "joint"), link.joint)
        yield from _height_problems((*here, "center_of_mass"), link.center_of_mass)
        yield from _inertia_problems((*here, "inertia"), link.inertia)
    yield from _pose_problems(("tip",), scene.tip)
    if scene.payload is not None:
        yield from _height_problems(("payload", "center_of_mass"), scene.payload.center_of_mass)
        yield from _inertia_problems(("payload", "inertia"), scene.payload.inertia)
    if scene.tip_wrench is not None:
        yield from _height_problems(("tip_wrench", "force"), scene.tip_wrench.force)
        if any(scene.tip_wrench.torque[:2]):
            sentence = f"{_PLANAR}: only the torque about z may be nonzero"
            yield Problem(("tip_wrench", "torque"), scene.tip_wrench.torque, sentence)
    yield from _pose_problems(("target", "pose"), scene.target.pose)
    yield from _velocity_problems(("target", "base_velocity"), scene.target.base_velocity)
    yield from _pose_problems(("initial_state", "base_pose"), scene.initial_state.base_pose)
    yield from _velocity_problems(("initial_state", "base_velocity"), scene.initial_state.base_velocity)


def _pose_problems(location: Location, pose: Pose) -> Iterator[Problem]:
    yield from _height_problems((*location, "position"), pose.position)
    if any(pose.rotation[1:3]):
        sentence = f"{_PLANAR}: only rotations about z are possible, so x and y of [w, x, y, z] must be 0"
        yield Problem((*location, "rotation"), pose.rotation, sentence)


def _height_problems(location: Location, vector: tuple[float, float, float]) -> Iterator[Problem]:
    if vector[2] != 0:
        yield Problem(location, vector, f"{_PLANAR}: the z component must be 0")


def _inertia_problems(location: Location, inertia: Matrix3) -> Iterator[Problem]:
    if inertia[0][2] != 0 or inertia[1][2] != 0:
        yield Problem(location, inertia, f"{_PLANAR}: the products of inertia Ixz and Iyz must be 0")


def _velocity_problems(location: Location, velocity: tuple[float, ...]) -> Iterator[Problem]:
    if any(velocity[index] for index in (0, 1, 5)):
        sentence = f"{_PLANAR}: only wz, vx and vy (numbers 3, 4 and 5 of 6) may be nonzero"
        yield Problem(location, velocity, sentence)
