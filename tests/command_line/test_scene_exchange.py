"""`scenes import` and `scenes export`: what they write can be flown, and mistakes are told in options."""

import json
import math
import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import click
import numpy as np
import pytest

from dq_space_arm_env import load_scene, scene_from_urdf, scene_to_mjcf, scene_to_urdf
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.names import PartOf
from dq_space_arm_env.command_line.scene_warnings import tip_directions
from dq_space_arm_env.common.console import SUCCESS, UNUSABLE
from dq_space_arm_env.dynamics.step_stability import joint_motion
from dq_space_arm_env.interoperability.step_choice import StepTrial, best_of
from dq_space_arm_env.interoperability.swing_efforts import swing_efforts
from dq_space_arm_env.scene.thrusters import allocate
from experts import Solution

ARM = str(Path(__file__).parents[2] / "scripts" / "examples" / "small-arm.urdf")
HAND = ["import", ARM, "--tip", "hand"]
AS_IT_IS = ["--full-efforts", "--spread", "0", "--no-measure"]
ARMS = Path(__file__).parents[1] / "interoperability" / "arms"
CARRIED = ["--spacecraft-mass", "80", "--spacecraft-inertia", "8", "8", "6"]
SPACECRAFT = {"mass": 80, "inertia": [8, 8, 6]}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_imported_file_is_the_scene_with_comments(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", *HAND, *CARRIED, *AS_IT_IS]) == SUCCESS
    printed = capsys.readouterr().out
    expected = scene_from_urdf(ARM, "hand", name="small-arm", spacecraft=SPACECRAFT)
    assert load_scene("small-arm.yaml") == expected
    assert "# mass of the base, kg" in (here / "small-arm.yaml").read_text(encoding="utf-8")
    assert "34.4 degrees and 0.415 m" in printed
    assert main(["scenes", "validate", "small-arm.yaml"]) == SUCCESS


def test_every_argument_has_an_option(here: Path) -> None:
    options = ["--base-force", "0", "--base-torque", "3", "--passive", "elbow", "--joint-torque", "7"]
    words = ["--name", "mine", "--out", "deep/mine.yaml", *options, *CARRIED]
    words += AS_IT_IS
    assert main(["scenes", "import", ARM, "--tip", "forearm", "--base", "mount", *words]) == SUCCESS
    forces = {"base_force": None, "base_torque": 3, "joint_torque": 7, "passive": ["elbow"]}
    expected = scene_from_urdf(ARM, "forearm", "mount", name="mine", spacecraft=SPACECRAFT, **forces)
    assert load_scene("deep/mine.yaml") == expected.replace(success={"position_error": 0.04})  # of 0.18 m


def test_the_import_proposes_what_free_flight_takes(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(ARM).read_text(encoding="utf-8").replace('effort="2"', 'effort="870"')
    Path("strong.urdf").write_text(text, encoding="utf-8")
    words = ["scenes", "import", "strong.urdf", "--tip", "hand", *CARRIED, "--mount", "0.1", "0", "0.5"]
    assert main([*words, "--mount-rotation", "0", "0", "90"]) == SUCCESS
    printed = " ".join(capsys.readouterr().out.split())
    rotation = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    mount = {"position": [0.1, 0.0, 0.5], "rotation": rotation}
    scene, found = (
        scene_from_urdf(text, "hand", spacecraft=SPACECRAFT | {"mount": mount}),
        load_scene("strong.yaml"),
    )
    for link, own, effort in zip(found.links, scene.links, swing_efforts(scene), strict=True):
        assert link.torque_limit == pytest.approx(min(3.0 * effort, own.torque_limit), rel=0.05)
    assert found.links[0].joint.position == pytest.approx(scene.links[0].joint.position)
    assert "scaled for free flight to three times what a swing by 1 rad in seconds takes" in printed
    assert "870 N m" in printed
    assert f"base {scene.base.mass:g} kg" in printed
    assert "--full-efforts keeps them" in printed
    assert found.spread.joint_angles == found.spread.base_rotation == found.spread.base_position == 0.1
    assert "a swing by rk4 of 15 ms ends" in printed
    assert main(["scenes", "validate", "strong.yaml"]) == SUCCESS
    assert capsys.readouterr().out == "strong.yaml: valid\n"
    assert main([*words, "--full-efforts", "--force"]) == SUCCESS
    said = capsys.readouterr().err
    assert "Warning: torque limits: " in said
    assert all(len(line) <= 80 for line in said.splitlines())
    assert main(["scenes", "validate", "strong.yaml"]) == SUCCESS
    assert "warning: torque limits: " in capsys.readouterr().out


def test_slides_have_units_of_their_own_and_lines_fit(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    text = Path(ARM).read_text(encoding="utf-8").replace('effort="2"', 'effort="1500"', 1)
    text = text.replace('name="shoulder" type="revolute"', 'name="shoulder" type="prismatic"')
    Path("arm.urdf").write_text(text, encoding="utf-8")
    words = ["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED, *AS_IT_IS]
    assert main(words) == SUCCESS
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= 60 for line in lines if "`" not in line)
    printed = " ".join(" ".join(lines).split())
    assert "joints 2 N m; slides 1500 N;" in printed
    assert re.search(r"joints at [0-9.]+ rad, slides at [0-9.]+ m;", printed)
    assert main([*words, "--passive", "elbow", "--force"]) == SUCCESS
    assert "slides 1500 N; passive: forearm;" in " ".join(capsys.readouterr().out.split())


def test_light_dampers_that_whole_steps_follow_are_no_matter(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = Path(ARM).read_text(encoding="utf-8").replace("<limit", '<dynamics damping="3"/><limit')
    Path("arm.urdf").write_text(text, encoding="utf-8")
    assert main(["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED]) == SUCCESS
    simulation = load_scene("arm.yaml").simulation
    assert simulation.dt * joint_motion(load_scene("arm.yaml")).decay > 1.0
    assert (simulation.integrator, simulation.dt) == ("rk4", 0.015)
    assert "dampers" not in capsys.readouterr().out


def test_a_page_of_others_is_not_replaced(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("arm.html").write_text("my own page")
    words = ["scenes", "import", ARM, "--tip", "hand", *CARRIED, "--replay", "--out", "arm.yaml"]
    assert main(words) == UNUSABLE
    assert "arm.html exists: give another name, or --force" in capsys.readouterr().err
    assert Path("arm.html").read_text() == "my own page"


def test_torques_that_the_user_gives_stay(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(ARM).read_text(encoding="utf-8").replace('effort="2"', 'effort="0"', 1)
    text = text.replace('effort="2"', 'effort="870"')
    Path("arm.urdf").write_text(text, encoding="utf-8")
    words = [
        "scenes",
        "import",
        "arm.urdf",
        "--tip",
        "hand",
        *CARRIED,
        "--joint-torque",
        "400",
        "--no-measure",
    ]
    assert main(words) == SUCCESS
    limits = [link.torque_limit for link in load_scene("arm.yaml").links]
    assert limits.count(400.0) == 1
    scaled = capsys.readouterr().out.partition("scaled")[2]
    assert "870 N m" in scaled
    assert "400" not in scaled


def test_wheels_and_jets_are_in_size_for_the_spacecraft(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*CARRIED, "--wheels", "pyramid", "--thrusters", "jets", "--base-force", "4", "--no-measure"]
    assert main(["scenes", *HAND, *words]) == SUCCESS
    assert "8 jets of 2 N; 4 wheels of 0.15" in " ".join(capsys.readouterr().out.split())
    scene = load_scene("small-arm.yaml")
    assert scene.actuators.base_force is scene.actuators.base_torque is None
    for axis in np.vstack([np.eye(6), -np.eye(6)]):
        forces = allocate(scene, axis[:3], axis[3:])
        wrench = sum(
            force * np.array([*jet.unit_direction, *jet.moment])
            for force, jet in zip(forces, scene.actuators.thrusters, strict=True)
        )
        assert wrench == pytest.approx(axis, abs=1e-9)
    share = scene.base.mass / 105.0
    assert scene.actuators.wheels[0].inertia == pytest.approx(0.0075 * share, rel=0.01)
    assert [each.kind for each in scene.constraints][-1] == "wheel_limits"
    assert main(["scenes", "validate", "small-arm.yaml"]) == SUCCESS


def test_jets_sit_on_flat_spacecraft_too(here: Path) -> None:
    """One moment is the sum of the others, which rounding may pass."""
    flat = ["--spacecraft-mass", "80", "--spacecraft-inertia", "6.41", "6.97", "13.38"]
    assert main(["scenes", *HAND, *flat, "--thrusters", "jets", "--no-measure"]) == SUCCESS
    scene = load_scene("small-arm.yaml")
    jets = np.array([[*jet.unit_direction, *jet.moment] for jet in scene.actuators.thrusters])
    assert np.linalg.matrix_rank(jets) == 6


def test_starts_are_drawn_within_the_limits(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(ARM).read_text(encoding="utf-8").replace('lower="-3" upper="3"', 'lower="0" upper="0.1992"')
    Path("arm.urdf").write_text(text, encoding="utf-8")
    words = ["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED, "--spread", "0.1", "--no-measure"]
    assert main(words) == SUCCESS
    scene = load_scene("arm.yaml")
    assert scene.initial_state.joint_angles[0] == pytest.approx(0.0996)
    assert 0.09 < scene.spread.joint_angles < 0.0996
    assert "of all joints" not in capsys.readouterr().err
    assert main([*words, "--force", "--spread", "0.2"]) == SUCCESS
    warning = " ".join(capsys.readouterr().err.split())
    assert "within 0.095 rad (m), where 0.2 was asked: upper arm is 0.1 from a stop" in warning


def test_stiff_dampers_take_short_steps_or_a_stiff_method(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """rk4 follows dampers in steps of 2.785 of their time constant."""
    text = Path(ARM).read_text(encoding="utf-8")
    for damping, method, parts in ((0.0, "rk4", 1), (9.0, "rk4", None), (3000.0, "rodas4", 1)):
        damped = text.replace("<limit", f'<dynamics damping="{damping}"/><limit')
        Path("arm.urdf").write_text(damped, encoding="utf-8")
        words = ["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED, "--force"]
        if method == "rodas4":
            Path("arm.yaml").unlink()
            assert main(words) == UNUSABLE
            assert "--no-dampers leaves them out, --dampers keeps them" in capsys.readouterr().err
            assert not Path("arm.yaml").exists()
        assert main([*words, *["--dampers"] * (method == "rodas4")]) == SUCCESS
        found = load_scene("arm.yaml")
        simulation = found.simulation
        assert simulation.integrator == method
        assert simulation.steps * simulation.dt == pytest.approx(15.0)
        division = round(0.015 / simulation.dt)
        assert division == parts or (parts is None and division > 1)
        printed = " ".join(capsys.readouterr().out.split())
        assert ("--no-dampers leaves them out" in printed) == (damping > 0)
        taken = "this" if damping == 0 else f"{method} of {1e3 * simulation.dt:.3g} ms"
        assert f"{taken} is taken" in printed
        if method == "rk4" and damping:
            used = simulation.dt * joint_motion(found).decay
            assert used < 2.785 < 2.0 * used
    assert main([*words, "--no-dampers", "--json"]) == SUCCESS
    record = json.loads(capsys.readouterr().out)
    assert [(each["integrator"], each["division"]) for each in record["steps"]] == [("rk4", 1)]
    assert record["steps"][0]["error"] < 1e-4


def test_of_inaccurate_steps_the_best_are_taken_and_said(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    errors = {("rk4", 1): 3e-2, ("rk4", 2): math.inf, ("rk4", 4): 3e-4, ("rodas4", 1): 4e-2}
    trials = [StepTrial(*how, error, 1.0) for how, error in errors.items()]
    monkeypatch.setattr("dq_space_arm_env.command_line.scene_exchange.measured_steps", lambda scene: trials)
    assert main(["scenes", *HAND, *CARRIED]) == SUCCESS
    simulation = load_scene("small-arm.yaml").simulation
    assert (simulation.integrator, simulation.dt, simulation.steps) == ("rk4", 0.00375, 4000)
    said = capsys.readouterr()
    assert "rk4 of 3.75 ms is taken" in " ".join(said.out.split())
    assert "simulation: the best steps that were tried end 3e-04 m or rad off" in said.err
    diverging = [trial._replace(error=math.inf) for trial in trials]
    assert best_of(diverging).integrator == "rodas4"


def test_a_robot_that_cannot_turn_back_does_not_start_turned(here: Path) -> None:
    floating = ["--base-force", "0", "--base-torque", "0", "--no-measure"]
    words = ["scenes", *HAND, *CARRIED, "--spread", "0.1"]
    assert main([*words, *floating]) == SUCCESS
    spread = load_scene("small-arm.yaml").spread
    assert (spread.joint_angles, spread.base_rotation, spread.base_position) == (0.1, 0.0, 0.0)
    assert main([*words, "--no-measure", "--force"]) == SUCCESS
    assert load_scene("small-arm.yaml").spread.base_rotation == 0.1
    kept = [tip_directions(load_scene(name)) for name in ("six-joint", "paper", "planar", "small-arm.yaml")]
    assert kept == [6, 6, 3, 2]


def test_joints_beside_the_arm_are_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(ARM).read_text(encoding="utf-8")
    inertial = re.search(r"<inertial>.*?</inertial>", text, re.DOTALL)
    assert inertial is not None
    joint = '<joint name="mast" type="continuous"><parent link="mount"/><child link="antenna"/></joint>'
    more = f'<link name="antenna">{inertial[0]}</link>{joint}</robot>'
    Path("arm.urdf").write_text(text.replace("</robot>", more), encoding="utf-8")
    words = ["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED, "--no-measure", "--joint-torque", "1"]
    assert main(words) == SUCCESS
    printed = " ".join(capsys.readouterr().out.split())
    assert "beside the way to the tip 1 more move: antenna; --lock-branches holds all" in printed
    assert main([*words, "--lock-branches", "--force"]) == SUCCESS
    assert "beside" not in capsys.readouterr().out


def test_shapes_that_are_left_out_are_counted_and_absent_limits_named(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = '<visual><geometry><sphere radius="1"/></geometry></visual>'
    text = Path(ARM).read_text(encoding="utf-8")
    drawn = text.replace("</link>", f"{shape}</link>").replace('type="revolute"', 'type="continuous"')
    drawn = re.sub("velocity=[^ /]*", "", drawn)
    Path("arm.urdf").write_text(drawn, encoding="utf-8")
    assert main(["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED, *AS_IT_IS]) == SUCCESS
    printed = " ".join(capsys.readouterr().out.split())
    assert f"shapes left out: {text.count('</link>')}; edit geometry" in printed
    assert "joints without limits of the angle or the rate; constraints of kind joint_limits" in printed
    assert main(["scenes", *HAND, *CARRIED, *AS_IT_IS]) == SUCCESS
    printed = " ".join(capsys.readouterr().out.split())
    assert "shapes" not in printed
    assert re.search("joints [12] with limits of the angle", printed)


def test_all_links_without_mass_are_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = re.sub(r"<inertial>.*?</inertial>", "", Path(ARM).read_text(encoding="utf-8"), flags=re.DOTALL)
    Path("arm.urdf").write_text(text, encoding="utf-8")
    assert main(["scenes", "import", "arm.urdf", "--tip", "hand", *CARRIED]) == UNUSABLE
    said = capsys.readouterr().err
    assert "link 'upper arm', moved by joint 'shoulder'; link 'forearm', moved by joint 'elbow', have" in said


@pytest.mark.slow
def test_the_first_maneuver_opens_in_the_browser(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert main(["scenes", *HAND, *CARRIED, "--replay"]) == SUCCESS
    assert opened == [(here / "small-arm.html").resolve().as_uri()]
    assert "small-arm.html: the first maneuver reaches the target at J = " in capsys.readouterr().err
    assert "<html" in (here / "small-arm.html").read_text(encoding="utf-8")


def test_import_spoils_no_file(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["scenes", *HAND, *CARRIED]
    (here / "small-arm.yaml").write_text("mine")
    assert main(words) == UNUSABLE
    assert "small-arm.yaml exists: give another name, or --force" in capsys.readouterr().err
    assert (here / "small-arm.yaml").read_text() == "mine"
    assert main([*words, "--force", "--json"]) == SUCCESS
    record = json.loads(capsys.readouterr().out)
    assert record["links"] == ["upper arm", "forearm"]
    assert record["start_attitude_error_deg"] == pytest.approx(34.3775, abs=1e-4)
    assert record["warnings"] == []
    assert load_scene("small-arm.yaml").name == "small-arm"
    assert main([*words, "--out", "arm.txt"]) == UNUSABLE


def test_fingers_that_others_mimic_are_no_tips(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The import refuses them, as a scene's joints move by themselves; what has no mass may mimic any."""
    body = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    text = Path(ARM).read_text(encoding="utf-8").replace("</robot>", "")
    for name, mimics, content in (("finger", "", body), ("other", "finger", body), ("dial", "shoulder", "")):
        text += f'<link name="{name}">{content}</link><joint name="{name}" type="revolute">'
        text += f'<parent link="hand"/><child link="{name}"/>'
        text += f'<mimic joint="{mimics}"/></joint>' if mimics else "</joint>"
    Path("gripper.urdf").write_text(f"{text}</robot>", encoding="utf-8")
    Path("gripper.yaml").touch()  # is not written
    assert main(["scenes", "import", "gripper.urdf"]) == UNUSABLE
    Path("gripper.yaml").unlink()
    listed = " ".join(capsys.readouterr().err.split())
    assert re.search(": hand 2 joints, .* others mount, upper arm, forearm, finger, other, dial$", listed)
    assert main(["scenes", "import", "gripper.urdf", "--tip", "finger", *CARRIED]) == UNUSABLE
    assert "joint 'other' mimics joint 'finger' of the chain" in capsys.readouterr().err


def test_the_robot_that_is_read_is_not_replaced_even_by_force(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, words in (
        ("arm.yaml", ["import", "arm.yaml", "--tip", "hand", *CARRIED]),
        ("scene.yaml", ["export", "scene.yaml", "--out", "./scene.yaml"]),
    ):
        Path(name).write_text("mine", encoding="utf-8")
        assert main(["scenes", *words, "--force"]) == UNUSABLE
        assert f"{name} is what is read, which it would replace" in capsys.readouterr().err
        assert Path(name).read_text(encoding="utf-8") == "mine"
    assert main(["scenes", "export", "no-wrist", "--out", "no-wrist"]) == SUCCESS  # a name is no file


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["import", ARM],
            "--tip LINK is missing, .*\n  hand  2 joints, [0-9.]+ m from the base\n  others  mount, upper ",
        ),
        (
            ["import", ARM, "--base", "forearm"],
            "reach the target:\n  others  mount, upper arm, forearm, hand$",
        ),
        (["import", ARM, "--base", "arm"], "--base: 'arm' is not a link of"),
        (["import", ARM, "--tip", "hnd"], "--tip: 'hnd' is not a link of 'small arm'; did you mean 'hand'"),
        (HAND, "give the spacecraft .*, --spacecraft-mass and --spacecraft-inertia$"),
        ([*HAND, "--spacecraft-mass", "80"], "--spacecraft-inertia need each other"),
        ([*HAND, "--lock-branches", "--lock", "finger"], "leave --lock out"),
        ([*HAND, *CARRIED, "--passive", "j"], "--passive: 'j' is not .* shoulder, elbow"),
        ([*HAND, "--mount", "0", "0", "1"], "--mount places the arm on a spacecraft: give --spacecraft-mass"),
        (
            [*HAND, *CARRIED, "--mount-rotation", "inf", "0", "0"],
            r"--mount-rotation is \(inf, 0.0, 0.0\), should be 3 finite numbers, degrees",
        ),
        (
            [*HAND, *CARRIED, "--wheels", "pyramid", "--base-torque", "3"],
            "--base-torque limits ideal wheels, and those of --wheels pyramid are in size for the base",
        ),
        (
            [*HAND, *CARRIED, "--thrusters", "jets", "--base-force", "0"],
            "--base-force 0 is for no thrusters, and those of --thrusters jets have half of it each",
        ),
        ([*HAND, *CARRIED, "--joint-torque", "0"], "--joint-torque = 0.0: must be a number"),
        (["import", ARM, "--tip", "mount", "--base", "hand"], "choose link '.*', or .* above it, as --base$"),
        (["import", "nowhere.urdf", "--tip", "hand"], "nowhere.urdf: there is no such file"),
        (["export", "paper"], "would be infinite: --wrist fixed writes it at its initial angles"),
        (["export", "planar"], "no base that moves in a plane"),
        (["export", "papr"], "did you mean 'paper'"),
    ],
)
def test_mistakes_are_told_in_options(
    words: list[str], sentence: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scenes", *words, "--out", "arm.yaml"]) == UNUSABLE
    message = capsys.readouterr().err.partition(" (see ")[0].strip()
    assert re.search(sentence, message)
    assert not (here / "arm.yaml").exists()


def test_warnings_and_the_options_that_help(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(ARM).read_text(encoding="utf-8")
    finger = '<joint name="f" type="revolute"><parent link="forearm"/><child link="finger"/></joint>'
    body = text[text.index("<inertial>") : text.index("</inertial>") + len("</inertial>")]
    text = text.replace("</robot>", f'{finger}<link name="finger">{body}</link></robot>')
    text = text.replace('<limit effort="2" velocity="1"/>', '<dynamics friction="1"/>')
    Path("gripper.urdf").write_text(text, encoding="utf-8")
    words = ["scenes", "import", "gripper.urdf", "--tip", "hand", *CARRIED, "--full-efforts"]
    planar = text.replace('name="f" type="revolute"', 'name="my f" type="planar"')
    Path("planar.urdf").write_text(planar, encoding="utf-8")
    assert main(["scenes", "import", "planar.urdf", *words[3:]]) == UNUSABLE
    message = capsys.readouterr().err
    assert "--lock 'my f' holds such joints, --lock-branches all; no effort limit for" in message
    assert main(words) == UNUSABLE
    assert "no effort limit for joint elbow, f: give --joint-torque, N m, for all" in capsys.readouterr().err
    assert main([*words, "--lock-branches"]) == UNUSABLE
    assert "no effort limit for joint elbow: give --joint-torque, N m, for all" in capsys.readouterr().err
    assert main([*words[:-1], "--lock-branches"]) == SUCCESS
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "the file has no effort, or 1e4 and more, for forearm: --joint-torque gives another limit" in printed
    )
    scene = load_scene("gripper.yaml")
    limits = [3.0 * effort for effort in swing_efforts(scene)]
    assert scene.links[1].torque_limit == pytest.approx(limits[1], rel=0.05)
    words.append("--force")
    assert main([*words, "--lock-branches", "--joint-torque", "1"]) == SUCCESS
    assert "Warning: Coulomb friction of elbow is left out" in capsys.readouterr().err
    assert load_scene("gripper.yaml").links[1].mass == 6.0


@pytest.mark.parametrize("name", ["no-wrist", "paper", "payload"])
def test_export_writes_the_robot(name: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = load_scene(name)
    assert main(["scenes", "export", name, "--wrist", "fixed"]) == SUCCESS
    text = capsys.readouterr().out
    assert text == scene_to_urdf(scene, wrist="fixed")
    words = ["scenes", "export", name, "--format", "mjcf", "--wrist", "fixed", "--out", "deep/robot.xml"]
    assert main(words) == SUCCESS
    assert Path("deep/robot.xml").read_text(encoding="utf-8") == scene_to_mjcf(scene, wrist="fixed")
    assert main(words) == UNUSABLE
    assert "exists: give another name, or --force" in capsys.readouterr().err
    assert main([*words, "--force"]) == SUCCESS
    Path("again.urdf").write_text(text, encoding="utf-8")
    assert main(["scenes", "import", "again.urdf", "--tip", "tip"]) == SUCCESS
    assert [link.name for link in load_scene("again.yaml").links] == [link.name for link in scene.links]


def test_names_survive_a_terminal_of_another_encoding(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {f"links.{index}.name": name for index, name in enumerate(("Glied 1", "Händler", "手"))}
    Path("arm.yaml").write_text(load_scene("no-wrist").replace(names).to_yaml(), encoding="utf-8")
    for encoding in ("latin-1", "utf-8"):
        with monkeypatch.context() as patch, Path("arm.urdf").open("w", encoding=encoding) as file:
            patch.setattr("sys.stdout", file)
            assert main(["scenes", "export", "arm.yaml"]) == SUCCESS
        links = scene_from_urdf(Path("arm.urdf"), "tip").links
        assert [link.name for link in links] == [*names.values()]


def test_links_and_joints_are_completed() -> None:
    def words(part: str, file: str | None, incomplete: str) -> list[str]:
        context = click.Context(click.Command("import"))
        context.params["robot"] = file
        found = PartOf(part, "robot").shell_complete(context, click.Option(["--tip"]), incomplete)
        return [item.value for item in found]

    assert words("link", ARM, "") == ["mount", "upper arm", "forearm", "hand"]
    assert words("joint", ARM, "e") == ["elbow"]
    assert words("link", ARM, "x") == words("link", None, "") == words("link", "/", "") == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "path", "tip"),
    [
        ("", ARM, "hand"),
        pytest.param(
            *("airo-models", "airo_models/arms/ur3e/ur3e.urdf", "tool0"), marks=pytest.mark.endurance
        ),
    ],
)
def test_the_maneuver_to_begin_with_is_solved_and_flown(
    package: str, path: str, tip: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        file = str(distribution(package).locate_file(path)) if package else path
    except PackageNotFoundError:
        pytest.skip(f"needs {package}")
    assert main(["scenes", "import", file, "--tip", tip, "--out", "arm.yaml", *CARRIED]) == SUCCESS
    capsys.readouterr()
    assert main(["solve", "arm.yaml", "--json"]) == SUCCESS
    solved = json.loads(capsys.readouterr().out)
    assert solved["converged"]
    assert solved["is_success"]
    plan = str(Path(solved["files"][0]))
    kept = Solution.load(plan).constraints
    assert kept is not None
    assert kept.violation <= 1e-6
    assert load_scene("arm.yaml").constraints[0].name == "joint limits"
    assert main(["simulate", "arm.yaml", "--policy", plan, "--json"]) == SUCCESS
    assert json.loads(capsys.readouterr().out)["is_success"]


def heavy(arm: str, tip: str, *options: str) -> object:
    """An arm like others here, which compiles for half a minute or more."""
    return pytest.param(arm, tip, options, marks=pytest.mark.endurance)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "tip", "options"),
    [
        ("borinot-arm", "flying_arm_2__ee", ()),
        ("so100", "gripper", ()),
        heavy("z1", "link06", "--no-dampers"),
        heavy("open-manipulator-x", "end_effector_link", "--no-dampers"),
        heavy("px100", "px100/ee_arm_link"),
        heavy("so101", "gripper_frame_link"),
        heavy("widowx", "gripper_rail_link"),
        heavy("bravo7", "contact_point"),
        heavy("hextilt-arm", "flying_arm_5__gripper", "--no-dampers"),
        heavy("kinova-j2s6s200", "j2s6s200_end_effector"),
        heavy("panda", "panda_hand_tcp"),
        heavy("ur3e", "tool0"),
        heavy("ur10", "tool0"),
    ],
)
def test_arms_of_others_go_from_import_to_a_successful_maneuver(
    arm: str, tip: str, options: tuple[str, ...], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--tip", tip, "--joint-torque", "5", "--out", "arm.yaml", *CARRIED, *options]
    assert main(["scenes", "import", str(ARMS / f"{arm}.urdf"), *words]) == SUCCESS
    assert main(["scenes", "validate", "arm.yaml"]) == SUCCESS
    capsys.readouterr()
    assert main(["solve", "arm.yaml", "--json"]) == SUCCESS
    solved = json.loads(capsys.readouterr().out)
    assert solved["converged"]
    assert solved["is_success"]
