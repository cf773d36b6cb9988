"""A planar scene refuses whatever would take it out of its plane."""

from collections.abc import Callable
from typing import Any

import pytest

from dq_space_arm_env.scene import Scene

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

LEANING = {"axis": [1, 0, 0], "angle": 90}
TURNED = {"axis": [0, 0, -1], "angle": 30}
SKEW = [[10, 0, 0.1], [0, 11, 0], [0.1, 0, 12]]

REFUSED = [
    ("wrist", {}, "wrist", "remove the wrist"),
    ("base.inertia", SKEW, "base.inertia", "Ixz and Iyz must be 0"),
    (
        "links.0.inertia",
        [[10, 0, 0], [0, 11, 0.1], [0, 0.1, 12]],
        "links[0].inertia",
        "Ixz and Iyz must be 0",
    ),
    ("links.0.center_of_mass", [0, 0, 0.1], "links[0].center_of_mass", "z component must be 0"),
    ("links.0.joint", {"position": [0, 0, 0.1]}, "links[0].joint.position", "z component must be 0"),
    ("links.0.joint", {"rotation": LEANING}, "links[0].joint.rotation", "only rotations about z"),
    ("tip", {"rotation": LEANING}, "tip.rotation", "only rotations about z"),
    ("tip", {"position": [1, 0, 1]}, "tip.position", "z component must be 0"),
    ("target.pose", {"rotation": LEANING}, "target.pose.rotation", "only rotations about z"),
    ("target.pose", {"position": [1, 0, 1]}, "target.pose.position", "z component must be 0"),
    ("target.base_velocity", [0, 0.1, 0, 0, 0, 0], "target.base_velocity", "only wz, vx and vy"),
    (
        "initial_state.base_pose",
        {"rotation": LEANING},
        "initial_state.base_pose.rotation",
        "only rotations about z",
    ),
    ("initial_state.base_pose", {"position": [1, 0, 1]}, "initial_state.base_pose.position", "z component"),
    ("initial_state.base_velocity", [1, 0, 0, 0, 0, 0], "initial_state.base_velocity", "only wz, vx and vy"),
    ("initial_state.base_velocity", [0, 0, 0, 0, 0, 1], "initial_state.base_velocity", "only wz, vx and vy"),
    ("tip_wrench", {"force": [1, 0, 1]}, "tip_wrench.force", "z component must be 0"),
    ("tip_wrench", {"torque": [1, 0, 1]}, "tip_wrench.torque", "only the torque about z"),
    ("payload", {"mass": 1, "inertia": SKEW}, "payload.inertia", "Ixz and Iyz must be 0"),
    (
        "payload",
        {"mass": 1, "inertia": [1, 1, 1], "center_of_mass": [0, 0, 1]},
        "payload.center_of_mass",
        "z component",
    ),
]


@pytest.mark.parametrize(("path", "value", "where", "what"), REFUSED)
def test_out_of_plane_is_refused(
    planar_data: dict[str, Any],
    change: Change,
    refusals: Refusals,
    path: str,
    value: Any,
    where: str,
    what: str,
) -> None:
    (sentence,) = refusals(change(planar_data, path, value))
    assert sentence.startswith(f"{where} = ")
    assert 'base.motion is "planar"' in sentence
    assert what in sentence
    planar_data["base"]["motion"] = "spatial"  # the plane is all that was wrong
    Scene.model_validate(planar_data)


def test_in_plane_is_accepted(planar_data: dict[str, Any], change: Change) -> None:
    pose = {"position": [1, 2, 0], "rotation": TURNED}
    for path in ("links.0.joint", "tip", "target.pose", "initial_state.base_pose"):
        change(planar_data, path, pose)
    change(planar_data, "base.inertia", [[10, 1, 0], [1, 11, 0], [0, 0, 12]])
    change(planar_data, "initial_state.base_velocity", [0, 0, 0.1, 0.2, 0.3, 0])
    change(planar_data, "target.base_velocity", [0, 0, 0.1, 0.2, 0.3, 0])
    change(planar_data, "tip_wrench", {"force": [1, 2, 0], "torque": [0, 0, 3]})
    change(planar_data, "payload", {"mass": 1, "inertia": [1, 1, 1], "center_of_mass": [1, 1, 0]})
    scene = Scene.model_validate(planar_data)
    again = change(planar_data, "target.pose", list(scene.target.pose.dual_quaternion))
    assert Scene.model_validate(again).target.pose.position == pytest.approx((1, 2, 0))


def test_all_out_of_plane_fields_are_reported_at_once(
    planar_data: dict[str, Any], refusals: Refusals
) -> None:
    planar_data["tip"] = {"position": [0, 0, 1], "rotation": LEANING}
    planar_data["links"][0]["center_of_mass"] = [0, 0, 1]
    assert [sentence.split(" = ")[0] for sentence in refusals(planar_data)] == [
        "links[0].center_of_mass",
        "tip.position",
        "tip.rotation",
    ]
