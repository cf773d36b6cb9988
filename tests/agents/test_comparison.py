"""The comparison: what controllers fly, what they know, what is kept, and what tables and commands say."""

import importlib.util
import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest

from agents import compare
from agents.command_line.comparing import compare as compare_verb
from agents.command_line.learning import evaluate as evaluate_verb
from agents.comparison import CONTROLLERS
from agents.comparison.comparing import Comparison
from agents.comparison.controllers import FEEDBACK, OPEN_LOOP, RECEDING
from agents.comparison.planned_flights import fly_plans
from agents.comparison.tables import commands, markdown, notes, record, tables
from agents.configuration import load_configuration
from agents.evaluation import evaluation_seeds, fly, optimal_costs, scene_under
from agents.evaluation.conditions import as_known
from agents.evaluation.runs import agent_of, learning_curve, training_command
from agents.policies import ExportedPolicy
from dq_space_arm_env import load_scene
from experts import GuidedDDP
from experts.arm_problem import ArmProblem
from experts.demonstrations import SerialExecutor

QUICK = load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})
"""Its problems are solved in hundredths of a second; the same as in the tests of the evaluation."""
N = 6


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A place for costs and flights alone, shared by these tests: compiled kernels stay where they are."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.evaluation.cached_groups.cache_directory", lambda: folder)
        yield folder


class Counting:
    """An executor that counts the tasks it is given."""

    def __init__(self):
        self.tasks = 0

    def run(self, tasks):
        for result in SerialExecutor().run(tasks):
            self.tasks += 1
            yield result


class Nobody:
    """An executor that must not be asked."""

    def run(self, tasks):
        assert not list(tasks)
        yield from ()


def write_policy(folder, seed=0, name="stub", scene=QUICK, **training):
    """An exported policy of a run that never was."""
    rng = np.random.default_rng(seed)
    n_observation, n_action = (14, 6)
    folder.mkdir(parents=True)
    policy = ExportedPolicy(
        weights=(0.1 * rng.standard_normal((n_observation, n_action)),),
        biases=(np.zeros(n_action),),
        activation="tanh",
        mean=np.zeros(n_observation),
        scale=np.ones(n_observation),
        metadata={
            "agent": name,
            "scene": scene.name,
            "scene_hash": scene.content_hash(),
            "configuration": {"name": name, "seed": seed},
            "training": {"environment_steps": 1000, "seconds": 90.0, "expert_solves": 7, **training},
        },
    )
    policy.save(folder / "policy.npz")
    curve = [
        {"environment_steps": 10 * k, "seconds": 10.0 * k, "success_rate": 0.1 * k, "median_cost": 900.0}
        for k in (2, 1)
    ]
    (folder / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in curve) + "{\n")
    return folder


@pytest.fixture(scope="module")
def comparison(tmp_path_factory) -> Comparison:
    """Controllers and three runs of an agent, under two conditions."""
    folder = tmp_path_factory.mktemp("runs")
    runs = [write_policy(folder / f"stub-{seed}", seed) for seed in range(3)]
    return compare(
        runs,
        QUICK,
        N,
        conditions=("training", "heavy_payload"),
        receding_starts=3,
        executor=SerialExecutor(),
    )


def row_of(comparison, name, condition):
    (row,) = (row for row in comparison.under(condition) if row.evaluation.policy == name)
    return row


def test_plans_cost_the_optimum_where_nothing_differs(comparison):
    for name in (OPEN_LOOP, FEEDBACK):
        evaluation = row_of(comparison, name, "training").evaluation
        known = ~np.isnan(evaluation.cost_gaps)
        assert known.sum() >= N - 1
        np.testing.assert_allclose(evaluation.cost_gaps[known], 0.0, atol=1e-9)
        assert evaluation.flights.is_success.tolist() == evaluation.optimal.is_success.tolist()


def test_a_wrong_payload_hurts_the_open_loop_most(comparison):
    """The plans are those of the unchanged scene, and gains correct most of what that spoils."""
    blind = row_of(comparison, OPEN_LOOP, "heavy_payload").evaluation
    corrected = row_of(comparison, FEEDBACK, "heavy_payload").evaluation
    assert np.nanmedian(blind.cost_gaps) > 10.0 * np.nanmedian(corrected.cost_gaps) > 0.0
    # What they are compared with is the optimum of the scene that they fly in.
    expected = optimal_costs(scene_under(QUICK, "heavy_payload"), N, executor=Nobody()).cost
    np.testing.assert_array_equal(blind.optimal.cost, expected)


def test_gains_are_those_of_the_solution(comparison):
    """One flight by hand: the expert's own feedback policy of the unchanged scene, in the changed one."""
    problem = ArmProblem(QUICK)
    flown = scene_under(QUICK, "heavy_payload")
    evaluation = row_of(comparison, FEEDBACK, "heavy_payload").evaluation
    solver = GuidedDDP(problem)

    class Follower:
        def begin(self, environment):
            self.environment, self.stage = environment, 0
            self.policy = solver.solve(environment.states[0]).policy(problem)

        def __call__(self, observations):
            control = self.policy(self.environment.states[0], self.stage)
            self.stage += 1
            return (control / problem.control_upper)[None]

    seeds = evaluation_seeds(QUICK, N)
    costs = [fly(Follower(), flown, [seed]).cost[0] for seed in seeds]
    # Of a group some may have been solved anew, from a neighbor; and gains are kept in single precision.
    same = np.isclose(costs, evaluation.flights.cost, rtol=1e-5)
    assert same.sum() >= N - 1


def test_the_receding_horizon_stays_near_the_optimum(comparison):
    evaluation = row_of(comparison, RECEDING, "training").evaluation
    assert len(evaluation.seeds) == 3
    assert np.nanmedian(evaluation.cost_gaps) < 0.01
    assert row_of(comparison, RECEDING, "training").planning_seconds > 0.0


def test_what_controllers_know():
    assert as_known(QUICK, "heavy_payload") is QUICK
    assert as_known(QUICK, "wide_starts") == scene_under(QUICK, "wide_starts")
    assert as_known(QUICK, "spin").initial_state.base_velocity[2] != QUICK.initial_state.base_velocity[2]


def test_plans_are_made_once_for_all_conditions_that_share_them(monkeypatch, tmp_path):
    monkeypatch.setattr("agents.evaluation.cached_groups.cache_directory", lambda: tmp_path)
    executor = Counting()
    conditions = ("training", "heavy_payload", "light_payload")
    first = fly_plans(QUICK, (OPEN_LOOP, FEEDBACK), conditions, 2, executor)
    assert executor.tasks == 1
    again = fly_plans(QUICK, (OPEN_LOOP, FEEDBACK), conditions, 2, Nobody())
    for key, planned in first.items():
        np.testing.assert_array_equal(again[key].flights.cost, planned.flights.cost)
    # The optimal costs have been kept along.
    optimal_costs(QUICK, 2, executor=Nobody())
    for damaged in (tmp_path / "planned-flights").rglob("*.json"):
        damaged.write_text("[]")
    repaired = fly_plans(QUICK, (FEEDBACK,), ("training",), 2, executor)
    assert executor.tasks == 2
    np.testing.assert_array_equal(
        repaired[FEEDBACK, "training"].flights.cost, first[FEEDBACK, "training"].flights.cost
    )


def test_flights_that_were_interrupted_go_on(monkeypatch, tmp_path):
    monkeypatch.setattr("agents.evaluation.cached_groups.cache_directory", lambda: tmp_path)

    class Interrupted(Counting):
        def run(self, tasks):
            yield from zip_first(super().run(tasks), 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fly_plans(QUICK, (FEEDBACK,), ("training",), 30, Interrupted())
    executor, seen = Counting(), []
    flown = fly_plans(QUICK, (FEEDBACK,), ("training",), 30, executor, seen.append)
    assert executor.tasks == 1
    assert [(advance.done, advance.total) for advance in seen] == [(1, 2), (2, 2)]
    assert len(flown[FEEDBACK, "training"].flights.cost) == 30


def zip_first(iterator, count):
    for _, value in zip(range(count), iterator, strict=False):
        yield value


def test_runs_of_one_agent_are_taken_together(comparison):
    assert [(group.name, group.condition, group.seeds) for group in comparison.groups] == [
        ("stub", "training", (0, 1, 2)),
        ("stub", "heavy_payload", (0, 1, 2)),
    ]
    rows = [row for row in comparison.under("training") if row.is_agent]
    rate = np.mean([row.evaluation.flights.is_success.mean() for row in rows])
    assert comparison.groups[0].runs.success_rate.value == pytest.approx(rate)
    assert agent_of({"configuration": {"name": "a", "seed": 1}}) == agent_of(
        {"configuration": {"name": "a", "seed": 2}}
    )
    assert agent_of({"configuration": {"name": "a", "x": 1}}) != agent_of({"configuration": {"name": "a"}})


def test_finished_rows_are_taken_up(tmp_path, monkeypatch):
    run = write_policy(tmp_path / "stub-0")
    arguments = {"controllers": ("gains",), "out": tmp_path / "out", "executor": SerialExecutor()}
    first = compare([run], QUICK, 3, **arguments)
    files = sorted(path.name for path in (tmp_path / "out" / "rows").iterdir())
    assert files == ["plan-with-gains-training.json", "stub-0-training.json"]

    def refuse(*arguments, **options):
        raise AssertionError("evaluated again")

    monkeypatch.setattr("agents.comparison.comparing.evaluate", refuse)
    monkeypatch.setattr("agents.comparison.comparing.fly_plans", refuse)
    again = compare([run], QUICK, 3, **arguments)
    assert json.dumps(record(again)) == json.dumps(record(first))
    (tmp_path / "out" / "rows" / files[1]).write_text("{")
    with pytest.raises(AssertionError, match="evaluated again"):
        compare([run], QUICK, 3, **arguments)
    write_policy(tmp_path / "other" / "stub-0", seed=1)
    with pytest.raises(AssertionError, match="evaluated again"):
        compare([tmp_path / "other" / "stub-0"], QUICK, 3, **arguments)


def test_tables_have_all_that_the_protocol_asks_for(comparison):
    first, second = tables(comparison)
    assert "condition heavy_payload" in second.title
    assert [row[0] for row in first.rows] == [
        *CONTROLLERS.values(),
        "stub-0",
        "stub-1",
        "stub-2",
        "stub, all 3 runs (seeds 0, 1, 2)",
    ]
    assert {len(row) for row in first.rows} == {len(first.headings)}
    stub = dict(zip(first.headings, first.rows[3], strict=True))
    assert stub["training\nsteps"] == "1,000"
    assert stub["training\ntime"] == "90 s"
    assert stub["expert\nsolves"] == "7"
    assert stub["success\n%"].startswith("0.0\n[0.0, 39.")
    text = markdown(comparison)
    for sentence in notes(comparison):
        assert sentence in text
    assert any("they do not know the new one" in sentence for sentence in notes(comparison))
    json.dumps(record(comparison), allow_nan=False)


def test_commands_make_the_rows_again(comparison):
    """Each command names what it is for, and is one that the programs understand."""
    found = [shlex.split(command) for command in commands(comparison)]
    assert len(found) == len(CONTROLLERS) + 3
    for words in found:
        comparing = words[1] == "compare"
        command = compare_verb.default if comparing else evaluate_verb.default
        options = command.make_context("test", words[3:] if comparing else words[2:]).params
        assert options["conditions"] == ("training", "heavy_payload")
        assert options["n"] == N
    receding = next(words for words in found if "receding" in words)
    assert receding[receding.index("--receding-starts") + 1] == "3"


def test_the_training_command_is_the_shortest_that_gives_the_configuration(tmp_path):
    shipped = load_configuration("ppo").model_dump(mode="json", exclude_none=True)
    assert training_command({"configuration": {**shipped, "seed": 3}}) == ("dq-space-arm train ppo --seed 3")
    longer = {**shipped, "schedule": {**shipped["schedule"], "total_steps": 9}}
    assert training_command({"configuration": longer}) == (
        f"dq-space-arm train ppo --seed {shipped['seed']} --total-steps 9"
    )
    changed = {**shipped, "network": {**shipped["network"], "hidden": [3]}}
    assert training_command({"configuration": changed}) is None
    (tmp_path / "config.yaml").touch()
    assert training_command({"configuration": changed}, tmp_path / "policy.npz") == (
        f"dq-space-arm train {tmp_path / 'config.yaml'}"
    )
    assert training_command({}) is None


def test_a_learning_curve_is_read_in_the_order_of_time(tmp_path):
    run = write_policy(tmp_path / "stub-0")
    curve = learning_curve(run / "policy.npz")
    assert [(point.seconds, point.success_rate) for point in curve] == [(10.0, 0.1), (20.0, 0.2)]
    assert learning_curve(tmp_path / "policy.npz") == []


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ValueError, match="controllers: 'magic' is unknown; there are open-loop, gains"):
        compare(scene=QUICK, controllers=("magic",))
    with pytest.raises(ValueError, match="conditions: 'rain' is unknown"):
        compare(scene=QUICK, conditions=("rain",))
    with pytest.raises(ValueError, match="there is nothing to compare"):
        compare(scene=QUICK, controllers=())
    with pytest.raises(ValueError, match="should be from 1 to 500"):
        compare(scene=QUICK, n=501)
    with pytest.raises(ValueError, match="receding_starts: 0, should be at least 1"):
        compare(scene=QUICK, receding_starts=0)


def load_script():
    path = Path(__file__).parents[2] / "scripts" / "compare_agents.py"
    spec = importlib.util.spec_from_file_location("compare_agents", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_script_writes_table_record_and_picture(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    QUICK.to_yaml(tmp_path / "quick.yaml")
    run = write_policy(tmp_path / "stub-0")
    arguments = ["--policy", str(run), "--scene", str(tmp_path / "quick.yaml"), "-n", "3", "--workers", "1"]
    out = tmp_path / "out"
    assert load_script().main([*arguments, "--controller", "gains", "--out", str(out)]) == 0
    assert "The rows are made again by:" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"rows", "table.md", "comparison.json", "comparison.png"}
    assert (out / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    rows = json.loads((out / "comparison.json").read_text())["rows"]
    assert [row["policy"] for row in rows] == ["plan with gains", "stub-0"]


def test_the_script_refuses_a_policy_before_it_begins(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert load_script().main(["--policy", str(tmp_path / "nothing"), *out]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    assert load_script().main(["--policy", str(write_policy(tmp_path / "stub-0")), *out]) == 2
    assert "turns 14 numbers into 6 inputs, as it was trained for scene 'quick'" in capsys.readouterr().err
    assert not (tmp_path / "out" / "rows").exists()


def test_the_figure_draws_gaps_that_no_logarithm_has(comparison):
    pytest.importorskip("matplotlib")
    from agents.comparison.figure import FLOOR, comparison_figure

    figure = comparison_figure(comparison)
    panels = [axes for part in figure.subfigs for axes in part.axes]
    assert len(panels) == 5
    drawn = [line for line in panels[0].lines if line.get_marker() == "v"]
    assert [line.get_ydata()[0] for line in drawn[:2]] == [FLOOR, FLOOR]
    for axes in panels:
        for line in axes.lines:
            assert np.isfinite(np.asarray(line.get_ydata(), dtype=float)).all()
        if axes.get_yscale() == "log":
            assert axes.get_ylim()[0] == FLOOR
    assert not math.isnan(panels[0].get_ylim()[1])
