"""Variants of a scene, each with one part left out or added."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from dq_space_arm_env import Scene, SceneError
from dq_space_arm_env.scene import Pose
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraints import ControlRate
from dq_space_arm_env.scene.parameters import ACTUATORS

_TIP_WRENCH = {"force": [0.2, 0.0, -0.1], "torque": [0.05, 0.0, 0.02]}
_SPRING = {"stiffness": 10.0, "damping": 1.0}  # N m/rad, N m s/rad
_RANDOM_TARGET = {"target_rotation": 0.1, "target_position": 0.1}  # rad, m
_RANDOM_MASSES = ("mass", "inertia")
_MASSES = ("base_mass", "base_inertia", "link_masses", "link_inertias", "payload_mass", "payload_inertia")
_ACTUATORS = {
    "base_force": "base force",
    "base_torque": "base torque",
    "joint_torque": "joint torques",
    "wrist_rate": "wrist inputs",
    "wheels": "wheels",
    "thrusters": "thrusters",
    "tank": "tank",
}


def feature_variants(scene: Scene) -> dict[str, Scene]:
    """The scene as it is, and with one part left out or added, by title."""
    variants = {f"{scene.name}, as it is": scene}
    if scene.wrist:
        variants["without wrist"] = without_wrist(scene)
    if scene.payload:
        none = {"payload_mass": 0.0, "payload_inertia": 0.0}
        variants["without payload"] = _changed(scene, payload=None, spread=none)
    for name, title in _ACTUATORS.items():
        if getattr(scene.actuators, name):
            variants[f"without {title}"] = without_actuators(scene, name)
    if scene.actuators.base_force and scene.actuators.base_torque:
        both = without_actuators(scene, "base_force", "base_torque")
        variants["without base force and torque"] = both
    if any(link.motor for link in scene.links):
        variants["without motors"] = _with_link_fields(scene, motor=None)
    if late := _with_actuator_fields(scene, time_constant=None, delay=0, slew_limit=None):
        variants["without lags, delays and slew limits"] = late
    if scene.other_tips:
        variants["without other tips"] = _changed(scene, other_tips=())
    if scene.tip_wrench:
        variants["without tip wrench"] = scene.replace(tip_wrench=None)
    elif scene.base.motion == "spatial":
        with suppress(SceneError):  # momentum in the wheels alone
            variants["with a tip wrench"] = scene.replace(tip_wrench=_TIP_WRENCH)
    variants |= _spring_variants(scene)
    variants |= _spread_variants(scene)
    for count in reversed(range(len(scene.links))):
        shorter = with_links(scene, count)
        if shorter is not None:
            variants[f"with {count} link{'s' * (count != 1)}"] = shorter
    if scene.base.motion == "spatial":
        title = "in the plane, without wrist" if scene.wrist else "in the plane"
        variants[title] = in_the_plane(scene)
    return variants


def _spring_variants(scene: Scene) -> dict[str, Scene]:
    if any(link.stiffness or link.damping for link in scene.links):
        return {"without springs and dampers": _with_link_fields(scene, stiffness=0.0, damping=0.0)}
    return {"with springs and dampers": _with_link_fields(scene, **_SPRING)} if scene.links else {}


def _with_link_fields(scene: Scene, **fields: Any) -> Scene:
    return _changed(scene, links=[link.model_copy(update=fields) for link in scene.links])


def _changed(scene: Scene, **changes: Any) -> Scene:
    """Change a scene; of its phases, constraints and parameters keep those that still fit."""
    start = {**changes.pop("initial_state", {}), "previous_controls": ()}
    changes["spread"] = _observable(scene, changes.pop("spread", {}))
    changed = scene.replace(phases=(), constraints=(), parameters=(), initial_state=start, **changes)
    for payload in (True, False):
        if scene.phases and not changed.phases:
            with suppress(SceneError):
                changed = changed.replace(phases=scene.phases if payload else _emptied(scene))
    for each in scene.constraints:
        if isinstance(each, ControlRate):
            gone = [part for part in ACTUATORS.values() if getattr(changed.actuators, part) is None]
            each = each.model_copy(update=dict.fromkeys(gone))
        with suppress(SceneError):
            changed = changed.replace(constraints=[*changed.constraints, each])
    for path in scene.parameters:
        with suppress(SceneError):
            changed = changed.replace(parameters=[*changed.parameters, path])
    return changed


def _emptied(scene: Scene) -> list[Any]:
    """The phases of a scene without its payload."""
    return [
        phase.model_copy(
            update={"catch": None, "changes": tuple(each for each in phase.changes if each[0] != "payload")}
        )
        for phase in scene.phases
    ]


def _with_actuator_fields(scene: Scene, **fields: Any) -> Scene | None:
    """The scene with other dynamics of its actuators; None where they have these."""
    changes = {
        f"actuators.{name}": actuator.model_copy(update=fields)
        for name in ("base_force", "base_torque", "joint_torque", "wrist_rate")
        if (actuator := getattr(scene.actuators, name)) is not None
        and any(getattr(actuator, field) != value for field, value in fields.items())
    }
    return scene.replace(changes) if changes else None


def _spread_variants(scene: Scene) -> dict[str, Scene]:
    """Without the starts, target and masses that episodes draw; with those that they do not."""
    drawn = {name for name, width in scene.spread.model_dump().items() if width} - {"observed"}
    masses = [f"base_{name}" for name in _RANDOM_MASSES]
    if scene.links:
        masses += ["link_masses", "link_inertias"]
    if scene.payload:
        masses += [f"payload_{name}" for name in _RANDOM_MASSES]
    variants = {}
    target = {name for name in drawn if name.startswith(("target_", "grasp_"))}
    starts = drawn - {*masses, *target}
    if starts:
        variants["without random starts"] = _with_spread(scene, **dict.fromkeys(starts, 0.0))
    for title, gone, widths in (
        ("random target", target, _RANDOM_TARGET),
        ("random masses", drawn & {*masses}, dict.fromkeys(masses, 0.1)),
    ):
        if gone:
            variants[f"without {title}"] = _with_spread(scene, **dict.fromkeys(gone, 0.0))
        else:
            with suppress(SceneError):  # of what phases change, nothing is drawn
                variants[f"with {title}"] = _with_spread(scene, **widths)
    return variants


def _with_spread(scene: Scene, **widths: float) -> Scene:
    return scene.replace(spread=_observable(scene, widths))


def _observable(scene: Scene, widths: dict[str, float]) -> dict[str, Any]:
    """Changes of a spread; where no mass is drawn any more, none is observed."""
    left = scene.spread.model_dump() | widths
    return widths if any(left[name] for name in _MASSES) else {**widths, "observed": False}


def without_actuators(scene: Scene, *names: str) -> Scene:
    """Remove actuators, by their names in the scene's `actuators`; thrusters take their tank along."""
    names = (*names, *(["tank"] if "thrusters" in names and scene.actuators.tank else []))
    links = scene.links
    if "joint_torque" in names:
        links = tuple(link.model_copy(update={"torque_limit": None}) for link in links)
    changes: dict[str, Any] = {"actuators": dict.fromkeys(names), "links": links}
    if "wheels" in names:
        changes |= {"initial_state": {"wheel_speeds": ()}, "spread": {"wheel_speeds": 0.0}}
    return _changed(scene, **changes)


def without_wrist(scene: Scene) -> Scene:
    """Lock the wrist at zero angles; the tip stays where it is if it is the wrist's frame."""
    assert scene.wrist is not None
    return _changed(
        scene,
        wrist=None,
        tip=scene.wrist.frame,
        actuators={"wrist_rate": None},
        initial_state={"wrist_angles": ()},
        spread={"wrist_angles": 0.0},
    )


def with_links(scene: Scene, count: int) -> Scene | None:
    """Keep the first links; wrist or tip move to where the next joint was.

    None where that is not a scene: a payload needs a link, and arms that branch have no first links.
    """
    if scene.parent_bodies != (*range(len(scene.links)),) or scene.tip_body != len(scene.links):
        return None
    end = scene.links[count].joint
    start = scene.initial_state
    changes: dict[str, Any] = {
        "links": scene.links[:count],
        "initial_state": {
            "joint_angles": start.joint_angles[: len(freedoms(scene.links[:count]))],
            "joint_rates": start.joint_rates[: len(freedoms(scene.links[:count]))],
        },
    }
    if scene.wrist:
        changes["wrist"] = {"frame": end}
    else:
        changes["tip"] = end
    if count == 0:
        if scene.payload:
            return None
        changes["actuators"] = {"joint_torque": None}
        none = ("joint_angles", "joint_rates", "link_masses", "link_inertias")
        changes["spread"] = dict.fromkeys(none, 0.0)
    return _changed(scene, **changes)


def in_the_plane(scene: Scene) -> Scene:
    """The robot in the plane: no wrist, wheels, jets, other tips; axes along z, offsets turned to x.

    Spherical joints, and those that would slide along z, turn about z.
    """
    flat = without_wrist(scene) if scene.wrist else scene
    out_of_plane = [name for name in ("wheels", "thrusters") if getattr(flat.actuators, name)]
    flat = without_actuators(flat, *out_of_plane) if out_of_plane else flat
    wrench, start = flat.tip_wrench, flat.initial_state
    base_pose, velocity = _flat_pose(start.base_pose), _flat_twist(start.base_velocity)
    changes: dict[str, Any] = {
        "base": {"motion": "planar", "inertia": _flat_inertia(flat.base.inertia)},
        "links": [
            link.model_copy(
                update={
                    "joint_type": "fixed" if link.is_fixed else "revolute",
                    "pitch": 0.0,
                    "inertia": _flat_inertia(link.inertia),
                    "center_of_mass": _flat_vector(link.center_of_mass),
                    "joint": _flat_pose(link.joint),
                }
            )
            for link in flat.links
        ],
        "tip": _flat_pose(flat.tip),
        "other_tips": (),
        "target": {
            "pose": _flat_pose(flat.target.pose),
            "motion": _flat_motion(flat.target.motion),
            "grasp": _flat_pose(flat.target.grasp),
            "base_velocity": _flat_twist(flat.target.base_velocity),
        },
        "initial_state": {
            "base_pose": base_pose,
            "base_velocity": velocity,
            "joint_angles": _flat_joints(scene, start.joint_angles),
            "joint_rates": _flat_joints(scene, start.joint_rates),
        },
    }
    if flat.payload:
        changes["payload"] = {
            "inertia": _flat_inertia(flat.payload.inertia),
            "center_of_mass": _flat_vector(flat.payload.center_of_mass),
        }
    if wrench:
        changes["tip_wrench"] = {"force": _flat_vector(wrench.force), "torque": (0.0, 0.0, wrench.torque[2])}
    return _changed(flat, **changes)


def _flat_joints(scene: Scene, values: Sequence[float]) -> list[float]:
    """Values of joints, of spherical ones about z."""
    return [
        value for value, (_, axis) in zip(values, freedoms(scene.links), strict=True) if axis in ("", " z")
    ]


def _flat_vector(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    return (vector[0] + vector[2], vector[1], 0.0)


def _flat_pose(pose: Pose) -> Pose:
    """The pose without height; only a rotation about z is kept."""
    tilted = any(pose.rotation[1:3])
    rotation = (1.0, 0.0, 0.0, 0.0) if tilted else pose.rotation
    return Pose(position=_flat_vector(pose.position), rotation=rotation)


def _flat_motion(motion: Any) -> Any:
    if motion is None:
        return None
    if motion.kind == "waypoints":
        points = [point.model_copy(update={"pose": _flat_pose(point.pose)}) for point in motion.points]
        return motion.model_copy(update={"points": tuple(points)})
    fields = {
        "angular_velocity": (0.0, 0.0, motion.angular_velocity[2]),
        "linear_velocity": (*motion.linear_velocity[:2], 0.0),
    }
    if motion.kind == "tumbling":
        fields["inertia"] = _flat_inertia(motion.inertia)
    return motion.model_copy(update=fields)


def _flat_twist(twist: tuple[float, ...]) -> tuple[float, ...]:
    """The part that turns about z and moves in x and y."""
    return (0.0, 0.0, *twist[2:5], 0.0)


def _flat_inertia(inertia: Any) -> Any:
    (xx, xy, _), (_, yy, _), (_, _, zz) = inertia
    return ((xx, xy, 0.0), (xy, yy, 0.0), (0.0, 0.0, zz))
