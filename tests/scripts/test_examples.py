"""The examples run, and show what their headers promise; most draw a picture."""

import importlib
import json
import re
import runpy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from experts import GuidedDDP

LESSON = Path(__file__).parents[2] / "scripts" / "examples" / "lesson.ipynb"


def run(name: str, *options: str) -> None:
    importlib.import_module(f"scripts.examples.{name}").main(list(options))


def rows(printed: str, pattern: str) -> list[list[float]]:
    """Numbers of the lines that match, from the groups of the pattern."""
    return [
        [float(number) for number in match.groups()] for match in re.finditer(pattern, printed, re.MULTILINE)
    ]


def is_picture(file: Path) -> bool:
    return file.read_bytes().startswith(b"\x89PNG")


def test_first_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("first_steps", "--scene", "planar", "--out", str(tmp_path))
    printed = capsys.readouterr().out
    assert re.search(r"^nothing .* False$", printed, flags=re.MULTILINE)
    assert re.search(r"^expert .* True$", printed, flags=re.MULTILINE)
    [[expert]], [[cost]] = rows(printed, r"^expert +(-[\d.]+)"), rows(printed, r"J = ([\d.]+)")
    assert expert == pytest.approx(-cost, abs=0.1)
    assert is_picture(tmp_path / "first_steps.png")


@pytest.mark.slow
def test_feedback_under_disturbance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--scene", "planar", "--pushes", "0", "0.01", "--out", str(tmp_path)]
    run("feedback_under_disturbance", *options)
    printed = capsys.readouterr().out
    names = ("plan alone", "with gains", "receding horizon")
    alone, gains, horizon = (rows(printed, rf"^ +[\d.]+  {name} +[\d.]+ +([\d.]+)") for name in names)
    assert alone[0] == gains[0]
    assert horizon[0] == pytest.approx(alone[0], abs=0.002)
    assert re.findall(r" 0.01  .* (\w+)$", printed, flags=re.MULTILINE) == ["misses", "arrives", "arrives"]
    assert gains[1] < alone[1]
    assert horizon[1] < alone[1]
    assert is_picture(tmp_path / "feedback_under_disturbance.png")


@pytest.mark.slow
def test_feedback_in_a_scene_with_phases(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Undisturbed, the plan ends as planned: each step has the masses of its phase."""
    scene = load_scene("planar")
    half = scene.simulation.steps // 2
    lighter = {"base.mass": 0.7 * scene.base.mass}
    phases = [{"name": "full", "steps": half}, {"name": "empty", "steps": half, "changes": lighter}]
    scene.replace(phases=phases).to_yaml(file := tmp_path / "phases.yaml")
    run("feedback_under_disturbance", "--scene", str(file), "--pushes", "0", "--out", str(tmp_path))
    printed = capsys.readouterr().out
    names = ("plan alone", "with gains", "receding horizon")
    ends = [rows(printed, rf"{name} +([\d.]+) +([\d.]+)")[0] for name in names]
    assert ends[1] == ends[2] == ends[0]


def test_compare_integrators(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("compare_integrators", "--scene", "planar", "--out", str(tmp_path))
    printed = capsys.readouterr().out
    for name, order in (("symplectic_euler", 1.0), ("rk4", 4.0)):
        orders = rows(printed, rf"^{name} +[\d.]+ +\S+ +([\d.]+)")
        assert orders[2] == [pytest.approx(order, abs=0.3)]  # the steps before are long for `planar`
    assert is_picture(tmp_path / "compare_integrators.png")


def test_unusable_robot_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "robot.urdf").write_text('<robot name="stick"><link name="hull"/></robot>', encoding="utf-8")
    with pytest.raises(SystemExit):
        run("own_scene", "--urdf", str(tmp_path / "robot.urdf"), "--out", str(tmp_path))
    assert "'tool0' is not a link of 'stick'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name",
    [
        "compare_integrators",
        "feedback_under_disturbance",
        "first_steps",
        pytest.param("train_ppo", marks=[pytest.mark.slow, pytest.mark.agents]),
    ],
)
def test_an_unknown_scene_is_one_sentence(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name == "train_ppo":
        pytest.importorskip("stable_baselines3")
    monkeypatch.setattr("sys.argv", [name, "--scene", "papr"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(LESSON.with_name(f"{name}.py")), run_name="__main__")
    assert end.value.code == 2
    assert "did you mean 'paper'" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_own_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("own_scene", "--out", str(tmp_path))
    printed = capsys.readouterr().out
    assert "base.mass" in printed
    [[angle, distance]] = rows(printed, r"^end +([\d.]+) +([\d.]+)$")
    scene = load_scene(tmp_path / "own_scene.yaml")
    assert angle < scene.success.attitude_error_deg
    assert distance < scene.success.position_error
    assert is_picture(tmp_path / "own_scene.png")


@pytest.mark.slow
@pytest.mark.agents
def test_train_ppo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("stable_baselines3")
    few = ("--copies", "8", "--steps", "16000", "--starts", "4")
    run("train_ppo", "--scene", "planar", *few, "--out", str(tmp_path))
    printed = capsys.readouterr().out
    costs = [rows(printed, rf"^ +{name} .* (\d+)$")[0][0] for name in ("untrained", "trained")]
    assert costs[1] != costs[0]
    from agents import evaluate  # the saved model flies like the exported policy

    saved = evaluate(
        tmp_path / "model.zip", "planar", 4, expert=False, normalize=tmp_path / "vecnormalize.pkl"
    )
    exported = evaluate(tmp_path / "policy.npz", "planar", 4, expert=False)
    np.testing.assert_allclose(saved.flights.cost, exported.flights.cost, rtol=1e-6)


def test_cart_pole(capsys: pytest.CaptureFixture[str]) -> None:
    run("cart_pole")
    printed = capsys.readouterr().out
    assert rows(printed, r"^converged after (\d+) iterations of ([\d.]+) ms$")[0][0] < 100
    [[cost, error]] = rows(printed, r"^cost ([\d.]+), final error (\S+)$")
    assert cost == pytest.approx(24.0214, rel=1e-5)
    assert error < 0.01
    assert rows(printed, r"^at a bound in (\d+) of")[0][0] > 10


def test_planar_quadrotor(capsys: pytest.CaptureFixture[str]) -> None:
    run("planar_quadrotor")
    pattern = r"converged after (\d+) iterations of [\d.]+ ms, cost ([\d.]+), final error (\S+)$"
    first, second = rows(capsys.readouterr().out, pattern)
    assert first[1] == pytest.approx(14.6355, rel=1e-5)
    assert second[0] < first[0] < 50
    assert max(first[2], second[2]) < 0.06


def test_the_lesson_is_a_notebook_without_outputs() -> None:
    notebook = json.loads(LESSON.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    cells = notebook["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        kept = {"cell_type", "id", "metadata", "source"}
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            kept |= {"outputs", "execution_count"}
        assert cell.keys() == kept


@pytest.mark.slow
def test_lesson() -> None:
    """The cells run one after the other in one namespace, as a kernel of Jupyter runs them."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    names: dict[str, Any] = {}
    for cell in json.loads(LESSON.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"lesson.ipynb, cell {cell['id']}", "exec"), names)
    assert len(pyplot.get_fignums()) > 0
    pyplot.close("all")
    success, flights, plan = names["kernels"].scene.success, names["flights"], names["plan"]
    arrives = {
        name: errors[-1, 0] < success.attitude_error_deg and errors[-1, 1] < success.position_error
        for name, (errors, _) in flights.items()
    }
    misses = {"nothing", "plan, pushed"}
    assert arrives == {name: name not in misses for name in flights}
    assert len(flights) == 5
    assert flights["plan"][1] == pytest.approx(plan.cost, rel=1e-12)
    assert flights["policy, pushed"][1] < 1.05 * plan.cost < 0.1 * flights["nothing"][1]
    assert names["slopes"]["plan"] < 1e-6 * names["slopes"]["nothing"]
    assert names["differences"] == pytest.approx(names["expected"], rel=1e-6)
    for method, order in (("symplectic_euler", 1), ("rk4", 4)):
        errors = [error for _, error in names["curves"][method]]
        assert errors[-2] / errors[-1] == pytest.approx(2**order, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["debris-capture", "docking", pytest.param("space-robot-reach", marks=pytest.mark.endurance)]
)
def test_the_expert_solves_the_tasks_of_peers(name: str) -> None:
    scene = load_scene(Path(f"scripts/examples/{name}.yaml"))
    assert scene.name == name
    solution, env = GuidedDDP(scene).solve(), gymnasium.make("DQSpaceArm-v0", scene=scene)
    assert solution.converged
    env.reset(options={"nominal": True})
    for action in compile_scene(scene).layout.to_action(solution.controls):
        *_, info = env.step(action)
    assert info["is_success"]
