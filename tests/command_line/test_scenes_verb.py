"""The verb `scenes`: lists, summaries, problems with their lines, and new files that are valid."""

import json
import math
import re
from pathlib import Path

import pytest

from dq_space_arm_env import list_scenes, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.scene_problems import check
from dq_space_arm_env.command_line.scene_summary import left_out
from dq_space_arm_env.command_line.scene_template import commented_yaml
from dq_space_arm_env.command_line.scene_warnings import warnings_of
from dq_space_arm_env.common.console import FAILURE, SUCCESS, UNUSABLE
from dq_space_arm_env.scene import Actuators, Spread, StateLayout
from dq_space_arm_env.validation import parse_yaml

BROKEN = """\
name: broken
base: {mass: -5, inertia: [1, 1, 1]}
links:
  - name: arm
    mas: 2
    inertia: [1, 1, 9]
    center_of_mass: [0, 0, 0]
    joint: {position: [0, 0]}
target: {pose: {position: [1, 0, 0]}}
simulation:
  dt: 0.01
  integrator: rk5
"""


def test_list_has_every_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "list"]) == SUCCESS
    output = capsys.readouterr().out
    assert 80 < max(map(len, output.splitlines())) <= 110
    assert main(["scenes", "list", "--json"]) == SUCCESS
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == list_scenes()
    for row in rows:
        assert row["name"] in output
        assert load_scene(row["file"]) == load_scene(row["name"])


@pytest.mark.sampled
@pytest.mark.parametrize("name", list_scenes())
def test_show_has_states_and_inputs(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    layout = StateLayout.of(load_scene(name))
    assert main(["scenes", "show", name, "--json"]) == SUCCESS
    record = json.loads(capsys.readouterr().out)
    assert [entry["name"] for entry in record["states"]] == list(layout.state.names)
    assert [entry["name"] for entry in record["inputs"]] == list(layout.control.names)
    assert [entry["limit"] for entry in record["inputs"]] == layout.control_limit.tolist()
    varies = {entry["name"]: entry["nominal"] for entry in record["parameters"]}
    assert varies == dict(zip(layout.parameters.names, layout.parameters.nominal.tolist(), strict=True))
    assert load_scene(record["scene"]) == load_scene(name)
    assert main(["scenes", "show", name]) == SUCCESS
    output = capsys.readouterr().out
    assert ("Parameters, " in output) == (layout.n_p > 0)
    assert f"State, {layout.n_x} numbers; tangent, {layout.n_t}" in output
    assert f"Inputs, {layout.n_u} numbers" in output


def test_show_has_phases(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "show", "capture-and-detumble"]) == SUCCESS
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["approach", "799", "payload:", "null"] in shown
    assert ["detumble", "700", "cost.base_velocity:", "300", "0.5", "degrees"] in shown
    assert ["cost.pose:", "50", "0.01", "m"] in shown


def test_show_says_what_a_constraint_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fixed, file = {"frame": "base", "radius": 1.0}, tmp_path / "constrained.yaml"
    apart = {"name": "apart", "kind": "distance", "bodies": [fixed], "obstacles": [fixed]}
    exact = {"name": "exact", "kind": "terminal", "exact": ["pose"]}
    load_scene("planar").replace(constraints=[apart, exact]).to_yaml(file)
    assert main(["scenes", "show", str(file)]) == SUCCESS
    output = capsys.readouterr().out
    assert "apart: distance, no row: its volumes never meet" in output
    assert "exact: terminal, at the end" in output


def test_show_says_that_thrusters_only_push(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("thrusters", "planar"):
        assert main(["scenes", "show", name]) == SUCCESS
        output = " ".join(capsys.readouterr().out.split())
        assert ("numbers; forces of thrusters are 0 or more" in output) == (name == "thrusters")
        assert ("in [-1, 1]; thrusters are off at 0 and below" in output) == (name == "thrusters")


def test_show_has_zeros_for_what_rounding_leaves_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = {"pose": {"position": [1.7, 1.7, 1.7], "rotation": {"axis": [0, 0, 1], "angle": 90}}}
    file = tmp_path / "turned.yaml"
    load_scene("paper").replace(target=turned, parameters=["target.pose"]).to_yaml(file)
    assert main(["scenes", "show", str(file)]) == SUCCESS
    assert "e-1" not in capsys.readouterr().out


def test_what_is_left_out_is_said() -> None:
    paper, wheels, payload = (set(left_out(load_scene(n))) for n in ("paper", "reaction-wheels", "payload"))
    assert "wrist" in payload - paper
    assert "payload" in paper - payload
    assert "thrusters: no force on the base" in wheels - paper


@pytest.mark.parametrize(
    ("name", "drawn", "same"),
    [
        ("wheels", "wheel_speeds", "target and of masses and inertias"),
        ("tumbling-target", "target_angular_velocity", "start and of masses and inertias"),
        ("tumbling-target", "grasp_position", "start and of masses and inertias"),
        ("payload", "payload_mass", "start and of target"),
    ],
)
def test_what_is_not_drawn_is_said(name: str, drawn: str, same: str) -> None:
    scene = load_scene(name).replace(spread=Spread.model_validate({drawn: 0.01}))
    assert f"random draws of {same}: the same in every episode" in left_out(scene)


def test_problems_come_with_their_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text(BROKEN)
    found = {problem.field: problem.line for problem in check(str(file))}
    assert found == {
        "base.mass": 2,
        "links[0].mas": 5,
        "links[0].mass": 4,
        "links[0].inertia": 6,
        "links[0].joint.position": 8,
        "simulation.integrator": 12,
    }
    assert main(["scenes", "validate", str(file), "paper"]) == FAILURE
    output = capsys.readouterr().out
    assert f"{file}:2: base.mass = -5: must be" in output
    assert "paper: valid" in output
    assert main(["scenes", "validate", "--json", str(file), "paper"]) == FAILURE
    broken, paper = json.loads(capsys.readouterr().out)
    assert not broken["valid"]
    assert len(broken["problems"]) == len(found)
    assert paper == {"file": "paper", "valid": True, "problems": [], "advice": None, "warnings": []}


def test_a_valid_scene_whose_steps_blow_up_is_told_what_to_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = load_scene("paper")
    links = [link.model_dump() | {"damping": 300.0} for link in scene.links]
    file = tmp_path / "damped.yaml"
    file.write_text(scene.replace(links=links).to_yaml(), encoding="utf-8")
    assert main(["scenes", "validate", str(file)]) == SUCCESS
    printed = capsys.readouterr().out
    assert f"{file}: warning: joints" in printed
    assert (
        "where rk4 is unstable in steps of 0.015 s: set simulation.integrator to rodas4, or dt to" in printed
    )
    file.write_text(
        scene.replace(links=links, simulation={"integrator": "rodas4"}).to_yaml(), encoding="utf-8"
    )
    assert main(["scenes", "validate", str(file)]) == SUCCESS
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"{file}: valid"
    assert second.startswith(f"{file}: warning: torque limits: 3 of them are out of proportion")


def test_shipped_scenes_come_without_warnings_but_for_light_hands() -> None:
    """The hands of `dual-arm` weigh 1 kg, and have 10 N m: they whirl under random inputs."""
    assert [name for name in list_scenes() if warnings_of(load_scene(name))] == ["dual-arm"]
    (sentence,) = warnings_of(load_scene("dual-arm"))
    assert re.search(
        "torque limits: 2 of them are out of proportion, the most 10 N m of '.* hand', 2,377 times", sentence
    )


MANY = {"name": "l", "kind": "joint_limits", "lower": -170, "upper": [170, 0.5, 1]}


SCREW = {
    **{"links.2.joint_type": "screw", "links.2.pitch": 0.01, "actuators.base_force": None},
    "constraints": [{"name": "l", "kind": "joint_limits", "lower": -6.0, "upper": 6.0}],
    "target.pose.position": [9, 0, 0],
}


NEAR = {
    "name": "ball",
    "kind": "distance",
    "bodies": [{"frame": "base", "to": [0.75, 0, 0], "radius": 0.05}],
    "obstacles": [{"frame": "inertial", "position": [0.5, 0, 0], "radius": 0.1}],
}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"links.0.name": "tip", "links.2.name": "inertial"},
            r"links\[0\].name: 'tip' is also a frame of every scene: .* the link Likewise links\[2\].name$",
        ),
        ({"links.1.joint.position": [0, 0, 200]}, r"links\[1\].joint.position: 200 m .*: millimeters\?"),
        (
            {f"links.{i}.center_of_mass": [500, 0, 0] for i in (0, 2)},
            r"links\[0\].center_of_mass: 500 m from .*: millimeters\? Likewise links\[2\].center_of_mass$",
        ),
        (
            {"payload": {"mass": 5, "inertia": [1, 1, 1], "center_of_mass": [0, 90, 0]}},
            r"payload.center_of_mass: 90 m from the body's frame: millimeters\?$",
        ),
        (
            {"actuators.base_torque.limit": 1e9},
            r"actuators.base_torque.limit: 1e\+09 N m accelerate the base by",
        ),
        (
            {"actuators.base_force.limit": 1e4},
            r"actuators.base_force.limit: 10000 N accelerate .* 95.2 m/s\^2: act",
        ),
        (
            {"success.position_error": 1e-12},
            "success.position_error: 1e-12, as small as what rounding leaves",
        ),
        ({"tip.position": [850, 0, 0]}, r"tip.position: 850 m from the last joint: millimeters\?"),
        ({"initial_state.joint_angles": [-30, 50, -90]}, r"initial_state.joint_angles: -30 rad: degrees\?"),
        ({"initial_state.joint_rates": [0, 90, 0]}, r"initial_state.joint_rates: 90 rad/s: degrees\?"),
        (
            {
                f"{key}.rotation": {"axis": [0, 0, 1], "angle": angle}
                for key, angle in (("links.1.joint", 1.57), ("target.pose", -3.1416))
            },
            r"links\[1\].joint.rotation: 1.57 degrees: radians\? Likewise target.pose.rotation$",
        ),
        (
            {"constraints": [MANY]},
            r"constraints: limits of 'link 1': -170 rad: degrees\? Likewise 'link 2', 'link 3'$",
        ),
        (
            {"constraints": [{"name": "l", "kind": "joint_limits", "rate": [1, 30, 1]}]},
            r"constraints: limits of 'link 2': 30 rad/s: degrees\?$",
        ),
        (
            {"target.motion": {"kind": "waypoints", "points": [{"time": t, "pose": {}} for t in (0, 20)]}},
            r"target.motion.points\[1\].time: 20 s, after the end of the episode at 15 s: the target",
        ),
        (
            {"target.motion": {"kind": "waypoints", "points": [{"time": 1, "pose": {}}]}},
            r"target.motion.points\[0\].pose: is not target.pose, from where the body moves as the points do",
        ),
        (
            {"target.motion": {"kind": "tumbling", "inertia": [4, 5, 6], "angular_velocity": [1, 3, 2]}},
            r"target.motion.angular_velocity: 3.74 rad/s: degrees per second\?",
        ),
        (
            {
                "links.0.joint_type": "prismatic",
                "constraints": [{"name": "l", "kind": "joint_limits", "upper": [500, 3, 3]}],
            },
            r"constraints: limits of 'link 1': 500 m: millimeters\?",
        ),
        ({"simulation.dt": 15}, r"simulation.dt: 15 s: milliseconds\?"),
        ({"success.attitude_error_deg": 180}, "success.attitude_error_deg: 180 degrees, half a turn: no att"),
        ({"simulation.steps": 100}, r"simulation.steps: an episode of 1.5 s for .* m and .* degrees to the"),
        (
            {"base.mass": 20},
            "base.mass: 20 kg, lighter than the arm of 25 kg: is the spacecraft missing, .* imported robot",
        ),
        ({"base.mass": 105000}, r"base.inertia: .* 105000 kg that is 12 mm wide: a mass in grams"),
        ({"base.inertia": [0.2, 0.1, 0.2]}, r"base.inertia: .* 105 kg that is 49 mm wide: .*other units\?"),
        ({"links.1.inertia": [300, 300, 200]}, r"links\[1\].inertia: .* kg that is .* m wide, .* 2.4 m long"),
        (
            {f"links.{i}.mass": 0.004 for i in range(3)},
            r"links\[0\].mass: 4 g of 'link 1': .* kg\? Likewise links\[1\].mass, links\[2\].mass$",
        ),
        ({"spread.joint_angles": 10}, r"spread: draws of angles by more than half a turn, rad: degrees\?"),
        ({"links.0.mass": 0.004}, r"links\[0\].mass: 4 g of 'link 1': was it meant in other units than kg\?"),
        ({"links.0.mass": 5e9}, r"links\[0\].inertia: .* 5e\+09 kg that is 0.0039 mm wide: a mass in grams"),
        ({"links.0.inertia": [5e4, 5e4, 5e4]}, r"links\[0\].inertia: .* 5 kg that is 122 m wide, .*kg mm\^2"),
        ({"links.2.torque_limit": 900}, "torque limits: 900 N m of 'link 3', [0-9]+ times what a swing"),
        ({"links.0.torque_limit": 0.01}, "torque limits: 0.01 N m of 'link 1', 0.00[0-9]+ of what .* crawl"),
        (
            {"constraints": [{"name": "l", "kind": "joint_limits", "lower": 0.0}]},
            "initial_state: constraint 'l: link 1 lower': violated by 0.6 rad Likewise 'l: link 3 lower'$",
        ),
        (
            {"constraints": [NEAR]},
            "initial_state: constraint 'ball: base 0 to inertial 0': violated by 0.15 m$",
        ),
        (
            {"actuators.base_force": None, "target.pose.position": [9, 0, 0]},
            r"target: [0-9.]+ m from the center of mass, from which the arm reaches 2.96 m: it is out of",
        ),
        (SCREW, "target: [0-9.]+ m from the center of mass, from which the arm reaches 3.03 m: it is out of"),
        (
            {"target.pose.position": [900, 0, 0]},
            r"target: 90[0-9] m .*, thrusters move it by [0-9.]+ m in 15 s: it is out of reach",
        ),
    ],
)
def test_the_unwise_is_warned_of(change: dict[str, object], sentence: str) -> None:
    found = warnings_of(load_scene("no-wrist").replace(change))
    assert any(re.match(sentence, each) for each in found), found


def test_episodes_that_all_begin_alike_are_warned_of() -> None:
    same = "spread: there is none, so all episodes begin alike, and agents see one start:"
    scene = load_scene("no-wrist").replace(spread=Spread())
    assert warnings_of(scene) == [f"{same} give widths, such as joint_angles: 0.2 (rad)"]
    assert warnings_of(scene.replace(spread={"target_position": 0.1})) == []
    body = {"mass": 50.0, "inertia": [3, 3, 3]}
    force = {"base_force": {"limit": 10.0}, "base_torque": {"limit": 2.0}}
    alone = load_scene({"name": "body", "base": body, "actuators": force, "target": {"pose": {}}})
    assert warnings_of(alone) == [f"{same} give widths, such as base_rotation: 0.2 (rad)"]


def test_scenes_that_environments_refuse_are_warned_of() -> None:
    scene = load_scene("no-wrist")
    (none,) = warnings_of(scene.replace(actuators=Actuators()))
    assert none.startswith("actuators: there is none, so there is nothing to solve or to learn: give one")
    changes = {"actuators.base_torque.limit": [1.0, math.inf, 1.0], "links.1.torque_limit": math.inf}
    assert warnings_of(scene.replace(changes)) == [
        "actuators: base torque y, link 2 torque without a finite limit: the environment refuses the scene, "
        "and nothing learns in it"
    ]


def test_goals_of_other_tips_out_of_reach_are_warned_of_too() -> None:
    far = "m from the center of mass, from which the arm reaches 2.52 m: it is out of reach$"
    scene = load_scene("dual-arm").replace({"actuators.base_force": None})
    for change, where in (
        ({"goal.position": [-6, 0, 0]}, r"other_tips\[0\].goal: 5.58"),
        ({"goal.position": [0, 2, 0], "relative_to": "inertial"}, None),
        ({"goal.position": [0, -6, 0], "relative_to": "inertial"}, r"other_tips\[0\].goal: 6.13"),
    ):
        changes = {f"other_tips.0.{key}": value for key, value in change.items()}
        found = [each for each in warnings_of(scene.replace(changes)) if "out of reach" in each]
        assert len(found) == (where is not None)
        assert where is None or re.match(f"{where} {far}", found[0]), found


@pytest.mark.parametrize(
    ("change", "sentences"),
    [
        ({"target.motion.inertia": [6.8, 8.4, 9.2]}, []),
        ({"target.grasp": {"position": [-0.3501, 0, 0]}}, []),
        (
            {"payload.center_of_mass": [0.5, 0.4, 0]},
            [
                r"payload.center_of_mass: 0.427 m from the target's origin, .* changes without a force; "
                r"\[0.35, 0, 0\] is there$"
            ],
        ),
        (
            {"target.grasp.rotation": {"axis": [0, 0, 1], "angle": 90}},
            [
                r"payload.center_of_mass: 0.495 m .*; \[0, -0.35, 0\] is there$",
                r"target.motion.inertia: not in the ratios of payload.inertia, .*; \[4.2, 3.4, 4.6\] is the",
            ],
        ),
        (
            {"payload.inertia": [[4, 0.5, 0], [0.5, 4, 0], [0, 0, 4]]},
            [r"target.motion.inertia: .*; \[\[4, 0.5, 0\], \[0.5, 4, 0\], \[0, 0, 4\]\] is the payload's$"],
        ),
        ({"payload.center_of_mass": [0.5, 0.4, 0], "target.motion": {"kind": "screw"}}, []),
    ],
)
def test_a_payload_that_is_not_the_body_that_tumbles_is_warned_of(
    change: dict[str, object], sentences: list[str]
) -> None:
    found = warnings_of(load_scene("capture-and-detumble").replace(change))
    assert len(found) == len(sentences), found
    for sentence, warning in zip(sentences, found, strict=True):
        assert re.match(sentence, warning), warning


def test_thrusters_also_move_what_other_tips_hold() -> None:
    scene = load_scene("dual-arm").replace({"target.pose.position": [60, 0, 0]})
    held = {"mass": 768.0, "inertia": [9, 9, 9]}  # kg: with the robot 1000
    moved = [
        float(re.findall(r"thrusters move it by ([0-9.]+) m", warnings_of(each)[-1])[0])
        for each in (scene, scene.replace({"other_tips.0.payload": held}))
    ]
    assert moved[1] == pytest.approx(0.232 * moved[0], rel=0.01)


@pytest.mark.parametrize(
    ("text", "line"), [("name: [1\nbase: 2\n", 2), ("name: a\nname: b\n", 2), ("", None)]
)
def test_files_that_are_no_scenes_have_one_problem(text: str, line: int | None, tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(text)
    assert [(problem.line, problem.field) for problem in check(str(file))] == [(line, None)]
    assert [problem.message for problem in check("nowhere.yaml")] == ["there is no such file"]


@pytest.mark.parametrize("name", list_scenes())
def test_a_new_file_is_the_scene_with_comments(name: str) -> None:
    scene = load_scene(name)
    text = commented_yaml(scene)
    assert load_scene(parse_yaml(text)) == scene
    assert all(len(line) <= 110 for line in text.splitlines())
    assert "mass of the base, kg" in text


@pytest.mark.parametrize(
    "text",
    [
        'a "b" \\ c',
        "two\nlines",
        "tab\t",
        "next\u0085line",
        "1e3",
        "true",
        "手/ü",
        "#a: b",
        "\U0001f680\ntwo",
    ],
)
def test_a_description_may_be_any_text_and_a_name_any_that_can_be_shown(text: str) -> None:
    scene = load_scene("planar").replace(name=" ".join(text.split()), description=text)
    assert load_scene(parse_yaml(commented_yaml(scene))) == scene


def test_new_writes_a_valid_file_and_spoils_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "deep" / "mine.yaml"
    assert main(["scenes", "new", str(file), "--from", "planar"]) == SUCCESS
    assert load_scene(file) == load_scene("planar").replace(name="mine")
    assert main(["scenes", "new", str(file)]) == UNUSABLE
    assert "exists: give another name, or --force" in capsys.readouterr().err
    assert load_scene(file).base.motion == "planar"
    assert main(["scenes", "new", str(file), "--force", "--name", "other", "--json"]) == SUCCESS
    assert json.loads(capsys.readouterr().out) == {"file": str(file), "name": "other", "from": "paper"}
    assert load_scene(file) == load_scene("paper").replace(name="other")
    assert main(["scenes", "new", str(tmp_path / "mine.txt")]) == UNUSABLE
    assert "must end in .yaml" in capsys.readouterr().err
    assert main(["scenes", "new", "-", "--from", "payload"]) == SUCCESS
    assert load_scene(parse_yaml(capsys.readouterr().out)) == load_scene("payload")
    for name in ("capture-and-detumble", "refuelling"):  # whose phases have numbers of any type
        assert main(["scenes", "new", "-", "--from", name]) == SUCCESS
        again = load_scene(parse_yaml(capsys.readouterr().out))
        assert again.content_hash() == load_scene(name).content_hash()
