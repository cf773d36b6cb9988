"""Motions of the target in scene files: errors by field, files of poses, changes, drawn motions, hashes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene, SceneError, load_scene
from dq_space_arm_env.scene import draw_initial_state
from dq_space_arm_env.scene.motion import ScrewMotion, Tumbling, Waypoints
from dq_space_arm_env.scene.parameters import parameters
from dq_space_arm_env.scene.path import given_path
from dq_space_arm_env.scene.start import episode_scene, episode_start, number_of_draws, parameter_values

NAN = float("nan")
HEADER = "time,q_w,q_x,q_y,q_z,x,y,z"
ROWS = ["0,1,0,0,0,0.1,0.2,0.3", "2,0.8,0,0,0.6,1,2,3", "2.5,0,1,0,0,1,2,3.5"]
SCREW = {"kind": "screw", "angular_velocity": [0.1, 0.2, 0.3], "linear_velocity": [0.4, 0.5, 0.6]}
TUMBLING = {**SCREW, "kind": "tumbling", "inertia": [4.0, 5.0, 6.0]}
WAYPOINTS = {"kind": "waypoints", "points": [{"time": 0, "pose": {}}, {"time": 1, "pose": {}}]}


def with_motion(motion: Any, name: str = "paper", **changes: Any) -> Scene:
    return load_scene(name).replace({"target.motion": motion, **changes})


def waypoints(*times: Any) -> dict[str, Any]:
    return {"kind": "waypoints", "points": [{"time": time, "pose": {}} for time in times]}


@pytest.mark.parametrize(
    ("motion", "what"),
    [
        ({"kind": "scrw"}, "target.motion = .*kind is one of screw, tumbling, waypoints, file"),
        ({}, "target.motion = .*kind is one of"),
        ([1, 2], r"target.motion = \[1, 2\]: must be a mapping whose kind"),
        ({**SCREW, "angular_velocity": [NAN, 0, 0]}, "target.motion.angular_velocity = .*3 finite numbers"),
        ({**SCREW, "linear_velocity": [1, 2]}, "target.motion.linear_velocity = .*it has 2"),
        ({**SCREW, "speed": 1.0}, "target.motion.speed: unknown key"),
        ({**TUMBLING, "inertia": [1.0, 1.0, 3.0]}, "target.motion.inertia = "),
        ({"kind": "tumbling"}, "target.motion.inertia: missing"),
        ({**TUMBLING, "angular_velocity": [20.0, 0, 0]}, "angular_velocity.*0.367 rad in a time step"),
        (waypoints(), r"target.motion.points = 0: has 0 poses; must have from 1 to 100,000"),
        (waypoints(0, 2, 1), r"points\[2\].time = 1.*must be later than the time before it, 2 s"),
        (waypoints(0, 0), r"points\[1\].time = 0.*later"),
        (waypoints(0, NAN), r"points\[1\].time = nan.*finite number"),
        ({"kind": "waypoints"}, "target.motion.points: missing"),
    ],
)
def test_a_bad_motion_is_refused_by_its_key(motion: Any, what: str) -> None:
    with pytest.raises(SceneError, match=what):
        with_motion(motion)


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        (None, "target.motion = .*cannot be read"),
        (["t,x,y,z", *ROWS], f"the first line of .* must be {HEADER}"),
        ([], "the first line of"),
        ([HEADER, ROWS[0], "1,1,0,0,0,zero,0,0"], "line 3 of .* must be 8 numbers"),
        ([HEADER, "0,1,0,0,0,0,0"], "line 2 of .* must be 8 numbers"),
        ([HEADER, "0,1,0,0,0,0,0,0,0"], "line 2 of .* must be 8 numbers"),
        ([HEADER, ROWS[1], ROWS[0]], r"target.motion = .*: line 3 of .*poses.csv: time = 0.*: must be later"),
        ([HEADER, ROWS[0], "1,1,1,0,0,0,0,0"], "line 3 of .*poses.csv: pose.rotation = .* must be a unit"),
        ([HEADER], "has 0 poses"),
    ],
)
def test_a_bad_file_of_poses_is_refused(lines: list[str] | None, what: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    if lines is not None:
        path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SceneError, match=what):
        with_motion({"kind": "file", "path": str(path)})


def test_a_file_of_a_spreadsheet_is_read(tmp_path: Path) -> None:
    """With the mark of its encoding, and empty lines."""
    path = tmp_path / "poses.csv"
    path.write_text("\ufeff" + "\r\n".join([HEADER, ROWS[0], "", *ROWS[1:], "", ""]), "utf-8")
    plain = tmp_path / "plain.csv"
    plain.write_text("\n".join([HEADER, *ROWS]))
    read, expected = (with_motion({"kind": "file", "path": each}) for each in (path, plain))
    assert read.target.motion == expected.target.motion
    path.write_text("\n".join([HEADER, "", ROWS[1], ROWS[0]]))
    with pytest.raises(SceneError, match=r"line 4 of .*poses.csv: time = 0.*: must be later"):
        with_motion({"kind": "file", "path": path})


def test_a_file_needs_a_path_and_nothing_else() -> None:
    for motion in (
        {"kind": "file"},
        {"kind": "file", "path": 3},
        {"kind": "file", "path": "a", "points": []},
    ):
        with pytest.raises(SceneError, match="must have a kind, file, and a path"):
            with_motion(motion)


def test_a_file_is_found_beside_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "poses.csv").write_text("\n".join([HEADER, *ROWS]) + "\n")
    entries = load_scene("no-wrist").model_dump(mode="json", exclude_unset=True)
    entries["target"]["motion"] = {"kind": "file", "path": "poses.csv"}
    (tmp_path / "scene.yaml").write_text(json.dumps(entries))
    for folder in (tmp_path, tmp_path.parent):
        monkeypatch.chdir(folder)
        path = tmp_path / "scene.yaml"
        assert len(load_scene(path.relative_to(folder)).target.motion.points) == len(ROWS)


def test_a_file_becomes_the_waypoints_that_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([HEADER, *ROWS]) + "\n")
    from_file = with_motion({"kind": "file", "path": path})
    points = [
        {"time": time, "pose": {"rotation": rotation, "position": position}}
        for time, rotation, position in (
            (0, [1, 0, 0, 0], [0.1, 0.2, 0.3]),
            (2, [0.8, 0, 0, 0.6], [1, 2, 3]),
            (2.5, [0, 1, 0, 0], [1, 2, 3.5]),
        )
    ]
    assert from_file == with_motion({"kind": "waypoints", "points": points})
    path.unlink()  # it is read once
    assert load_scene(from_file.model_dump()) == from_file


@pytest.mark.parametrize("motion", [SCREW, TUMBLING, WAYPOINTS], ids=lambda motion: str(motion["kind"]))
def test_yaml_holds_a_motion_and_a_grasp_to_the_bit(motion: dict[str, Any], tmp_path: Path) -> None:
    scene = with_motion(motion, **{"target.grasp": {"position": [0.1, 0.2, 1 / 3]}})
    path = tmp_path / "scene.yaml"
    path.write_text(scene.to_yaml())
    assert load_scene(path) == scene
    assert load_scene(path).content_hash() == scene.content_hash()
    assert scene.content_hash() != load_scene("paper").content_hash()


def test_one_number_of_a_motion_changes_and_one_kind_replaces_another() -> None:
    screw = with_motion(SCREW)
    faster = screw.replace({"target.motion.angular_velocity": [1.0, 0.0, 0.0]}).target.motion
    assert faster == ScrewMotion(
        kind="screw", angular_velocity=(1.0, 0.0, 0.0), linear_velocity=(0.4, 0.5, 0.6)
    )
    tumbling = screw.replace({"target.motion": {"kind": "tumbling", "inertia": [4, 5, 6]}}).target.motion
    assert isinstance(tumbling, Tumbling)
    assert tumbling.linear_velocity == (0.0, 0.0, 0.0)  # nothing of the screw stays
    assert isinstance(screw.replace({"target.motion": WAYPOINTS}).target.motion, Waypoints)
    assert screw.replace({"target.motion": None}) == load_scene("paper")


@pytest.mark.parametrize("field", ["target_angular_velocity", "target_linear_velocity"])
@pytest.mark.parametrize("motion", [None, WAYPOINTS], ids=["rest", "waypoints"])
def test_only_a_screw_or_a_tumble_has_a_velocity_to_draw(field: str, motion: Any) -> None:
    with pytest.raises(SceneError, match=rf"spread.{field} = 0.1: must be 0: the target is on no screw"):
        with_motion(motion, **{f"spread.{field}": 0.1})


def test_a_drawn_tumble_may_be_too_fast() -> None:
    with_motion({**TUMBLING, "angular_velocity": [9.0, 0, 0]})
    with pytest.raises(SceneError, match=r"lower it or simulation\.dt"):
        with_motion({**TUMBLING, "angular_velocity": [9.0, 0, 0]}, **{"spread.target_angular_velocity": 2.0})


@pytest.mark.parametrize(
    ("motion", "what"),
    [
        ({**SCREW, "angular_velocity": [0, 0.1, 0], "linear_velocity": [0, 0, 0]}, "angular_velocity"),
        ({**SCREW, "angular_velocity": [0, 0, 0.1]}, "linear_velocity"),
        ({**TUMBLING, "angular_velocity": [0.1, 0, 0], "linear_velocity": [0, 0, 0]}, "angular_velocity"),
        (
            {"kind": "waypoints", "points": [{"time": 0, "pose": {"position": [0, 0, 1]}}]},
            r"points\[0\].pose.position",
        ),
    ],
)
def test_a_planar_target_stays_in_its_plane(motion: Any, what: str) -> None:
    with pytest.raises(SceneError, match=rf"target.motion.{what} = .*planar"):
        with_motion(motion, "planar")


@pytest.mark.parametrize("motion", [SCREW, TUMBLING], ids=lambda motion: str(motion["kind"]))
def test_the_scene_of_an_episode_has_the_parameters_that_were_drawn(motion: dict[str, Any]) -> None:
    """Its nominal parameters are those of the episode, and drawing from it draws nothing."""
    spread = {"target_rotation": 0.3, "target_position": 0.2, "target_angular_velocity": 0.1}
    spread |= {"target_linear_velocity": 0.2, "grasp_rotation": 0.2, "grasp_position": 0.1, "base_mass": 0.1}
    scene = with_motion(motion, spread=spread, **{"target.grasp": {"position": [0.1, 0.2, 0.3]}})
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, number_of_draws(scene))
    values = parameter_values(scene, episode_start(scene, draws))
    drawn = dict(zip((number.name for number in parameters(scene)), values, strict=True))
    episode = episode_scene(scene, values)
    named = episode.replace({"parameters": ["target.pose", "target.grasp", "base.mass"]})
    found = {number.name: number.nominal for number in parameters(named)}
    for name, value in drawn.items():
        if name in found:
            assert found[name] == pytest.approx(value, abs=1e-14), name
    assert {"target.velocity.v_x", "target.pose.q_d1", "target.grasp.q_d1", "base.mass"} <= found.keys()
    nominal = {number.name: number.nominal for number in parameters(scene)}
    assert abs(drawn["target.velocity.omega_x"] - nominal["target.velocity.omega_x"]) > 1e-3
    assert number_of_draws(episode) < number_of_draws(scene)
    again, _ = (draw_initial_state(episode, np.random.default_rng(seed)) for seed in (0, 1))
    np.testing.assert_array_equal(again, _)


def test_a_target_that_starts_late_waits_and_one_point_is_rest() -> None:
    late = with_motion(
        {
            "kind": "waypoints",
            "points": [
                {"time": 0.1, "pose": {"position": [1, 0, 0]}},
                {"time": 0.25, "pose": {"position": [2, 0, 0]}},
            ],
        }
    )
    path = given_path(late, 20)
    assert not path[:7, 8:].any()
    np.testing.assert_allclose(path[7:17, 11], 1.0 / 0.15)
    np.testing.assert_allclose(2.0 * path[:, 5], np.clip((0.015 * np.arange(21) - 0.1) / 0.15, 0, 1))
    still = with_motion({"kind": "waypoints", "points": [{"time": 3.0, "pose": {"position": [1, 0, 0]}}]})
    np.testing.assert_array_equal(given_path(still, 5)[:, 1:], np.zeros((6, 13)))


def test_scenes_at_rest_have_the_hashes_that_they_had() -> None:
    known = {
        "paper": "00c7f1939550ce9bb98c79cbbbf75369abecf77800cac4d08bb71fb2ec370d27",
        "planar": "c3f386f72b5c496df4f61754d1f8669270e88dec6049727224bede3608e99939",
        "random-target": "bb6cba862c4692d80972ea8d828ceb4cf5fb8e492ed6e8d2d7a7ca6133895527",
    }
    assert {name: load_scene(name).content_hash() for name in known} == known
    still = load_scene("paper").replace({"target.motion": None, "target.grasp": {}, "cost.tip_twist": 0.0})
    assert still.content_hash() == known["paper"]
    assert "tip_twist" not in still.to_yaml()
