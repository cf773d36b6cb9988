"""The script as a user runs it: files, numbers, exit status; honesty about a solve that did not end well."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from experts import Solution
from experts.report import SolveProgress, reproduction
from scripts.reproduce_paper import main

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "reproduce_paper.py"
DRAWN = ("2-snapshots", "3-pose-error", "4-error-norms", "5-base-inputs", "6-arm-inputs")
FIGURES = {*(f"figure-{name}.png" for name in DRAWN), "convergence.png"}
DATA = {"solution.npz", "scene.yaml", "summary.json"}


@pytest.fixture
def scene_file(short_scene: Scene, tmp_path: Path) -> Path:
    (link,) = short_scene.links
    short_scene.replace(links=[{**link.model_dump(), "name": "[red]link"}]).to_yaml(tmp_path / "short.yaml")
    return tmp_path / "short.yaml"


def run(scene_file: Path, out: Path, *arguments: str) -> int:
    return main(["--scene", str(scene_file), "--out", str(out), *arguments])


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


@pytest.mark.slow
def test_a_user_gets_every_file_and_the_right_numbers(scene_file: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(SCRIPT), "--scene", str(scene_file)]
    folder = scene_file.parent
    result = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert result.returncode == 0, result.stderr
    compiling = "dq_space_arm_env: compiling what is used of scene 'short'"  # what the cache lacks
    assert all(line.startswith(compiling) for line in result.stderr.splitlines())
    out = folder / "results" / "short"
    assert names(out) == DATA | FIGURES
    summary = json.loads((out / "summary.json").read_text())
    solution = Solution.load(out / "solution.npz")
    assert summary["result"]["converged"] is True
    assert summary["result"]["cost"] == solution.cost == pytest.approx(42.95667, rel=1e-5)
    assert summary["replay"]["relative_difference"] < 1e-12
    assert solution.controls.shape == (60, 2)
    assert np.abs(solution.controls).max() <= 2.0
    assert load_scene(out / "scene.yaml") == load_scene(scene_file)
    assert solution.metadata["scene"] == summary["resolved_scene"]
    assert f"{solution.cost:.6f}" in result.stdout
    assert f"{-solution.cost:.6f}" in result.stdout
    assert "[red]link" in result.stdout
    assert "converged" in result.stdout
    assert "\x1b" not in result.stdout  # not a terminal: no colors, no cursor movements


def test_no_color_is_respected_on_a_terminal(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    assert run(scene_file, scene_file.parent, "--no-figures") == 0
    output = capsys.readouterr().out
    assert "\x1b[2K" in output  # the line of progress is rewritten
    assert "\x1b[3" not in output
    assert "\x1b[9" not in output


def test_integrator_is_in_the_saved_scene(scene_file: Path, tmp_path: Path) -> None:
    assert run(scene_file, tmp_path, "--integrator", "symplectic_euler", "--no-figures") == 0
    assert names(tmp_path) == {*DATA, scene_file.name}
    assert load_scene(tmp_path / "scene.yaml").simulation.integrator == "symplectic_euler"


def test_unconverged_solve_is_reported_and_fails(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(scene_file, out, "--max-iterations", "2") == 1
    assert names(out) == DATA | FIGURES
    assert "NOT CONVERGED" in capsys.readouterr().out
    result = json.loads((out / "summary.json").read_text())["result"]
    assert (result["converged"], result["stop_reason"], result["iterations"]) == (False, "max_iterations", 2)


def test_interrupted_solve_saves_the_best_so_far(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    costs = []

    def interrupt(self: SolveProgress, record: object) -> None:
        costs.append(record.cost)  # type: ignore[attr-defined]
        if len(costs) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(SolveProgress, "update", interrupt)
    out = tmp_path / "out"
    assert run(scene_file, out, "--no-figures") == 130
    assert "INTERRUPTED after 3 iterations" in capsys.readouterr().out
    solution = Solution.load(out / "solution.npz")
    assert solution.stop_reason == "interrupted"
    assert solution.cost == costs[-1] < costs[0]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["replay"]["agrees"] is True


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--scene", "papr"], "did you mean 'paper'?"),
        (["--scene", "{folder}/infinite.yaml"], "give each actuator a finite limit"),
        (["--max-iterations", "-1"], "max_iterations is -1"),
        (["--readme-picture", "{folder}/a.png", "--no-figures"], "and --no-figures for none: leave one of"),
        (["--readme-picture", "{folder}/a.gif"], "a.gif, should end in .png"),
    ],
)
def test_unusable_input_is_one_sentence(
    arguments: list[str], sentence: str, scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    infinite = load_scene(scene_file).replace(actuators={"base_torque": {"limit": float("inf")}})
    infinite.to_yaml(tmp_path / "infinite.yaml")
    assert run(scene_file, tmp_path, *(word.format(folder=tmp_path) for word in arguments)) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_missing_matplotlib_is_told_before_the_solve(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reproduction, "find_spec", lambda name: None)
    assert run(scene_file, tmp_path / "out") == 2
    assert 'pip install "dq-space-arm[plots]"' in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
    assert run(scene_file, tmp_path / "out", "--no-figures") == 0


def test_diverged_solve_draws_nothing_and_says_so(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # At this rate and with this step, the explicit integration of a stiff spring blows up.
    scene = load_scene(scene_file)
    stiff = [{**link.model_dump(), "stiffness": 1e6} for link in scene.links]
    scene.replace(links=stiff, initial_state={"joint_angles": [1.0]}).to_yaml(scene_file)
    out = tmp_path / "out"
    assert run(scene_file, out) == 1
    assert "DIVERGED" in capsys.readouterr().out
    assert names(out) == DATA
    summary = json.loads((out / "summary.json").read_text())
    assert summary["result"]["cost"] is None
    assert summary["result"]["stop_reason"] == "diverged"
