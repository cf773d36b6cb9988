"""The script that writes pages: what it takes for flights, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from agents import ExportedPolicy
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene, compile_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.replay import _labeled as labeled
from dq_space_arm_env.command_line.replaying import collect_flights
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.viewing.replay import Trajectory, by_scene, common_scene, read_flight


@pytest.fixture
def scene(short_scene: Scene, tmp_path: Path) -> Scene:
    short_scene.to_yaml(tmp_path / "short.yaml")
    return short_scene


@pytest.fixture
def rollout(scene: Scene, tmp_path: Path) -> Path:
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (9, 1))
    states[:, layout.state.joint_angles] += np.linspace(0, 1, 9)[:, None]
    Trajectory("swing", states, np.ones((8, layout.n_u)), scene=scene).save(tmp_path / "swing.npz")
    return tmp_path / "swing.npz"


def save_policy(path: Path, n_obs: int) -> Path:
    """Half of each limit, whatever it observes."""
    weights, biases = (np.zeros((n_obs, 2), np.float32),), (np.full(2, 0.5, np.float32),)
    ExportedPolicy(weights, biases, "relu", np.zeros(n_obs), np.ones(n_obs)).save(path)
    return path


def test_policy_flies_from_where_the_first_flight_starts(rollout: Path, scene: Scene, tmp_path: Path) -> None:
    kernels = compile_scene(scene)
    n_obs = DQSpaceArmVectorEnv(1, scene).reset()[0].shape[1]
    policy = save_policy(tmp_path / "half.npz", n_obs)
    start = read_flight(rollout).states[0]
    sources = [(None, str(rollout)), (None, str(policy))]
    [((_, flight), _)] = collect_flights(sources, scene, Console(quiet=True))
    np.testing.assert_allclose(flight.states[0], start, rtol=0, atol=1e-12)
    assert flight.states.shape[0] == 61
    np.testing.assert_allclose(flight.controls, np.tile([1.0, 0.25], (60, 1)))
    step = kernels.step(flight.states[0], flight.controls[0])
    np.testing.assert_allclose(flight.states[1], step, rtol=0, atol=1e-12)

    # With the target and the masses that its seed has drawn.
    drawn = scene.replace(spread={"target_position": 0.2, "link_masses": 0.1, "joint_angles": 0.3})
    sources = [(None, str(policy))]
    [((first,), _)] = collect_flights(sources, drawn, Console(quiet=True), seed=3)
    first.save(tmp_path / "first.npz")
    sources.insert(0, (None, str(tmp_path / "first.npz")))
    [((_, second), _)] = collect_flights(sources, None, Console(quiet=True))
    assert second.seed == 3
    np.testing.assert_array_equal(second.target, first.target)
    np.testing.assert_array_equal(second.states, first.states)

    # The folder of a solution stands for its file.
    out, folder = tmp_path / "page.html", tmp_path / "solved"
    folder.mkdir()
    rollout.rename(folder / "solution.npz")
    assert main(["replay", str(folder), f"again={folder}", f"agent={policy}", "--out", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    for label, steps in (("swing", 8), ("again", 8), ("agent", 60)):
        assert f'"label":"{label}","steps":{steps}' in page


def test_names_of_folders_with_demonstrations_may_have_an_equals_sign(tmp_path: Path) -> None:
    folder = tmp_path / "rate=1"
    folder.mkdir()
    assert labeled("rate=a#3") == ("rate", "a#3")
    assert labeled(f"{folder}#3") == (None, f"{folder}#3")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.npz"], "there is no such file"),
        (["{folder}/short.yaml"], "cannot be read as a flight"),
        (["{folder}/numbers.npz"], "it lacks controls and states"),
        (["{folder}/half.npz"], "give --scene"),
        (["{folder}/bare.npz"], "name the scene"),
        (["{folder}/facts.npz"], "its facts are not a mapping"),
        (["{folder}"], "holds neither a solution.npz nor demonstrations, which have a settings.json"),
        ([""], "FLIGHT: '' names none: give a file, a folder or a policy"),
        (["agent="], "FLIGHT: 'agent=' names none"),
        (["{folder}/swing.npz", "--scene", "paper"], "show them on separate pages"),
        (["{folder}/swing.npz", "--seed", "3"], "--seed: 3 is where policies start, and no flight is one"),
    ],
)
def test_unusable_input_is_one_sentence(
    arguments: list[str], sentence: str, rollout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "numbers.npz", numbers=np.zeros(3))
    save_policy(tmp_path / "half.npz", 5)
    flight = read_flight(rollout)
    np.savez(tmp_path / "bare.npz", states=flight.states, controls=flight.controls)
    np.savez(tmp_path / "facts.npz", facts=np.array("[1]"), states=flight.states, controls=flight.controls)
    given = [argument.format(folder=tmp_path) for argument in arguments]
    assert main(["replay", *given, "--out", str(tmp_path / "page.html")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "page.html").exists()


def test_equal_labels_that_nobody_gave_are_told_apart_by_their_sources(rollout: Path, tmp_path: Path) -> None:
    for folder in ("paper", "paper-3", "other/paper"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "solution.npz").write_bytes(rollout.read_bytes())
    heavy = read_flight(rollout).scene.replace({"name": "heavy", "base.mass": 30.0})
    replace(read_flight(rollout), scene=heavy).save(tmp_path / "heavy.npz")

    def labels(*sources: str, given: dict[str, str] | None = None, scene: Scene | None = None) -> list[str]:
        named = [((given or {}).get(source), str(tmp_path / source)) for source in sources]
        parts = collect_flights(named, scene, Console(quiet=True))
        return [flight.label for flights, _ in parts for flight in flights]

    assert labels("paper", "paper-3") == ["swing (paper)", "swing (paper-3)"]
    assert labels("swing.npz", "paper") == ["swing (swing.npz)", "swing (paper)"]
    paths = [tmp_path / folder / "solution.npz" for folder in ("paper", "other/paper")]
    assert labels("paper", "other/paper") == [f"swing ({path})" for path in paths]
    assert labels("paper", "paper-3", given={"paper-3": "swing"}) == ["swing (paper)", "swing"]
    assert labels("paper", "heavy.npz") == ["swing", "swing"], "the list of scenes tells them apart"
    assert labels("paper", "heavy.npz", scene=heavy) == ["swing (paper)", "swing (heavy.npz)"]


def test_a_page_that_no_browser_opens_is_named(
    rollout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda page: opened.append(page) or len(opened) > 1)
    out = tmp_path / "page.html"
    assert main(["replay", str(rollout), "--open", "--out", str(out)]) == 0
    assert f"no browser was found: open {out} in one yourself" in capsys.readouterr().err
    assert main(["replay", str(rollout), "--open", "--out", str(out)]) == 0
    assert capsys.readouterr().err == ""
    assert opened == [out.as_uri()] * 2


def test_a_page_does_not_replace_a_flight(rollout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solution = rollout.with_name("solution.npz")
    solution.write_bytes(rollout.read_bytes())
    assert main(["replay", str(rollout.parent), "--out", str(solution)]) == 2
    assert "which it would replace" in " ".join(capsys.readouterr().err.split())
    assert solution.read_bytes() == rollout.read_bytes()
    content = rollout.read_bytes()
    other = f"{rollout.parent}/../{rollout.parent.name}/{rollout.name}"
    assert main(["replay", str(rollout), "--out", other]) == 2
    assert "which it would replace" in " ".join(capsys.readouterr().err.split())
    assert rollout.read_bytes() == content
    for option, name in (("--scene", "scene.yaml"), ("--normalize", "statistics.pkl")):
        read = rollout.with_name(name)
        read.write_text("mine", encoding="utf-8")
        assert main(["replay", str(rollout), option, str(read), "--out", str(read)]) == 2
        assert "which it would replace" in " ".join(capsys.readouterr().err.split())
        assert read.read_text(encoding="utf-8") == "mine"


def test_scenes_may_differ_in_masses_and_target(rollout: Path, scene: Scene) -> None:
    one = read_flight(rollout)
    heavy = scene.replace({"base.mass": 30.0, "target.pose.position": (0.5, 0.5, 0.0)})
    flights, shown = common_scene([one, replace(one, scene=heavy)])
    assert shown == scene
    np.testing.assert_allclose(flights[1].target, heavy.target.pose.dual_quaternion)
    slower = scene.replace(simulation={"dt": 0.1})
    with pytest.raises(ValueError, match=r"time steps of 0.1 s, the scene 'short' has 0.05 s"):
        common_scene([one, replace(one, scene=slower)])


def test_flights_of_different_scenes_are_a_list_of_scenes(
    rollout: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    swing = read_flight(rollout)
    heavy = scene.replace({"name": "heavy", "base.mass": 30.0})
    for name, flight in (("heavy", replace(swing, label="h", scene=heavy)), ("again", swing)):
        flight.save(tmp_path / f"{name}.npz")
    files = [str(rollout), str(tmp_path / "heavy.npz"), str(tmp_path / "again.npz")]
    out = tmp_path / "page.html"
    assert main(["replay", *files, "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"page": str(out), "scene": "short", "scenes": ["short", "heavy"], "flights": 3}
    page = out.read_text(encoding="utf-8")
    assert page.count("data-scene=") == 2
    shown = [
        (each.name, [flight.label for flight in flights])
        for flights, each in by_scene([read_flight(file) for file in files])
    ]
    assert shown == [("short", ["swing", "swing"]), ("heavy", ["h"])]
    # In one scene all are drawn together.
    assert main(["replay", *files, "--out", str(out), "--scene", str(tmp_path / "short.yaml")]) == 0
    assert out.read_text(encoding="utf-8").count("data-scene=") == 1
    assert "3 flights of scene short, " in " ".join(capsys.readouterr().out.split())


def test_flights_without_a_scene_belong_to_the_first(rollout: Path, scene: Scene) -> None:
    swing = read_flight(rollout)
    heavy = scene.replace({"name": "heavy", "base.mass": 30.0})
    bare = replace(swing, label="bare", scene=None)
    [(flights, shown), _] = by_scene([bare, swing, replace(swing, scene=heavy)])
    assert ([flight.label for flight in flights], shown.name) == (["bare", "swing"], "short")
    with pytest.raises(ValueError, match="no file says which scene it belongs to"):
        by_scene([bare])
