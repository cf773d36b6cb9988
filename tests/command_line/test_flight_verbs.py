"""The verbs `solve` and `simulate`: what they print, write, and how they end."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from dq_space_arm_env import DQSpaceArmEnv, Scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.policy_sources import load_policy
from dq_space_arm_env.command_line.simulated_episode import (
    begin,
    drowned_inputs,
    error_rows,
    flown_catches,
    fly,
    read_noise,
    read_state,
)
from dq_space_arm_env.common.console import FAILURE, INTERRUPTED, SUCCESS, UNUSABLE
from dq_space_arm_env.scene.maneuver import Success
from dq_space_arm_env.task.trajectory import Trajectory
from experts import Solution
from experts.problems.arm_problem import ArmProblem
from experts.report import SolveProgress


@pytest.fixture(scope="module")
def scene(spread_scene: Scene) -> Scene:
    return spread_scene


@pytest.fixture(scope="module")
def scene_file(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("scene") / "short.yaml"
    scene.to_yaml(file)
    return str(file)


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
    assert load_scene(solved / "scene.yaml") == scene
    env = DQSpaceArmEnv(scene)
    env.reset(seed=3)
    assert solution.states[0].tolist() == env.state.tolist()
    _, info = env.reset(options={"initial_state": solution.states[-1]})
    assert info["attitude_error"] == pytest.approx(summary["final_attitude_error_deg"])
    assert info["position_error"] == pytest.approx(summary["final_position_error_m"])


@pytest.mark.slow
def test_a_solve_that_misses_says_what_is_unwise_in_the_scene(
    scene_file: str, short_scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = short_scene.replace({"target.pose.position": [100.0, 0.0, 0.0]})
    far.to_yaml(tmp_path / "far.yaml")
    words = ["--solver", "box", "--max-iterations", "1", "--out", str(tmp_path / "out"), "--json"]
    main(["solve", str(tmp_path / "far.yaml"), *words])
    shown = " ".join(capsys.readouterr().err.split())
    assert re.search(r"Warning: simulation.steps: an episode of 3 s for 9\d.\d m and 60 degrees", shown)
    assert re.search(r"Warning: target: 9\d.\d m from the center of mass, .*: it is out of reach", shown)
    assert "spread" not in shown  # which has no say
    main(["solve", scene_file, *words[:2], *words[4:]])
    assert "Warning" not in capsys.readouterr().err  # it arrives


def test_a_seed_draws_nothing_without_spread(short_scene: Scene) -> None:
    start = begin(short_scene, 1)
    assert start.title == "the scene's own (no spread)"
    assert start.state.tolist() == begin(short_scene).state.tolist()
    moved = short_scene.replace(spread={"target_position": 0.1})
    assert begin(moved, 1).title == "drawn with seed 1"


def test_solve_prints_table_or_json(
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
    assert ("NO success" not in table) == record["is_success"]
    assert "solution.npz, scene.yaml, summary.json" in table


def test_figures_of_an_earlier_run_do_not_stay_beside_another_solution(
    scene_file: str, tmp_path: Path
) -> None:
    mine, old = tmp_path / "figure-3-of-my-thesis.png", tmp_path / "figure-3-pose-error.png"
    for file in (mine, old, tmp_path / "summary.json"):
        file.write_bytes(b"")
    assert main(["solve", scene_file, "--solver", "box", "--out", str(tmp_path)]) == SUCCESS
    assert mine.exists()
    assert not old.exists()


def test_a_solve_replaces_neither_its_scene_nor_its_start(
    scene: Scene, solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "scene.yaml"
    mine.write_text(f"# my own words\n{scene.to_yaml()}")
    start = tmp_path / "solution.npz"
    start.write_bytes((solved / "solution.npz").read_bytes())
    for arguments in ([mine], [solved / "scene.yaml", "--start", start]):
        before = {file: file.read_bytes() for file in tmp_path.iterdir()}
        assert main(["solve", *map(str, arguments), "--solver", "box", "--out", str(tmp_path)]) == UNUSABLE
        assert "is what is read, which it would replace" in capsys.readouterr().err
        assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_what_has_not_converged_is_saved_and_said(
    scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["solve", scene_file, "--solver", "box", "--max-iterations", "1", "--out", str(tmp_path)]
    assert main(arguments) == FAILURE
    table = capsys.readouterr().out
    assert "NOT converged (max_iterations)" in table, table
    assert Solution.load(tmp_path / "solution.npz").iterations == 1


def test_a_maneuver_that_misses_names_the_inputs_that_it_hardly_uses(
    scene_file: str, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = ArmProblem(scene).initial_state + 0.0
    far[2:4] += 1.0  # m, away from the target, without thrusters
    start = ",".join(map(repr, far.tolist()))
    arguments = ["solve", scene_file, "--solver", "box", "--start", start, "--out", str(tmp_path)]
    for more, hint, status in (
        (["--max-iterations", "0"], "hardly used base_torque at most 0 % of its limit:", FAILURE),
        ([], "", SUCCESS),  # as it converges
    ):
        assert main([*arguments, *more]) == status
        table = " ".join(capsys.readouterr().out.split())
        assert re.search(r"position error [\d.]+ m NOT within the tolerance of 0.\d+ m", table)
        assert hint in table if hint else "hardly used" not in table


@pytest.mark.slow
def test_a_target_that_the_cheapest_maneuver_would_miss_names_the_dearest_input(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = {"target.pose.position": [0.75, 0.7, 0.0], "cost.base_force": 100.0}
    dear = scene.replace({"actuators.base_force": {"limit": 10.0}, **far})
    dear.to_yaml(tmp_path / "dear.yaml")
    assert main(["solve", str(tmp_path / "dear.yaml"), "--out", str(tmp_path / "out")]) == SUCCESS
    table = " ".join(capsys.readouterr().out.split())
    assert "constraints: the cheapest maneuver would miss the target" in table
    assert "the dearest input: a smaller cost.base_force, or a larger cost.terminal_pose, leads" in table
    solution = Solution.load(tmp_path / "out" / "solution.npz")
    assert f" base_force {100.0 * (solution.controls[:, :2] ** 2).sum():.6f} the dearest input" in table


def test_each_error_is_within_its_own_tolerance_or_not() -> None:
    success = Success(attitude_error_deg=3.0, position_error=1e-12, velocity_error=0.1)
    assert list(error_rows(success, (0.0194, 0.0385, 7.0, 0.1))) == [
        ("attitude error", "0.0194 deg", "within the tolerance of 3 deg"),
        ("position error", "0.0385 m", "NOT within the tolerance of 1e-12 m"),
        ("angular velocity", "7 deg/s", "relative to the target"),
        ("velocity", "0.1 m/s", "relative to the target; within the tolerance of 0.1 m/s"),
    ]
    *_, position = error_rows(Success(), (math.nan, math.inf), " as if caught")
    assert position == ("position error", "inf m", "NOT within the tolerance of 0.1 m as if caught")


def test_a_solve_shows_what_it_prepares_and_what_it_solves(
    scene_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dq_space_arm_env.common.progress.SECONDS_BETWEEN_LINES", 0.0)
    monkeypatch.setattr("experts.guesses.guided.read_preparation", lambda key: None)
    assert main(["solve", scene_file, "--out", str(tmp_path)]) == SUCCESS
    shown = capsys.readouterr().err
    before, _, after = shown.rpartition("preparing   ")
    assert "preparing   solve  1   iteration   1 " in before
    assert "J " not in before  # of steps of other lengths
    assert "attempt  1   iteration   1   J " in after


def test_an_interrupt_saves_the_best_so_far(
    scene_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(self: SolveProgress, record: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SolveProgress, "update", interrupt)
    assert main(["solve", scene_file, "--solver", "box", "--out", str(tmp_path)]) == INTERRUPTED
    assert "is saved" in capsys.readouterr().err
    assert Solution.load(tmp_path / "solution.npz").stop_reason == "interrupted"


def test_an_interrupted_preparation_says_that_nothing_is_saved(
    scene_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(self: SolveProgress, record: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SolveProgress, "update", interrupt)
    monkeypatch.setattr("experts.guesses.guided.read_preparation", lambda key: None)
    assert main(["solve", scene_file, "--out", str(tmp_path / "out")]) == INTERRUPTED
    assert "Interrupted: nothing is saved yet" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


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


def test_a_flight_does_not_replace_what_it_came_from(
    scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flight.npz"
    assert main(["simulate", scene_file, "--policy", "zero", "--out", str(file)]) == SUCCESS
    content = file.read_bytes()
    other = f"{tmp_path}/../{tmp_path.name}/flight.npz"
    for given in (["--policy", str(file)], ["--policy", "zero", "--start", other]):
        assert main(["simulate", scene_file, *given, "--out", str(file)]) == UNUSABLE
        assert "which it would replace" in " ".join(capsys.readouterr().err.split())
    assert file.read_bytes() == content
    assert main(["simulate", scene_file, "--policy", "zero", "--out", scene_file]) == UNUSABLE
    assert load_scene(scene_file).name
    capsys.readouterr()
    assert main(["simulate", "planar", "--normalize", str(file), "--out", str(file)]) == UNUSABLE
    assert "which it would replace" in " ".join(capsys.readouterr().err.split())
    assert file.read_bytes() == content


def test_commands_to_copy_quote_their_files(
    scene_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight, scene = tmp_path / "a flight.npz", tmp_path / "a scene.yaml"
    assert main(["simulate", scene_file, "--policy", "zero", "--out", str(flight)]) == SUCCESS
    assert f"`dq-space-arm replay '{flight}'`" in capsys.readouterr().out
    assert main(["scenes", "new", str(scene)]) == SUCCESS
    assert f"`dq-space-arm scenes validate '{scene}'`" in capsys.readouterr().err


def test_solutions_fly_as_planned(solved: Path, scene_file: str, capsys: pytest.CaptureFixture[str]) -> None:
    cost = Solution.load(solved / "solution.npz").cost
    for policy in ("plan", "gains", "receding", str(solved / "solution.npz")):
        assert main(["simulate", scene_file, "--seed", "3", "--policy", policy, "--json"]) == SUCCESS
        assert documents(capsys)["cost"] == pytest.approx(cost, rel=1e-9)


@pytest.mark.slow
def test_a_solution_flies_in_its_scene_where_phases_change_and_episodes_draw_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its file has what the phases change alone: what was drawn is constant in it."""
    coasting = {"name": "coasting", "steps": 8, "changes": {"actuators": {"base_force": None}}}
    scene = {
        "name": "coasting",
        "base": {"motion": "planar", "mass": 20.0, "inertia": [1.0, 1.0, 1.0]},
        "actuators": {"base_force": {"limit": 1.0}, "base_torque": {"limit": 1.0}},
        "target": {"pose": {"rotation": {"axis": [0, 0, 1], "angle": 60}}},
        "simulation": {"steps": 16, "dt": 0.1},
        "phases": [{"name": "moving", "steps": 8}, coasting],
        "spread": {"target_position": 0.5, "base_inertia": 0.3},
    }
    file, out = str(tmp_path / "coasting.yaml"), tmp_path / "out"
    load_scene(scene).to_yaml(file)
    main(["solve", file, "--seed", "3", "--solver", "box", "--out", str(out)])
    cost = json.loads((out / "summary.json").read_text())["cost"]
    capsys.readouterr()
    assert main(["simulate", file, "--seed", "3", "--policy", f"{out}/solution.npz", "--json"]) == SUCCESS
    assert documents(capsys)["cost"] == pytest.approx(cost, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [pytest.param(0.0, marks=pytest.mark.endurance), 2e4])
def test_catches_are_judged_as_environments_judge_them(stiffness: float) -> None:
    """Each error a little within its tolerance, then beyond it, of a target that tumbles.

    With stiff springs too, where steps are divided and end elsewhere than a whole one.
    """
    changes: dict[str, Any] = {f"phases.{index}.steps": steps for index, steps in enumerate((6, 1, 5))}
    changes |= {f"links.{index}.stiffness": stiffness for index in (1, 2)}
    short = load_scene("capture-and-detumble").replace({**changes, "simulation.steps": 12})
    start = begin(short)
    rng, shape = np.random.default_rng(1), (12, DQSpaceArmEnv(short).kernels.n_u)
    inputs = rng.uniform(-1.0, 1.0, shape)

    def flown(scene: Scene) -> tuple[Any, bool]:
        env, states = DQSpaceArmEnv(scene), [start.state]
        env.reset(options={"initial_state": start.state})
        for action in inputs:
            *_, info = env.step(action)
            states.append(env.state)
        commanded = env.kernels.layout.to_control(inputs, env.kernels.stage_parameters()[:-1])
        (found,) = flown_catches(begin(scene), states, commanded)
        return found, bool(info["caught"])

    names = ("attitude_error_deg", "position_error", "angular_velocity_error_deg", "velocity_error")
    errors = flown(short)[0].errors
    for name in ("", *names):
        sizes = [
            error * (0.999 if name == each else 1.001) for each, error in zip(names, errors, strict=True)
        ]
        scene = short.replace({"phases.2.catch": dict(zip(names, sizes, strict=True))})
        found, caught = flown(scene)
        assert found.errors == pytest.approx(errors)
        assert found.is_met == caught == (name == "")


@pytest.mark.slow
def test_a_flight_that_misses_its_catch_is_compared_with_the_truth_before_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lengths = {f"phases.{index}.steps": steps for index, steps in enumerate((6, 1, 5))}
    short = load_scene("capture-and-detumble").replace({**lengths, "simulation.steps": 12})
    short.to_yaml(tmp_path / "short.yaml")
    line = ["simulate", str(tmp_path / "short.yaml"), "--policy", "zero"]
    assert main([*line, "--json"]) == SUCCESS
    record = documents(capsys)
    assert record["missed_catches"] == ["detumble"]
    assert record["numerical_error"] < 1e-12  # it is at rest
    assert main(line) == SUCCESS
    assert "m or rad, of the tip before the missed catch" in capsys.readouterr().out


@pytest.mark.slow
def test_a_plan_that_misses_its_catch_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lengths = {f"phases.{index}.steps": steps for index, steps in enumerate((6, 1, 5))}
    short = load_scene("capture-and-detumble").replace({**lengths, "simulation.steps": 12})
    short.to_yaml(tmp_path / "short.yaml")
    monkeypatch.chdir(tmp_path)
    assert main(["solve", "short.yaml", "--solver", "box", "--max-iterations", "1"]) == FAILURE
    assert re.search(r"catch, detumble +MISSED +nothing is held", capsys.readouterr().out)
    summary = json.loads(Path("results", "solutions", "short", "summary.json").read_text())
    assert (summary["missed_catches"], summary["is_success"]) == (["detumble"], False)
    assert main(["solve", "short.yaml", "--solver", "box", "--max-iterations", "100"]) == FAILURE
    table = capsys.readouterr().out
    assert re.search(r"end +converged", table)
    assert re.search(r"cost J +[\d.]+ +as if the payload were caught; ", table)
    assert re.search(r"to meet it +let the robot coast", table)
    assert re.search(r"attitude error .* within the tolerance of [\d.]+ deg as if\s+caught", table)
    assert main(["simulate", "short.yaml", "--policy", "zero"]) == SUCCESS
    assert "MISSED" in capsys.readouterr().out


@pytest.mark.slow
def test_noise_is_recorded_and_feedback_makes_up_for_it(scene: Scene) -> None:
    def flight(policy: str) -> Trajectory:
        start = begin(scene, 3)
        return fly(scene, start, load_policy(policy, start, Console(quiet=True), 3), seed=3, noise=0.2)

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


def test_noise_in_units_of_the_actuators() -> None:
    scene = load_scene("no-wrist").replace({"links.1.torque_limit": 0.5})
    assert read_noise([], scene).tolist() == [0.0] * 9
    assert read_noise(["0.1"], scene).tolist() == [0.1] * 9
    wheels = load_scene("wheels")
    with pytest.raises(ValueError, match="--noise base_torque=1: did you mean 'wheel_torque'"):
        read_noise(["base_torque=1"], wheels)
    found = read_noise(
        ["joint_torque=0.02", "0.1", "base_force=2.5"], scene
    )  # N m and N, of 2, 0.5, 2 and 10
    assert found == pytest.approx([0.25] * 3 + [0.1] * 3 + [0.01, 0.04, 0.01])
    assert drowned_inputs(found, scene) is None
    drowned = drowned_inputs(read_noise(["joint_torque=0.6"], scene), scene)
    assert drowned == "the noise is larger than the limits of link 2 torque (0.5 N m)"
    start = begin(scene.replace(simulation={"steps": 200}))
    flown = fly(
        start.scene, start, load_policy("zero", start, Console(quiet=True), 0), seed=None, noise=found
    )
    assert flown.noise is not None
    assert flown.noise.std(axis=0) == pytest.approx([2.5] * 3 + [0.5] * 3 + [0.02] * 3, rel=0.2)


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        (["0.1", "0.2"], "--noise 0.1, 0.2: should be given once for all inputs"),
        (
            ["base_force=1", "0.1", "base_force=2"],
            "--noise base_force=1, base_force=2: .* once for base_force",
        ),
    ],
)
def test_noise_is_given_once(texts: list[str], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_noise(texts, load_scene("planar"))


def test_noise_in_units_needs_limits_that_stay() -> None:
    changes = {"links.0.torque_limit": 0.2, "actuators.base_force": None}
    scene = load_scene("planar").replace(
        {
            "links.0.torque_limit": 2.0,
            "phases": [{"name": "all", "steps": 500}, {"name": "weak", "steps": 500, "changes": changes}],
        }
    )
    with pytest.raises(ValueError, match=r"--noise joint_torque=0.1: phases of .* give a fraction of them"):
        read_noise(["joint_torque=0.1"], scene)
    assert read_noise(["base_force=1"], scene)[:2] == pytest.approx(0.2)  # what is out of work gives nothing


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "joint_torques=1",
            "did you mean 'joint_torque'.* are base_force .N., base_torque .N m., joint_torque",
        ),
        ("wheel_torque=1", "the actuators of scene planar are"),
        ("joint_torque=-1", "--noise is joint_torque=-1.0; it must be at least 0, a standard deviation, N m"),
        ("base_force=1N", "should be a number, or ACTUATOR=NUMBER"),
        ("nan", "--noise is nan; it must be at least 0, a fraction of the limits"),
    ],
)
def test_noise_that_means_nothing(text: str, sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "planar", "--policy", "zero", "--noise", text]) == UNUSABLE
    assert re.search(sentence, capsys.readouterr().err)


def test_a_solution_of_another_length_is_refused(
    solved: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "longer.yaml"
    scene.replace(simulation={"dt": 0.05, "steps": 61}).to_yaml(file)
    policy = str(solved / "solution.npz")
    assert main(["simulate", str(file), "--policy", policy]) == UNUSABLE
    assert "the solution has 60 steps, the scene 61" in capsys.readouterr().err


def test_states_are_read_from_text_and_files(tmp_path: Path) -> None:
    state = np.array([1.0, -2.5, 3e-4])
    np.save(tmp_path / "state.npy", state)
    np.savez(tmp_path / "flight.npz", states=np.stack([state, 2 * state]))
    (tmp_path / "state.json").write_text(json.dumps(state.tolist()))
    files = [str(tmp_path / name) for name in ("state.npy", "flight.npz", "state.json")]
    for source in ("1,-2.5,3e-4", *files):
        assert read_state(source, 3).tolist() == state.tolist()


def test_a_start_is_that_of_the_environment_with_its_drawn_target(scene: Scene) -> None:
    env = DQSpaceArmEnv(scene)
    env.reset(options={"nominal": True})
    assert begin(scene).state.tolist() == env.state.tolist()
    assert begin(scene).scene is scene
    scene = load_scene("random-target")
    env = DQSpaceArmEnv(scene)
    env.reset(seed=1)
    begun = begin(scene, 1)
    assert (begun.scene, begun.episode_scene) == (scene, env.episode_scene)
    assert begun.parameters.tolist() == env.parameters.tolist()
    assert env.episode_scene.target != scene.target


@pytest.mark.slow
def test_drawn_targets_and_masses_are_compiled_once(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing = scene.replace(spread={"target_position": 0.05, "link_masses": 0.2})
    file, folder = tmp_path / "drawing.yaml", tmp_path / "solved"
    drawing.to_yaml(file)

    def solved_and_flown(seed: int) -> float:
        drawn = ["--seed", str(seed), "--json"]
        main(["solve", str(file), *drawn, "--out", str(folder)])
        cost: float = documents(capsys)["cost"]
        for policy in ("plan", "gains", "receding", str(folder / "solution.npz")):
            main(["simulate", str(file), *drawn, "--policy", policy])
            assert documents(capsys)["cost"] == pytest.approx(cost, rel=1e-6)
        return cost

    solved_and_flown(1)

    def refuse(*arguments: object) -> None:
        raise AssertionError("compiled again")

    with monkeypatch.context() as patch:
        patch.setattr("dq_space_arm_env.compiler.build.build_program", refuse)
        cost = solved_and_flown(3)
    # The files are of the episode's scene, and show its target.
    env = DQSpaceArmEnv(drawing)
    env.reset(seed=3)
    assert load_scene(folder / "scene.yaml") == env.episode_scene
    solution = str(folder / "solution.npz")
    assert Trajectory.load(solution).scene == env.episode_scene
    main(["simulate", str(folder / "scene.yaml"), "--start", solution, "--policy", solution, "--json"])
    assert documents(capsys)["cost"] == pytest.approx(cost, rel=1e-9)
