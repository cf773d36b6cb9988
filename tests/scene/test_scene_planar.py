"""A planar scene refuses whatever would take it out of its plane."""

from collections.abc import Callable
from typing import Any

import pytest

from dq_space_arm_env.scene import Scene

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

LEANING = {"axis": [1, 0, 0], "angle": 90}
TURNED = {"axis": [0, 0, -1], "angle": 30}
BODY = {"mass": 1, "inertia": [1, 1, 1]}
SCREW = {**BODY, "name": "drill", "center_of_mass": [0, 0, 0], "joint_type": "screw", "pitch": 0.1}
SKEW = [[10, 0, 0.1], [0, 11, 0], [0.1, 0, 12]]

REFUSED = [  # path, value, key within it, what the sentence says
    ("wrist", {}, "", "remove the wrist"),
    ("base.inertia", SKEW, "", "Ixz and Iyz must be 0"),
    ("links.0.inertia", [[10, 0, 0], [0, 11, 0.1], [0, 0.1, 12]], "", "Ixz and Iyz must be 0"),
    ("links.0.center_of_mass", [0, 0, 0.1], "", "z component must be 0"),
    ("links.0.joint_type", "spherical", "", "turns out of the plane"),
    ("links.0.joint_type", "prismatic", "", "slides out of the plane"),
    ("links.0", {**SCREW, "joint": {}}, ".joint_type", "slides out of the plane"),
    ("target.base_velocity", [0, 0.1, 0, 0, 0, 0], "", "only wz, vx and vy"),
    ("initial_state.base_velocity", [0, 0, 0, 0, 0, 1], "", "only wz, vx and vy"),
    ("tip_wrench", {"force": [1, 0, 1]}, ".force", "z component must be 0"),
    ("tip_wrench", {"torque": [1, 0, 1]}, ".torque", "only the torque about z"),
    ("payload", {**BODY, "inertia": SKEW}, ".inertia", "Ixz and Iyz must be 0"),
    ("payload", {**BODY, "center_of_mass": [0, 0, 1]}, ".center_of_mass", "z component"),
    *(
        (path, *of_pose)
        for path in ("links.0.joint", "tip", "target.pose", "initial_state.base_pose")
        for of_pose in (
            ({"rotation": LEANING}, ".rotation", "only rotations about z"),
            ({"position": [1, 0, 1]}, ".position", "z component must be 0"),
        )
    ),
]


@pytest.mark.parametrize(("path", "value", "within", "what"), REFUSED)
def test_out_of_plane_is_refused(
    planar_data: dict[str, Any],
    change: Change,
    refusals: Refusals,
    path: str,
    value: Any,
    within: str,
    what: str,
) -> None:
    (sentence,) = refusals(change(planar_data, path, value))
    assert sentence.startswith(f"{path.replace('.0', '[0]')}{within} = ")
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
    change(planar_data, "payload", {**BODY, "center_of_mass": [1, 1, 0]})
    scene = Scene.model_validate(planar_data)
    again = change(planar_data, "target.pose", list(scene.target.pose.dual_quaternion))
    assert Scene.model_validate(again).target.pose.position == pytest.approx((1, 2, 0))
