"""The comparison: what controllers fly, what they know, what is kept, and what tables and commands say."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents import compare, evaluate
from agents.command_line.compare import compare as compare_verb
from agents.command_line.evaluate import evaluate as evaluate_verb
from agents.configuration import load_configuration
from agents.evaluation import CONTROLLERS, evaluation_seeds, fly, optimal_costs, scene_under
from agents.evaluation.comparing import Comparison, Row, distinct_names
from agents.evaluation.comparison_tables import (
    comparison_tables,
    group_record,
    improvement_rows,
    markdown,
    notes,
    profile_rows,
    record,
)
from agents.evaluation.expert_costs import validation_costs
from agents.evaluation.plan_followers import FEEDBACK, OPEN_LOOP, RECEDING
from agents.evaluation.planned_flights import fly_plans
from agents.evaluation.training_runs import agent_of, groups, learning_curve, seed_of, training_command
from agents.policies import ExportedPolicy
from agents.run_folder import validation_seeds
from dq_space_arm_env import DQSpaceArmVectorEnv
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.tables import one_line
from experts import GuidedDDP
from experts.demonstrations import SerialExecutor
from experts.problems.arm_problem import ArmProblem

pytestmark = pytest.mark.slow  # the expert plans for every condition

N = 6


def write_policy(folder, scene, seed=0, name="stub", **training):
    """An exported policy with the folder of its run."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    metadata = {
        "agent": name,
        "scene": scene.name,
        "scene_hash": scene.content_hash(),
        "configuration": {"name": name, "seed": seed, "curve": {"episodes": 5}},
        "training": {"environment_steps": 1000, "seconds": 90.0, "expert_solves": 7, **training},
    }
    weights = 0.1 * rng.standard_normal((14, 6))
    policy = ExportedPolicy((weights,), (np.zeros(6),), "tanh", np.zeros(14), np.ones(14), metadata=metadata)
    policy.save(folder / "policy.npz")
    known = {"median_cost": 900.0}
    curve = [
        {"environment_steps": 10 * k, "seconds": 10.0 * k, "success_rate": 0.1 * k, **known} for k in (2, 1)
    ]
    (folder / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in curve) + "{\n")
    return folder


@pytest.fixture(scope="module")
def comparison(quick, tmp_path_factory) -> Comparison:
    """Controllers and three runs of an agent, under two conditions."""
    folder = tmp_path_factory.mktemp("runs")
    runs = [write_policy(folder / f"stub-{seed}", quick, seed) for seed in range(3)]
    return compare(
        runs, quick, N, conditions=("training", "heavy_payload"), receding_starts=3, executor=SerialExecutor()
    )


def row_of(comparison, name, condition):
    (row,) = (row for row in comparison.under(condition) if row.name == name)
    return row


def test_plans_cost_the_optimum_where_nothing_differs(comparison):
    for name in (OPEN_LOOP, FEEDBACK):
        evaluation = row_of(comparison, name, "training").evaluation
        known = ~np.isnan(evaluation.cost_gaps)
        assert known.sum() >= N - 1
        np.testing.assert_allclose(evaluation.cost_gaps[known], 0.0, rtol=0, atol=1e-9)
        assert evaluation.flights.is_success.tolist() == evaluation.optimal.is_success.tolist()
        assert evaluation.summary()["cheaper_than_expert"] == 0
        dearer = replace(evaluation, optimal=evaluation.optimal._replace(cost=1.01 * evaluation.optimal.cost))
        assert dearer.summary()["cheaper_than_expert"] == evaluation.flights.is_success[known].sum()


def test_a_wrong_payload_hurts_the_open_loop_most(comparison, counting, quick):
    """The plans are those of the unchanged scene, and gains correct most of what that spoils."""
    blind = row_of(comparison, OPEN_LOOP, "heavy_payload").evaluation
    corrected = row_of(comparison, FEEDBACK, "heavy_payload").evaluation
    assert np.nanmedian(blind.cost_gaps) > 10.0 * np.nanmedian(corrected.cost_gaps) > 0.0
    # What they are compared with is the optimum of the scene that they fly in.
    expected = optimal_costs(scene_under(quick, "heavy_payload"), N, executor=counting(limit=0)).cost
    np.testing.assert_array_equal(blind.optimal.cost, expected)


def test_gains_are_those_of_the_solution(comparison, quick):
    """One flight by hand: the expert's own feedback policy of the unchanged scene, in the changed one."""
    problem = ArmProblem(quick)
    flown = scene_under(quick, "heavy_payload")
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

    seeds = evaluation_seeds(quick, N)
    costs = [fly(Follower(), flown, [seed]).cost[0] for seed in seeds]
    # Of a group some may have been solved anew, from a neighbor; and gains are kept in single precision.
    same = np.isclose(costs, evaluation.flights.cost, rtol=1e-5)
    assert same.sum() >= N - 1


def test_the_receding_horizon_stays_near_the_optimum(comparison):
    evaluation = row_of(comparison, RECEDING, "training").evaluation
    assert len(evaluation.seeds) == 3
    assert np.nanmedian(evaluation.cost_gaps) < 0.01
    assert row_of(comparison, RECEDING, "training").facts["planning_seconds"] > 0.0


def test_conditions_share_plans(cache, counting, quick):
    executor = counting()
    conditions = ("training", "heavy_payload", "light_payload", "delay")
    first = fly_plans(quick, (OPEN_LOOP, FEEDBACK), conditions, 2, executor)
    assert executor.tasks == 1
    again = fly_plans(quick, (OPEN_LOOP, FEEDBACK), conditions, 2, counting(limit=0))
    for key, planned in first.items():
        np.testing.assert_array_equal(again[key].flights.cost, planned.flights.cost)
    calm, late = (first[OPEN_LOOP, condition].flights.cost for condition in ("training", "delay"))
    assert (calm != late).all()
    # The optimal costs have been kept along.
    optimal_costs(quick, 2, executor=counting(limit=0))
    for damaged in (cache / "planned-flights").rglob("*.json"):
        damaged.write_text("[]")
    repaired = fly_plans(quick, (FEEDBACK,), ("training",), 2, executor)
    assert executor.tasks == 2
    np.testing.assert_array_equal(
        repaired[FEEDBACK, "training"].flights.cost, first[FEEDBACK, "training"].flights.cost
    )


def test_interrupted_flights_resume(cache, counting, quick):
    with pytest.raises(KeyboardInterrupt):
        fly_plans(quick, (FEEDBACK,), ("training",), 30, counting(limit=1))
    executor, seen = counting(), []
    flown = fly_plans(quick, (FEEDBACK,), ("training",), 30, executor, seen.append)
    assert executor.tasks == 1
    assert [(advance.done, advance.total) for advance in seen] == [(1, 2), (2, 2)]
    assert len(flown[FEEDBACK, "training"].flights.cost) == 30


def test_runs_of_one_agent_are_taken_together(comparison):
    assert [(group.name, group.condition, group.seeds) for group in comparison.groups] == [
        ("stub", "training", (0, 1, 2)),
        ("stub", "heavy_payload", (0, 1, 2)),
    ]
    rows = [row for row in comparison.under("training") if row.facts["is_agent"]]
    rate = np.mean([row.evaluation.flights.is_success.mean() for row in rows])
    assert comparison.groups[0].runs.success_rate.value == pytest.approx(rate)
    one, same, other = (
        {"configuration": {"name": "a", **entry}} for entry in ({"seed": 1}, {"seed": 2}, {"x": 1})
    )
    assert agent_of(one) == agent_of(same) != agent_of(other)


def test_best_and_last_policies_of_runs_make_two_groups(comparison):
    last = [row.evaluation for row in comparison.under("training") if row.facts["is_agent"]]
    earlier = {"training": {"seconds": 50.0}}
    dearer = [each.flights._replace(cost=each.flights.cost + 1.0) for each in last]
    best = [
        replace(each, flights=flights, metadata=each.metadata | earlier)
        for each, flights in zip(last, dearer, strict=True)
    ]
    found = groups([best[0], *last, *best[1:], best[0]])  # one of them twice
    assert [(group.name, group.seeds) for group in found] == [
        ("stub", (0, 1, 2)),
        ("stub (earlier)", (0, 1, 2)),
    ]
    assert [list(group.evaluations) for group in found] == [last, best]


def test_agents_meet_all_others_flight_by_flight(comparison):
    found = improvement_rows(comparison, "training")
    assert [(row["over"], row["episodes"]) for row in found] == [(OPEN_LOOP, N), (FEEDBACK, N), (RECEDING, 3)]
    stubs = [row.evaluation.flights.cost for row in comparison.under("training") if row.facts["is_agent"]]
    gains = row_of(comparison, FEEDBACK, "training").evaluation.flights.cost
    assert found[1]["probability"][0] == pytest.approx(np.mean(np.array(stubs) < gains))
    blind, *_, stub = profile_rows(comparison, "training")
    assert blind["shares"][0][0] == 1.0  # plans cost the optimum
    flown = [row.evaluation for row in comparison.under("training") if row.facts["is_agent"]]
    gaps = np.array([each.cost_gaps for each in flown])
    known, reached = ~np.isnan(gaps).any(axis=0), np.array([each.flights.is_success for each in flown])
    shares = [np.mean((reached & (gaps <= gap))[:, known]) for gap in stub["cost_gaps"]]
    assert [share[0] for share in stub["shares"]] == shares


def test_a_policy_that_gives_nan_costs_more_than_any_other(quick):
    def drifting(observations):
        return np.full((len(observations), 6), np.nan)

    def pushing(observations):
        return np.ones((len(observations), 6))

    broken, wild = (evaluate(policy, quick, 3, expert=False) for policy in (drifting, pushing))
    assert (broken.flights.cost < wild.flights.cost).all()
    found = Comparison(quick.name, tuple(Row(each, {"is_agent": True}) for each in (broken, wild)))
    (row,) = improvement_rows(found, "training")
    assert row["probability"][0] == 0.0


def test_curves_are_relative_to_the_optima_of_their_own_starts(comparison, counting, quick):
    costs = validation_costs(quick, 5, counting(limit=0))  # kept by the comparison
    assert costs.seeds.tolist() == validation_seeds(5)
    problem = ArmProblem(quick)
    environment = DQSpaceArmVectorEnv(1, quick)
    environment.reset(seed=[int(costs.seeds[1])])
    solution = GuidedDDP(problem).solve(environment.states[0])
    assert costs.cost[1] == pytest.approx(solution.cost, rel=1e-3)
    row = row_of(comparison, "stub-0", "training")
    assert row.facts["validation_optimum"] == np.nanmedian(costs.cost)


def test_optima_of_more_validation_than_evaluation_starts_are_kept(cache, counting, quick, monkeypatch):
    monkeypatch.setattr("agents.evaluation.expert_costs.EVALUATION_SEEDS", 3)
    first = validation_costs(quick, 5, SerialExecutor())
    again = validation_costs(quick, 5, counting(limit=0))
    np.testing.assert_array_equal(again.cost, first.cost)


def test_finished_rows_are_taken_up(tmp_path, monkeypatch, quick):
    run = write_policy(tmp_path / "stub-0", quick)
    arguments = {"controllers": ("gains",), "out": tmp_path / "out", "executor": SerialExecutor()}
    first = compare([run], quick, 3, **arguments)
    files = sorted(path.name for path in (tmp_path / "out" / "rows").iterdir())
    assert files == ["plan-with-gains-training.json", "stub-0-training.json"]

    def refuse(*arguments, **options):
        raise AssertionError("evaluated again")

    monkeypatch.setattr("agents.evaluation.comparing.evaluate", refuse)
    monkeypatch.setattr("agents.evaluation.comparing.fly_plans", refuse)
    again = compare([run], quick, 3, **arguments | {"out": str(tmp_path / "out")})
    assert json.dumps(record(again)) == json.dumps(record(first))
    assert any("not of other trainings" in sentence for sentence in notes(again))
    (tmp_path / "out" / "rows" / files[1]).write_text("{")
    with pytest.raises(AssertionError, match="evaluated again"):
        compare([run], quick, 3, **arguments)
    write_policy(tmp_path / "other" / "stub-0", quick, seed=1)
    with pytest.raises(AssertionError, match="evaluated again"):
        compare([tmp_path / "other" / "stub-0"], quick, 3, **arguments)


def test_tables_have_all_columns_of_the_protocol(comparison):
    first, _, profiles, improvements, second, *_ = comparison_tables(comparison)
    assert [row[0] for row in first.rows] == [*CONTROLLERS.values(), "stub-0", "stub-1", "stub-2"]
    stub = dict(zip(first.headings, first.rows[3], strict=True))
    assert (stub["training\nsteps"], stub["expert\nsolves"], stub["plan\ns"]) == ("1,000", "7", "-")
    assert stub["success\n%"].startswith("0.0\n[0.0, 39.")
    text = markdown("Title", [first, second], comparison)
    for sentence in notes(comparison):
        assert one_line(sentence) in text
    named = markdown("Title", [], replace(comparison, scene="<img src=x> [a](javascript:b)"))
    assert named.startswith("# Title, scene &lt;img src=x> [a]\\(javascript:b)")
    assert any("they do not know the new one" in sentence for sentence in notes(comparison))
    assert not any("other trainings" in sentence for sentence in notes(comparison))  # the stub has three
    entrants = [*CONTROLLERS.values(), "stub, seeds 0, 1, 2"]
    assert [row[0] for row in profiles.rows] == entrants
    assert [row[1] for row in improvements.rows] == entrants[:-1]
    content = json.loads(json.dumps(record(comparison), allow_nan=False))
    assert content["groups"] == [group_record(group) for group in comparison.groups]
    curve = content["rows"][3]["learning_curve"]  # in the order of time
    assert [(point["seconds"], point["success_rate"]) for point in curve] == [(10.0, 0.1), (20.0, 0.2)]


def test_commands_make_the_rows_again(comparison):
    """Each command names what it is for, and is one that the programs understand."""
    found = [shlex.split(command) for command in comparison.commands]
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
    longer = {**shipped, "seed": 3, "schedule": {**shipped["schedule"], "total_steps": 9}}
    assert training_command({"configuration": longer}) == "dq-space-arm train ppo --seed 3 --total-steps 9"
    changed = {**shipped, "network": {**shipped["network"], "hidden": [3]}}
    assert training_command({"configuration": changed}) is None
    (tmp_path / "config.yaml").touch()
    assert training_command({"configuration": changed}, tmp_path / "policy.npz") == (
        f"dq-space-arm train {tmp_path / 'config.yaml'}"
    )
    assert training_command({}) is None


def test_policies_have_names_apart_from_each_other_and_from_controllers():
    """What shares a name would share a row's file and a color; of two corrections one would not fly."""
    files = [Path(name) for name in ("x/a.npz", "y/a.npz", "z/a (1).npz", "b.npz", "plan with gains.npz")]
    assert distinct_names(files) == ["a (2)", "a (3)", "a (1)", "b", "plan with gains (1)"]


def test_what_cannot_be_compared_is_refused(quick):
    with pytest.raises(ValueError, match="controllers: 'magic' is unknown; choose from open-loop, gains"):
        compare(scene=quick, controllers=("magic",))
    with pytest.raises(TypeError, match="policies: 'ppo', should be a sequence: put it into a list"):
        compare("ppo", scene=quick)
    with pytest.raises(TypeError, match="conditions: 'push', should be a sequence"):
        compare(scene=quick, conditions="push")
    with pytest.raises(ValueError, match="there is nothing to compare"):
        compare(scene=quick, controllers=())
    with pytest.raises(ValueError, match="receding_starts: 0, should be a whole number"):
        compare(scene=quick, receding_starts=0)


def test_the_verb_writes_table_record_and_picture(tmp_path, capsys, quick):
    pytest.importorskip("matplotlib")
    quick.to_yaml(tmp_path / "quick.yaml")
    run = write_policy(tmp_path / "stub-0", quick)
    arguments = [str(run), "--scene", str(tmp_path / "quick.yaml"), "-n", "3", "--workers", "1"]
    out = tmp_path / "out"
    assert main(["compare", *arguments, "--controller", "gains", "--out", str(out)]) == 0
    assert "Commands that reproduce the rows:" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"rows", "table.md", "comparison.json", "comparison.png"}
    assert (out / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    rows = json.loads((out / "comparison.json").read_text())["rows"]
    assert [row["policy"] for row in rows] == ["plan with gains", "stub-0"]
    assert main(["compare", *arguments, "--controller", "none", "--no-picture", "--out", str(out)]) == 0
    assert not (out / "comparison.png").exists()  # it had one more row


def test_a_controller_named_twice_is_flown_once_and_none_stands_alone(tmp_path, capsys, quick):
    found = compare(scene=quick, n=2, controllers=["gains", "gains"], executor=SerialExecutor())
    assert [row.name for row in found.rows] == ["plan with gains"]
    words = ["compare", "apg", "--workers", "1", "--out", str(tmp_path / "out")]
    assert main([*words, "--controller", "none", "gains"]) == 2
    assert "--controller: none gains, should be none alone" in capsys.readouterr().err


def test_files_are_written_where_nothing_can_be_printed(tmp_path, quick, fill_output):
    fill_output()
    quick.to_yaml(tmp_path / "quick.yaml")
    out = tmp_path / "out"
    words = ["--scene", str(tmp_path / "quick.yaml"), "-n", "3", "--workers", "1", "--no-picture"]
    assert main(["compare", *words, "--controller", "gains", "--out", str(out)]) == 1
    assert {path.name for path in out.iterdir()} == {"rows", "table.md", "comparison.json"}


def test_the_verb_refuses_a_policy_before_it_begins(tmp_path, capsys, quick):
    out = ["--out", str(tmp_path / "out")]
    assert main(["compare", "--policy", str(tmp_path / "nothing"), *out]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    assert main(["compare", "--policy", str(write_policy(tmp_path / "stub-0", quick)), *out]) == 2
    assert "maps 14 observations to 6 inputs (it was trained for scene 'quick')" in capsys.readouterr().err
    assert not (tmp_path / "out" / "rows").exists()


def test_starts_of_a_controller_that_does_not_fly_are_refused(tmp_path, capsys):
    arguments = ["--controller", "gains", "--receding-starts", "3", "--out", str(tmp_path / "out")]
    assert main(["compare", "agents", *arguments]) == 2
    assert "--receding-starts: 3, but --controller leaves out receding" in capsys.readouterr().err


def test_the_figure_draws_gaps_that_no_logarithm_has(comparison):
    pytest.importorskip("matplotlib")
    from agents.evaluation.comparison_figure import FLOOR, comparison_figure

    figure = comparison_figure(comparison)
    panels = [axes for part in figure.subfigs for axes in part.axes]
    assert len(panels) == 6
    drawn = [line for line in panels[0].lines if line.get_marker() == "v"]
    assert [line.get_ydata()[0] for line in drawn[:2]] == [FLOOR, FLOOR]
    for axes in panels:
        for line in axes.lines:
            assert np.isfinite(np.asarray(line.get_ydata(), dtype=float)).all()
        if axes.get_yscale() == "log":
            assert axes.get_ylim()[0] == FLOOR
    assert not math.isnan(panels[0].get_ylim()[1])


def test_learning_curves_end_in_their_markers(comparison):
    pytest.importorskip("matplotlib")
    from agents.evaluation.comparison_figure import comparison_figure

    figure = comparison_figure(comparison)
    stub = row_of(comparison, "stub-0", "training")
    ratio = np.median(stub.evaluation.flights.cost) / np.nanmedian(stub.evaluation.optimal.cost)
    for axes, end in zip(
        figure.subfigs[1].axes, (100.0 * (ratio - 1.0), stub.evaluation.success_rate.value), strict=True
    ):
        curve = next(line for line in axes.lines if len(line.get_xdata()) == 3)
        marker = next(line for line in axes.lines if line.get_marker() not in ("None", None))
        assert (curve.get_xdata()[-1], curve.get_ydata()[-1]) == pytest.approx((90.0, end))
        assert (marker.get_xdata()[0], marker.get_ydata()[0]) == pytest.approx((90.0, end))
    shown = 100.0 * (900.0 / stub.facts["validation_optimum"] - 1.0)
    curve = next(line for line in figure.subfigs[1].axes[0].lines if len(line.get_xdata()) == 3)
    assert curve.get_ydata()[0] == pytest.approx(max(shown, 0.01))


@pytest.mark.parametrize("seconds", [0.4, 90.0, 60.0 * 3600.0])
def test_trainings_of_any_length_are_within_the_axes(comparison, seconds, monkeypatch):
    pytest.importorskip("matplotlib")
    from agents.evaluation import comparison_figure

    monkeypatch.setattr(comparison_figure, "_training_seconds", lambda row: seconds)
    figure = comparison_figure.comparison_figure(comparison)
    for axes in figure.subfigs[1].axes:
        low, high = axes.get_xlim()
        markers = [line for line in axes.lines if line.get_marker() not in ("None", None)]
        assert markers
        assert all(low <= line.get_xdata()[0] <= high for line in markers)


def test_points_of_a_curve_that_are_no_numbers_are_passed_over(tmp_path):
    points = [
        {"seconds": 1.0, "success_rate": 0.5, "median_cost": math.inf},
        {"seconds": math.nan, "success_rate": 0.5, "median_cost": 1.0},
        {"seconds": 2.0, "success_rate": math.nan, "median_cost": 1.0},
        {"seconds": 3.0, "success_rate": 0.75, "median_cost": 7.0},
    ]
    (tmp_path / "evaluations.jsonl").write_text("".join(json.dumps(each) + "\n" for each in points))
    found = learning_curve(tmp_path / "policy.npz")
    assert [(each["seconds"], each["median_cost"]) for each in found] == [(1.0, None), (3.0, 7.0)]
    assert seed_of({"configuration": {"seed": "x"}}) is None
    assert seed_of({"configuration": {"seed": 3}}) == 3
