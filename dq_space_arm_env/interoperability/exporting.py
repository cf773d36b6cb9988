"""What the exports to URDF and MJCF share: numbers as text, names, and what the formats cannot say."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.dynamics.kinematics import wrist_rotation
from dq_space_arm_env.scene import Scene, SceneError


def words(numbers: Iterable[float]) -> str:
    """Numbers separated by blanks, with all their digits.

    Args:
        numbers: The numbers.

    Returns:
        The text.
    """
    # Adding zero turns -0.0 into 0.0, and whole numbers lose their ".0".
    return " ".join(repr(float(number) + 0.0).removesuffix(".0") for number in numbers)


def free_name(wanted: str, taken: Collection[str]) -> str:
    """A name that nobody has.

    Args:
        wanted: The name to begin with.
        taken: Names that are in use.

    Returns:
        The name, with as many underscores appended as it takes.
    """
    while wanted in taken:
        wanted += "_"
    return wanted


def refuse(scene: Scene, language: str, wrist: str, *, springs: bool = False, planar: bool = False) -> None:
    """Refuse a scene whose robot cannot be written down without changing how it moves.

    Args:
        scene: A validated scene.
        language: Name of the format.
        wrist: What the user wants for a wrist, "refuse" or "fixed".
        springs: Whether the format has no joint springs.
        planar: Whether the format has no base that moves in a plane.

    Raises:
        SceneError: If the scene holds anything of that kind; the message says what to do.
        ValueError: If `wrist` is something else.
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
        problems.append("it has no constant wrench at the tip: leave it out with replace(tip_wrench=None)")
    stiff = [link.name for link in scene.links if link.stiffness]
    if springs and stiff:
        problems.append(f"it has no joint springs, and link {stiff[0]!r} has one: set its stiffness to 0")
    if planar and scene.base.motion == "planar":
        problems.append("it has no base that moves in a plane: set base.motion to spatial")
    if problems:
        raise SceneError("\n  - ".join([f"scene {scene.name!r} cannot be written as {language}:", *problems]))


def tip_from_last_link(scene: Scene) -> tuple[float, ...]:
    """Pose of the tip in the last link's frame (without links: the base's), the wrist at its initial angles.

    Args:
        scene: A validated scene.

    Returns:
        Unit dual quaternion, 8 numbers, m.
    """
    if scene.wrist is None:
        return scene.tip.dual_quaternion
    turned = wrist_rotation(scene.initial_state.wrist_angles)
    wrist = dual_quaternion.multiply(scene.wrist.frame.dual_quaternion, turned)
    return tuple(dual_quaternion.multiply(wrist, scene.tip.dual_quaternion))
