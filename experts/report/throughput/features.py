"""A scene with parts left out or added, to see what each of them costs."""

from __future__ import annotations

from typing import Any

from dq_space_arm_env import Scene, load_scene

_TIP_WRENCH = {"force": [0.2, 0.0, -0.1], "torque": [0.05, 0.0, 0.02]}


def feature_variants(scene: Scene) -> dict[str, Scene]:
    """Derive scenes from one: as it is, with parts left out or added; and a planar one to compare with.

    Args:
        scene: The scene.

    Returns:
        The scenes by what is different.
    """
    variants = {f"{scene.name}, as it is": scene}
    if scene.wrist:
        variants["without wrist"] = without_wrist(scene)
    if scene.payload:
        variants["without payload"] = scene.replace(payload=None)
    actuators = scene.actuators
    if actuators.base_force:
        variants["without base force"] = without_actuators(scene, "base_force")
    if actuators.base_torque:
        variants["without base torque"] = without_actuators(scene, "base_torque")
    if actuators.base_force and actuators.base_torque:
        both = without_actuators(scene, "base_force", "base_torque")
        variants["without base force and torque"] = both
    if scene.tip_wrench:
        variants["without tip wrench"] = scene.replace(tip_wrench=None)
    elif scene.base.motion == "spatial":
        variants["with a tip wrench"] = scene.replace(tip_wrench=_TIP_WRENCH)
    for count in reversed(range(len(scene.links))):
        shorter = with_links(scene, count)
        if shorter is not None:
            variants[f"with {count} link{'s' * (count != 1)}"] = shorter
    if scene.base.motion == "spatial":
        variants["scene planar, another robot"] = load_scene("planar")
    return variants


def without_actuators(scene: Scene, *names: str) -> Scene:
    """Take actuators away.

    Args:
        scene: The scene.
        *names: Fields of `scene.actuators`.

    Returns:
        The scene without them.
    """
    return scene.replace(actuators=scene.actuators.model_copy(update=dict.fromkeys(names)))


def without_wrist(scene: Scene) -> Scene:
    """Replace the wrist by a stiff one: the tip stays where it is at zero angles, if it is the wrist's frame.

    Args:
        scene: A scene with a wrist.

    Returns:
        The scene without it.
    """
    assert scene.wrist is not None
    return scene.replace(
        wrist=None,
        tip=scene.wrist.frame,
        actuators=scene.actuators.model_copy(update={"wrist_rate": None}),
        initial_state=scene.initial_state.model_copy(update={"wrist_angles": ()}),
        spread=scene.spread.model_copy(update={"wrist_angles": 0.0}),
    )


def with_links(scene: Scene, count: int) -> Scene | None:
    """Shorten the arm: what hangs at its end hangs where the joint of the first missing link was.

    Args:
        scene: A scene with more links.
        count: Number of links to keep.

    Returns:
        The scene; None if nothing would move its inputs, or nothing hold its payload.
    """
    end = scene.links[count].joint
    start = scene.initial_state
    changes: dict[str, Any] = {
        "links": scene.links[:count],
        "initial_state": start.model_copy(
            update={
                "joint_angles": start.joint_angles[:count],
                "joint_rates": start.joint_rates[:count],
            }
        ),
    }
    if scene.wrist:
        changes["wrist"] = scene.wrist.model_copy(update={"frame": end})
    else:
        changes["tip"] = end
    if count == 0:
        if scene.payload:
            return None
        changes["actuators"] = scene.actuators.model_copy(update={"joint_torque": None})
        changes["spread"] = scene.spread.model_copy(update={"joint_angles": 0.0, "joint_rates": 0.0})
    return scene.replace(**changes)
