"""The verbs `solve` and `simulate`: what they print, write, and how they end."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.command_line import main
from agents.command_line.simulating import RecordedFlight, fly
from agents.command_line.starts import begin, read_state
from agents.command_line.verb import FAILURE, INTERRUPTED, SUCCESS, UNUSABLE
from dq_space_arm_env import DQSpaceArmEnv, Scene, load_scene
from experts import Solution
from experts.report import SolveProgress

# Compiles and solves in seconds; by its content the one of the tests of reports, and as such in the cache.
SCENE = """
name: short
base: {motion: planar, mass: 20, inertia: [1, 1, 1]}
links:
  - name: link
    mass: 2
    inertia: [0.01, 0.05, 0.05]
    center_of_mass: [0.3, 0, 0]
    joint: {position: [0.3, 0, 0]}
tip: {position: [0.6, 0, 0]}
actuators: {base_torque: {limit: 2}, joint_torque: {limit: 0.5}}
target: {pose: {position: [0.6, 0.5, 0], rotation: {axis: [0, 0, 1], angle: 60}}}
simulation: {dt: 0.05, steps: 60}
spread: {joint_angles: 0.5, base_position: 0.1, base_rotation: 0.1}
"""


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("scene") / "short.yaml"
    file.write_text(SCENE)
    return str(file)


@pytest.fixture(scope="module")
def scene(scene_file: str) -> Scene:
    return load_scene(scene_file)


def documents(capsys: pytest.CaptureFixture[str]) -> Any:
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def solved(scene_file: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("solved") / "out"
    assert main(["solve", scene_file, "--seed", "3", "--out", str(folder)]) == SUCCESS
    return folder


def test_solve_writes_what_it_says(solved: Path, scene: Scene) -> None:
    assert {file.name for file in solved.iterdir()} == {"solution.npz", "scene.yaml", "summary.json"}
    solution = Solution.load(solved / "solution.npz")
    summary = json.loads((solved / "summary.json").read_text())
    assert summary["cost"] == solution.cost
    assert summary["converged"] is True
    assert summary["solver"] == "GuidedDDP"
    assert summary["versions"]["numpy"]
    assert load_scene(solved / "scene.yaml") == scene
    env = DQSpaceArmEnv(scene)
    env.reset(seed=3)
    assert solution.states[0].tolist() == env.state.tolist()
    env.reset(options={"initial_state": solution.states[-1]})
    _, info = env.reset(options={"initial_state": solution.states[-1]})
    assert info["attitude_error"] == pytest.approx(summary["final_attitude_error_deg"])
    assert info["position_error"] == pytest.approx(summary["final_position_error_m"])


def test_solve_prints_a_table_or_a_document(
    scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["solve", scene_file, "--solver", "box", "--out", str(tmp_path)]
    assert main(arguments) == SUCCESS
    table = capsys.readouterr().out
    assert main([*arguments, "--json"]) == SUCCESS
    record = documents(capsys)
    assert record["start"] == "the scene's own"
    assert record["solver"] == "BoxDDP"
    assert f"{record['cost']:.6f}" in table
    assert ("NOT within the tolerance" not in table) == record["is_success"]
    assert "solution.npz, scene.yaml, summary.json" in table


def test_what_has_not_converged_is_saved_and_said(
    scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["solve", scene_file, "--solver", "box", "--max-iterations", "1", "--out", str(tmp_path)]
    assert main(arguments) == FAILURE
    table = capsys.readouterr().out
    assert "NOT converged (max_iterations)" in table, table
    assert Solution.load(tmp_path / "solution.npz").iterations == 1


def test_an_interrupt_saves_the_best_so_far(
    scene_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(self: SolveProgress, record: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SolveProgress, "update", interrupt)
    assert main(["solve", scene_file, "--solver", "box", "--out", str(tmp_path)]) == INTERRUPTED
    assert "is saved" in capsys.readouterr().err
    assert Solution.load(tmp_path / "solution.npz").stop_reason == "interrupted"


def test_zero_and_random_inputs(scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "flight.npz"
    arguments = ["simulate", scene_file, "--seed", "5", "--json"]
    assert main([*arguments, "--policy", "zero", "--out", str(out)]) == SUCCESS
    zero = documents(capsys)
    with np.load(out) as content:
        facts = json.loads(str(content["facts"]))
        assert set(content.files) == {"states", "controls", "rewards", "target", "facts"}
        assert content["states"].shape == (61, 9)
        assert not content["controls"].any()
        assert -content["rewards"].sum() == pytest.approx(zero["cost"])
    assert load_scene(facts["scene"]) == load_scene(scene_file)
    assert facts["label"] == "zero inputs"
    costs = []
    for _ in range(2):
        assert main([*arguments, "--policy", "random"]) == SUCCESS
        costs.append(documents(capsys)["cost"])
    assert costs[0] == costs[1] != zero["cost"]


def test_a_solution_is_flown_as_planned(
    solved: Path, scene_file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cost = Solution.load(solved / "solution.npz").cost
    policies = ["plan", "gains", "receding", str(solved / "solution.npz")]
    for policy in policies:
        assert main(["simulate", scene_file, "--seed", "3", "--policy", policy, "--json"]) == SUCCESS
        assert documents(capsys)["cost"] == pytest.approx(cost, rel=1e-9)


def test_noise_is_recorded_and_feedback_makes_up_for_it(scene: Scene) -> None:
    from rich.console import Console

    def flight(policy: str) -> RecordedFlight:
        return fly(scene, policy, Console(quiet=True), seed=3, noise=0.2)

    plan, gains, receding = flight("plan"), flight("gains"), flight("receding")
    assert plan.noise.std() == pytest.approx(gains.noise.std(), rel=0.2)
    limits = np.array([2.0, 0.5])
    assert (np.abs(plan.controls + plan.noise) <= limits * (1.0 + 1e-12)).all()
    env = DQSpaceArmEnv(scene)
    env.reset(options={"initial_state": plan.states[0]})
    for control, noise, reached in zip(plan.controls, plan.noise, plan.states[1:], strict=True):
        env.step((control + noise) / limits)
        assert env.state == pytest.approx(reached, abs=1e-9)
    assert gains.cost < plan.cost
    assert receding.cost < plan.cost


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--seed", "1", "--start", "0,0"], "--seed and --start exclude each other"),
        (["--seed", "-1"], "-1 is not in the range x>=0"),
        (["--start", "1,2,3"], "--start: has shape (3,), should be the scene's (9,)"),
        (["--start", "one"], "should be 9 numbers with commas between"),
        (["--noise", "-1"], "--noise is -1.0"),
    ],
)
def test_unusable_starts_and_noise(
    arguments: list[str], sentence: str, scene_file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", scene_file, "--policy", "zero", *arguments]) == UNUSABLE
    assert sentence in capsys.readouterr().err


def test_a_solution_of_another_length_is_refused(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "longer.yaml"
    file.write_text(SCENE.replace("steps: 60", "steps: 61"))
    policy = str(solved / "solution.npz")
    assert main(["simulate", str(file), "--policy", policy]) == UNUSABLE
    assert "the solution has 60 steps, the scene 61" in capsys.readouterr().err


def test_states_are_read_from_text_and_files(tmp_path: Path) -> None:
    state = np.array([1.0, -2.5, 3e-4])
    np.save(tmp_path / "state.npy", state)
    np.savez(tmp_path / "flight.npz", states=np.stack([state, 2 * state]))
    (tmp_path / "state.json").write_text(json.dumps(state.tolist()))
    for source in (
        "1,-2.5,3e-4",
        *(str(tmp_path / name) for name in ("state.npy", "flight.npz", "state.json")),
    ):
        assert read_state(source, 3).tolist() == state.tolist()


def test_an_own_start_is_that_of_the_scene(scene: Scene) -> None:
    start = begin(scene, None, None)
    env = DQSpaceArmEnv(scene)
    env.reset(options={"nominal": True})
    assert start.state.tolist() == env.state.tolist()
    assert start.scene is scene


def test_a_drawn_target_is_part_of_the_scene_that_is_solved() -> None:
    scene = load_scene("random-target")
    start = begin(scene, 1, None)
    env = DQSpaceArmEnv(scene)
    env.reset(seed=1)
    assert start.scene == env.episode_scene
    assert start.scene.target != scene.target
