"""Flights from files and packages, and the scene in which several of them can be shown."""

from __future__ import annotations

import os
from collections.abc import Sequence

from dq_space_arm_env.common.entry_points import entry_points, load
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.replay.flights import aimed

GROUP = "dq_space_arm.flights"
"""Entry-point group: functions (source, label) -> `Trajectory`, or None for what they do not read."""


def read_flight(source: str | os.PathLike[str], label: str | None = None) -> Trajectory:
    """Read a flight.

    Args:
        source: A file that `Trajectory.save` or `Solution.save` has written; or a source that a package reads
            by an entry point, like `demonstrations/paper#3`, demonstration 3 in a folder.
        label: Name on the page; by default that in the file, or the name of the file.

    Returns:
        The flight.

    Raises:
        ValueError: If the source holds no flight.
    """
    text = os.fspath(source)
    for reference in entry_points(GROUP).values():
        flight: Trajectory | None = load(reference)(text, label)
        if flight is not None:
            return flight
    return Trajectory.load(text, label)


def common_scene(flights: Sequence[Trajectory], scene: Scene | None = None) -> tuple[list[Trajectory], Scene]:
    """Find the scene in which all flights can be shown.

    Scenes may differ in masses, limits and targets, which change the flights but not the picture.

    Args:
        flights: The flights.
        scene: The scene to show; by default the first that a flight names.

    Returns:
        The flights, each with the target of its own scene; and the scene.

    Raises:
        ValueError: If no scene is known, or a flight has another robot, time step, or
            other states or inputs, or goes on beyond its scene, whose target moves.
    """
    scene = scene or next((flight.scene for flight in flights if flight.scene is not None), None)
    if scene is None:
        raise ValueError("no file says which scene it belongs to: name the scene")
    shown = []
    for flight in flights:
        if flight.scene is not None:
            _check_same_robot(flight.label, flight.scene, scene)
            flight = aimed(flight, flight.scene)
        shown.append(flight)
    return shown, scene


def by_scene(flights: Sequence[Trajectory]) -> list[tuple[list[Trajectory], Scene]]:
    """Sort flights by the names of their scenes.

    Args:
        flights: The flights; those that name no scene belong to the first that another names.

    Returns:
        For each scene, in the order of the flights, what `common_scene` finds.

    Raises:
        ValueError: If no scene is known, or flights of one scene have different robots, time steps,
            states or inputs.
    """
    first = next((flight.scene for flight in flights if flight.scene is not None), None)
    groups: dict[str, list[Trajectory]] = {}
    for flight in flights:
        scene = flight.scene or first
        groups.setdefault("" if scene is None else scene.name, []).append(flight)
    parts = []
    for group in groups.values():
        named = next((flight.scene for flight in group if flight.scene is not None), None)
        parts.append(common_scene(group, named))
    return parts


def _check_same_robot(label: str, own: Scene, scene: Scene) -> None:
    if own.simulation.dt != scene.simulation.dt:
        raise ValueError(
            f"flight {label!r} has time steps of {own.simulation.dt:g} s, the scene {scene.name!r} has "
            f"{scene.simulation.dt:g} s: show them on separate pages"
        )
    if _frames(own) != _frames(scene):
        raise ValueError(
            f"flight {label!r} is one of another robot ({own.name!r}) than that of the scene {scene.name!r}: "
            "show them on separate pages"
        )
    if _entries(own) != _entries(scene):
        raise ValueError(
            f"flight {label!r} has other states or inputs ({own.name!r}) than the scene {scene.name!r}: show "
            "them on separate pages"
        )


def _frames(scene: Scene) -> tuple[object, ...]:
    """How the frames of a scene's robot are placed."""
    joints = [(link.joint, link.joint_type, link.pitch) for link in scene.links], scene.parent_bodies
    tips = [(scene.body_named(tip.link), tip.frame) for tip in scene.other_tips]
    return scene.base.motion, joints, scene.tip_body, scene.wrist, scene.tip, tips


def _entries(scene: Scene) -> tuple[object, ...]:
    """Places of a scene's states and inputs, and the joints that have a motor."""
    layout = StateLayout.of(scene)
    parts = [place for part in (layout.state, layout.control) for place in vars(part).values()]
    return *(place for place in parts if isinstance(place, slice)), layout.actuated_joints
