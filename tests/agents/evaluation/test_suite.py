"""The suite: pinned scenes, entrants of all kinds, scores by hand, resuming, the check of others' results."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner

from agents import evaluate
from agents.command_line.suite import suite as suite_verb
from agents.configuration import ConfigurationError
from agents.evaluation.comparing import Row
from agents.evaluation.evaluating import Evaluation
from agents.evaluation.expert_costs import OptimalCosts
from agents.policies.flying import Flights
from agents.run_folder import DivergedError
from agents.suite import Score, Suite, SuiteError, SuiteRun, list_suites, load_suite, run_suite
from agents.suite.entrants import entrant_names, from_files, missing_files
from agents.suite.suite_check import check, check_columns, comparable, fewer_trainings
from agents.suite.suite_page import overall_rows, suite_page
from agents.zoo.finding import PolicyError
from agents.zoo.shelf import load_policy
from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import FAILURE, SUCCESS, UNUSABLE
from dq_space_arm_env.common.tables import tabulate
from experts.demonstrations import SerialExecutor

LIMITS = {"success": 0.9, "violating": 0.1, "cost_gap": 0.05}
TINY = {"network": {"hidden": [4]}, "algorithm": {"name": "APG", "updates": 1, "copies": 2, "decisions": 10}}
N = 3


@pytest.fixture
def content(quick, tmp_path):
    """A suite of two scenes in files."""
    tasks = {}
    for number in (1, 2):
        scene = quick.replace(
            name=f"task-{number}", target={"pose": {"position": [1.0 + 0.1 * number, 0.3, 0.0]}}
        )
        file = tmp_path / f"task-{number}.yaml"
        scene.to_yaml(file)
        tasks[str(file)] = scene.content_hash()[:16]
    return {
        "name": "two tasks",
        "starts": N,
        "receding_starts": 1,
        "limits": LIMITS,
        "agents": {"tiny": TINY},
        "seeds": 2,
        "tasks": tasks,
    }


def test_scenes_of_the_shipped_suites_are_what_they_were():
    for name in list_suites():
        suite = load_suite(name)
        for task in suite.tasks:
            assert suite.scene(task).spread is not None
            for agent in suite.agents:
                assert suite.training(agent, task).scene == task


def test_a_scene_that_has_changed_is_refused(content):
    task = next(iter(content["tasks"]))
    suite = Suite.model_validate({**content, "tasks": {task: "0" * 16}})
    with pytest.raises(
        SuiteError, match=r"has the hash .*, should be 0000000000000000: the scene has changed"
    ):
        suite.scene(task)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"starts": 501}, "starts = 501"),
        ({"limits": {**LIMITS, "success": 2.0}}, "limits.success = 2"),
        ({"conditions": ["storm"]}, "must be one of training"),
        ({"conditions": ["training", "training"]}, "must stand there once"),
        ({"agents": {"gains": TINY}}, "is the name of a controller"),
        ({"tasks": {"paper": "xyz"}}, "tasks.paper = 'xyz'"),
        ({"tasks": {"paper": "0" * 16, "mine/paper.yaml": "0" * 16}}, "folders and policies of paper, the"),
        ({"color": "red"}, "color"),
    ],
)
def test_wrong_files_are_refused_in_words(content, tmp_path, change, sentence):
    file = tmp_path / "wrong.yaml"
    file.write_text(json.dumps({**content, **change}))  # JSON is YAML
    with pytest.raises(SuiteError, match=sentence):
        load_suite(file)
    file.write_text("- planar")
    with pytest.raises(SuiteError, match=r"wrong\.yaml: must be a mapping"):
        load_suite(file)


def test_unknown_names_are_refused(content):
    suite = Suite.model_validate(content)
    with pytest.raises(SuiteError, match="should be one of v1, or a YAML file"):
        load_suite("v0")
    with pytest.raises(SuiteError, match="task: 'nowhere' is unknown"):
        run_suite(["gains"], suite, tasks=["nowhere"])
    with pytest.raises(TypeError, match="entrants: 'gains', should be a sequence: put it into a list"):
        run_suite("gains", suite)
    with pytest.raises(
        SuiteError, match=r"entrant: 'magic' is unknown; choose from open-loop, gains, rec.*, apg, "
    ):
        run_suite(["magic"], suite)
    with pytest.raises(SuiteError, match=r"entrant: 'gainz' is unknown; did you mean 'gains'\?"):
        run_suite(["gainz"], suite)
    with pytest.raises(SuiteError, match="there is no such file"):
        run_suite(["nowhere/{task}.npz"], suite)
    with pytest.raises(SuiteError, match="zoo: no policy that ships was trained in"):
        run_suite(["zoo"], suite)
    for entrants, policies in (
        (["a=x.npz", "a=y.npz"], {}),
        (["one/b.yaml", "two/b.yaml"], {}),
        (["tiny"], {"tiny": still}),
        (["zoo"], {"apg (zoo)": still}),  # they would count as trainings of one agent
    ):
        with pytest.raises(SuiteError, match="two are named"):
            run_suite(entrants, suite, policies=policies)
    with pytest.raises(SuiteError, match=r"zoo=mine\.npz: zoo is the policies that ship"):
        run_suite(["zoo=mine.npz"], suite)
    with pytest.raises(PolicyError, match="apg maps 24 observations to 12 inputs"):
        run_suite(["tiny"], suite, policies={"apg": lambda scene: load_policy("apg")})  # and trains nothing
    with pytest.raises(SuiteError, match="residual corrects plans and cannot fly alone"):
        run_suite(["residual"], suite)  # and trains nothing
    with pytest.raises(ConfigurationError, match=r"algorithm\.name"):
        Suite.model_validate({**content, "agents": {"tiny": {}}}).training(
            "tiny", next(iter(content["tasks"]))
        )


def test_what_is_no_suite_is_named():
    with pytest.raises(SuiteError, match="suite: 3, should be one of v1"):
        load_suite(3)


def test_missing_files_of_tasks_are_told(tmp_path):
    (tmp_path / "one.npz").touch()
    files = {"mine": f"{tmp_path}/{{task}}.npz", "other": "anywhere.npz"}
    (note,) = missing_files(files, ["scenes/one.yaml", "two", "three"])
    assert note == f"mine: there is no file {files['mine']} for two, three"


def test_a_missing_run_folder_beside_is_told_as_any_file_is(tmp_path, monkeypatch):
    """Its name alone looks like one of the zoo."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine-one").mkdir()
    (tmp_path / "mine-one" / "policy.npz").touch()
    (note,) = missing_files({"mine": "mine-{task}"}, ["one", "two"])
    assert note == "mine: there is no file mine-{task} for two"
    assert not [*from_files({"mine": "mine-{task}"}, "two", load_scene("planar"), trust=False)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"success_rate": "high"}, "success_rate of mine in .*: 'high', should be three numbers"),
        ({"success_rate": [0.5]}, "success_rate of mine"),
        ({"violating_episodes": [0.0, None, 1.0]}, "violating_episodes of mine"),
        ({"success_rate": [0.9, 0.2, 0.6]}, r"success_rate of mine .* the first within the other two"),
        ({"success_rate": [True, False, True]}, "success_rate of mine"),
        ({"interquartile_mean_cost_gap": [0.0, -math.inf, math.inf]}, "cost_gap of mine"),
        ({"entrant": None}, "should be texts"),
        ({"solved": False}, "mine in .*, training: solved is False, should be True by its numbers"),
        ({"success_rate": None}, "solved is True, should be False by its numbers"),
    ],
)
def test_a_file_with_other_values_is_refused_before_anybody_flies(content, tmp_path, change, said):
    suite, task = Suite.model_validate(content), next(iter(content["tasks"]))
    run = SuiteRun(suite, (made([[True]], [[0.0]], task=task, entrant="mine"),), {task: ""}, ())
    record = suite_page(run, picture=False).record
    record["parts"]["tasks"]["scores"][0] |= change
    (tmp_path / "theirs.json").write_text(json.dumps(record))
    with pytest.raises(SuiteError, match=said):
        comparable(tmp_path / "theirs.json", suite, suite.tasks, ["mine"])


def test_a_file_that_judges_by_other_limits_or_leaves_scores_out_is_refused(content, tmp_path):
    both = {**content, "conditions": ["training", "push"]}
    (suite, file), task = (Suite.model_validate(both), tmp_path / "theirs.json"), next(iter(content["tasks"]))
    flown = made([[True] * 9 + [False]], [[0.0] * 10], task=task, entrant="mine")
    run = SuiteRun(suite, (flown, replace(flown, condition="push")), {task: ""}, ())
    record = suite_page(run, picture=False).record["parts"]["tasks"]

    def refused(said, suite=record["suite"], scores=record["scores"]):
        file.write_text(json.dumps({"parts": {"tasks": {"suite": suite, "scores": scores}}}))
        with pytest.raises(SuiteError, match=said):
            check(run, file)

    lenient = {**record["suite"], "limits": {**LIMITS, "success": 0.1}}
    refused("limits.success is 0.1 there and 0.9 here", suite=lenient)
    better = {**record["scores"][0], "success_rate": [1.0, 0.7, 1.0]}
    refused("mine has 2 scores in .*, training", scores=[better, *record["scores"]])
    refused("mine flew in .*, but not under push", scores=record["scores"][:1])


def test_the_page_tells_of_starts_without_an_optimum(content):
    """A gap over half of the starts reads like one over all of them."""
    few, all_known = [[0.01, 0.02, math.nan, math.nan]], [[0.01, 0.02, 0.03, 0.04]]
    scores = (
        made([[True] * 4], gaps, entrant=name)
        for name, gaps in zip("xyz", (all_known, few, few), strict=True)
    )
    page = suite_page(SuiteRun(Suite.model_validate(content), (*scores,), {"a": ""}, ()), picture=False)
    assert [row["unknown_optima"] for row in page.record["parts"]["tasks"]["scores"]] == [0, 2, 2]
    assert page.markdown().count("a, training: 2 of 4 starts have no cost gap and count in no profile") == 1


def test_percentiles_of_gaps_are_written_like_the_gaps_beside_them(content):
    scores = (made([[True]], [[gap]], entrant=name) for name, gap in (("x", 2e-15), ("y", 66.3)))
    page = suite_page(SuiteRun(Suite.model_validate(content), (*scores,), {"a": ""}, ()), picture=False)
    assert "| 0.0 | 0.0 |" in page.markdown()
    assert "| 6,630 | 6,630 |" in page.markdown()


def test_scores_of_one_flight_are_compared_without_an_interval_of_the_gap(content, tmp_path):
    suite, file = Suite.model_validate(content), tmp_path / "theirs.json"
    run, other = (SuiteRun(suite, (made([[True]], [[gap]]),), {"a": ""}, ()) for gap in (0.01, 0.02))
    page = suite_page(run, picture=False)
    assert page.record["parts"]["tasks"]["scores"][0]["interquartile_mean_cost_gap"][1:] == [None, None]
    file.write_text(json.dumps(page.record))
    assert [check(each, file)[0]["verdict"] for each in (run, other)] == ["equal", "differs"]


def still(scene):
    """A policy that does nothing, for a scene."""
    assert scene.spread is not None
    return lambda observations: np.zeros((len(observations), 6))


@pytest.mark.slow
@pytest.mark.agents
def test_entrants_of_all_kinds_fly_and_finished_ones_are_kept(
    content, cache, counting, tmp_path, monkeypatch
):
    pytest.importorskip("threadpoolctl")
    suite, out, executor = Suite.model_validate(content), tmp_path / "out", counting()
    fly = partial(run_suite, suite=suite, policies={"still": still}, out=str(out), executor=executor)
    run = fly(["open-loop", "gains", "tiny"])
    names = ["open-loop plan", "plan with gains", "tiny", "still"]
    assert [score.entrant for score in run.scores[:4]] == names
    assert len(run.scores) == 8
    assert not run.notes
    for score in run.scores:
        if score.entrant == "tiny":
            folders = [out / "trainings" / f"tiny-{task_name(score)}-{seed}" for seed in (0, 1)]
            alone = [evaluate(folder, score.task, N, executor=executor) for folder in folders]
            together = np.concatenate([each.flights.cost for each in alone])
            found = np.concatenate([row.evaluation.flights.cost for row in score.rows])
            np.testing.assert_array_equal(found, together)
        if score.entrant == "plan with gains":
            np.testing.assert_allclose(score.cost_gap.value, 0.0, rtol=0, atol=1e-9)
            assert score.solves(suite.limits)
    done = executor.tasks
    monkeypatch.setattr("agents.experiments.training_task.train", lambda *_: pytest.fail("trained again"))
    again = fly(["open-loop", "gains", "tiny", f"copy={out}/trainings/tiny-{{task}}-0"])
    for task in suite.tasks:
        first, copy = (
            next(each for each in again.scores if (each.task, each.entrant) == (task, name))
            for name in ("tiny", "copy")
        )
        np.testing.assert_array_equal(copy.rows[0].evaluation.cost_gaps, first.rows[0].evaluation.cost_gaps)
    assert executor.tasks == done + 4  # trainings, which find their policies
    mine, other = suite_page(again, picture=False).record, tmp_path / "other.json"
    other.write_text(json.dumps(mine))
    assert {row["verdict"] for row in check(again, other)} == {"equal"}


def task_name(score):
    return load_scene(score.task).name


def made(success, gaps, violations=None, task="a", entrant="x"):
    """A score of given flights, shape (runs, starts)."""
    rows = []
    for run, (reached, gap) in enumerate(zip(success, gaps, strict=True)):
        n = len(reached)
        zeros = np.zeros(n)
        shares = np.full(n, np.nan) if violations is None else np.array(violations[run])
        flights = Flights(
            1.0 + np.array(gap),
            np.array(reached),
            *(np.zeros(n, bool),) * 2,
            np.full(n, 9),
            *(zeros,) * 4,
            shares,
        )
        optimal = OptimalCosts(np.arange(n), np.ones(n), np.ones(n, bool), zeros)
        evaluation = Evaluation("x", "s", "training", np.arange(n), flights, optimal, 1e-6, 1.0, {})
        rows.append(Row(evaluation, {"planning_seconds": 0.0, "evaluation_command": None}))
    return Score(task, "training", entrant, tuple(rows))


def test_scores_by_hand(content):
    suite = Suite.model_validate(content)
    first = made([[True] * 4, [True, True, True, False]], [[0.0, 0.009, 0.02, 0.03], [0.04, 0.0, 0.009, 9.0]])
    assert first.success_rate.value == 7 / 8
    # The interquartile mean of 0, 0, .009, .009, .02, .03, .04, 9.
    assert first.cost_gap.value == pytest.approx((0.009 + 0.009 + 0.02 + 0.03) / 4)
    assert [share.value for share in first.within((0.005, 0.025, 10.0))] == [2 / 8, 5 / 8, 7 / 8]
    assert not first.solves(suite.limits)  # 87.5 % of 90 %
    second = made([[True] * 10], [[0.04] * 10], [[0.0] * 9 + [0.2]], task="b")
    assert second.violating is not None
    assert second.violating.value == 0.1
    assert second.solves(suite.limits)
    assert second.within((0.05,))[0].value == 0.9
    run = SuiteRun(suite, (first, second), {"a": "", "b": ""}, ())
    (row,) = overall_rows(run, "training")
    assert (row["tasks"], row["solved"]) == (2, 1)
    assert row["success_rate"][0] == pytest.approx((7 / 8 + 1.0) / 2)
    assert row["within_0.01"][0] == pytest.approx((4 / 8 + 0.0) / 2)


def test_the_page_tells_at_which_commits_policies_were_trained(content):
    score = made([[True]] * 6, [[0.0]] * 6)
    origins = [{"commit": {"hash": "b" * 40}}, {"commit": {"hash": "a" * 40}}, {"commit": None}, None]
    origins += ["our lab", {"commit": "our own"}]
    rows = tuple(
        replace(row, evaluation=replace(row.evaluation, metadata={"provenance": origin}))
        for row, origin in zip(score.rows, origins, strict=True)
    )
    suite = Suite.model_validate(content)
    run = SuiteRun(suite, (replace(score, rows=rows), replace(score, entrant="y")), {"a": ""}, ())
    page = suite_page(run, picture=False)
    known, unknown = page.record["parts"]["tasks"]["scores"]
    assert known["training_commits"] == ["a" * 40, "b" * 40]
    assert unknown["training_commits"] is None
    assert "| aaaaaaa, bbbbbbb |" in page.markdown()


def test_a_check_tells_equal_from_like_and_other(content, tmp_path):
    suite, file = Suite.model_validate(content), tmp_path / "theirs.json"

    def of(*scores):
        return SuiteRun(suite, scores, {"a": ""}, ())

    fine = made([[True] * 50], [[0.01] * 25 + [0.03] * 25])
    file.write_text(json.dumps(suite_page(of(fine), picture=False).record))
    near, far = made([[True] * 50], [[0.01] * 24 + [0.03] * 26]), made([[False] * 50], [[0.5] * 50])
    found = [check(of(score), file)[0]["verdict"] for score in (fine, near, far)]
    assert found == ["equal", "agrees", "differs"]
    near_b = made([[True] * 50], [[0.01] * 50], task="b")
    both = SuiteRun(suite, (fine, near_b), {"a": "", "b": ""}, ())
    file.write_text(json.dumps(suite_page(both, picture=False).record))
    (one,) = check(of(fine), file)  # b is none of its tasks
    rows = check(SuiteRun(suite, (fine,), both.descriptions, ()), file)
    assert [(row["task"], row["verdict"]) for row in (one, *rows)] == [
        ("a", "equal"),
        ("a", "equal"),
        ("b", "not flown"),
    ]
    tabulate("check", rows, check_columns()).for_terminal()
    with pytest.raises(SuiteError, match="has no score of y"):
        check(of(made([[True]], [[0.0]], entrant="y")), file)
    file.write_text('{"parts": {"tasks": {"suite": [], "scores": []}}}')
    with pytest.raises(SuiteError, match=r"suite: \[\], should be a mapping"):
        check(of(fine), file)
    file.write_text("{}")
    with pytest.raises(SuiteError, match="is not the JSON file of a suite"):
        check(of(fine), file)


def test_trainings_that_failed_count(content, tmp_path):
    suite, file = Suite.model_validate(content), tmp_path / "theirs.json"
    all_fly = made([[True] * 4] * 3, [[0.0] * 4] * 3)
    fewer = replace(all_fly, rows=all_fly.rows[:2])
    some_failed = replace(fewer, failed=1)
    assert [each.solves(suite.limits) for each in (all_fly, fewer, some_failed)] == [True, True, False]

    def write(score):
        record = suite_page(SuiteRun(suite, (score,), {"a": ""}, ()), picture=False).record
        file.write_text(json.dumps(record))
        return record

    def checked(score):
        return check(SuiteRun(suite, (score,), {"a": ""}, ()), file)

    write(all_fly)
    (row,) = checked(some_failed)
    assert (row["verdict"], row["runs"], row["their_runs"]) == ("differs", 2, 3)
    rows = checked(fewer)  # as by --seeds 2
    assert rows[0]["verdict"] == "equal"
    assert [*fewer_trainings(rows)] == ["x: runs here: 2, in the file: 3; intervals of fewer agree with more"]
    assert not [*fewer_trainings(checked(all_fly))]
    record = write(some_failed)
    assert checked(some_failed)[0]["verdict"] == "equal"
    (score,) = record["parts"]["tasks"]["scores"]
    wrong = {0: "solved is False, should be True", "1": "failed_trainings of x in a: '1', should be a whole"}
    for failed, sentence in wrong.items():
        score["failed_trainings"] = failed
        file.write_text(json.dumps(record))
        with pytest.raises(SuiteError, match=sentence):
            checked(some_failed)
    record = write(all_fly)
    del record["parts"]["tasks"]["scores"][0]["failed_trainings"]  # as in older files
    file.write_text(json.dumps(record))
    assert checked(all_fly)[0]["verdict"] == "equal"


def test_a_check_that_compares_nothing_is_refused_before_anybody_flies(content, tmp_path, monkeypatch):
    suite, task = Suite.model_validate(content), next(iter(content["tasks"]))
    run = SuiteRun(suite, (made([[True]], [[0.0]], task=task, entrant="mine"),), {task: ""}, ())
    file, theirs = tmp_path / "suite.yaml", tmp_path / "theirs.json"
    file.write_text(json.dumps(content))
    theirs.write_text(json.dumps(suite_page(run, picture=False).record))
    monkeypatch.setattr("agents.suite.running.run_suite", lambda *_, **__: pytest.fail("flown"))
    verb = ["gains", "other=a.npz", "--suite", str(file), "--out", str(tmp_path), "--check", str(theirs)]
    with pytest.raises(SuiteError, match="of plan with gains, other in these tasks, but of mine"):
        CliRunner().invoke(suite_verb, verb, catch_exceptions=False)
    other = list(content["tasks"])[1]
    with pytest.raises(SuiteError, match=r"has no score in .*task-2"):
        comparable(theirs, suite, [other], ["mine"])
    assert len(comparable(theirs, suite, suite.tasks, ["mine"])) == 1
    assert "apg (zoo)" in entrant_names((), suite)
    longer = suite.model_copy(update={"starts": N + 1})
    with pytest.raises(
        SuiteError, match=f"another suite than 'two tasks': starts is {N} there and {N + 1} here"
    ):
        comparable(theirs, longer, suite.tasks, ["mine"])
    own = (tmp_path / "suite.json").write_bytes(theirs.read_bytes())  # would be compared with itself
    verb = ["gains", "--suite", str(file), "--out", str(tmp_path), "--check", str(tmp_path / "suite.json")]
    refused = CliRunner().invoke(suite_verb, verb)
    assert refused.exit_code == UNUSABLE
    assert "give another --out" in refused.output
    assert (tmp_path / "suite.json").stat().st_size == own


def test_tasks_of_a_suite_may_be_files(content, tmp_path, monkeypatch):
    class FlownError(Exception):
        pass

    def fly(entrants, version, *, tasks, **_):
        raise FlownError(tasks)

    monkeypatch.setattr("agents.suite.running.run_suite", fly)
    task = next(iter(content["tasks"]))
    with pytest.raises(FlownError, match="task-1"):
        CliRunner().invoke(
            suite_verb, ["gains", "--task", task, "--out", str(tmp_path)], catch_exceptions=False
        )


def test_a_suite_whose_trainings_all_failed_has_a_page(content, tmp_path):
    page = suite_page(SuiteRun(Suite.model_validate(content), (), {"a": ""}, ("The training failed.",)))
    assert page.save(tmp_path) == ["report.html", "report.md", "report.json"]
    assert page.shortcomings == ["The training failed."]


def diverge(*_, **__):
    raise DivergedError("flights cost too much")


@pytest.mark.slow
@pytest.mark.agents
def test_the_verb_writes_page_and_json_and_tells_a_failed_training(content, cache, tmp_path, monkeypatch):
    pytest.importorskip("threadpoolctl")
    monkeypatch.setattr("agents.evaluation.expert_costs.local_executor", lambda workers: SerialExecutor())
    broken = {**TINY, "demonstrations": 3}
    file, out = tmp_path / "suite.yaml", tmp_path / "out"
    file.write_text(json.dumps(content))
    verb = ["--suite", str(file), "--out", str(out), "--seeds", "1", "--workers", "1"]
    assert main(["suite", "tiny", *verb]) == SUCCESS
    assert {path.name for path in out.glob("suite.*")} == {"suite.html", "suite.json", "suite.md"}
    record = json.loads((out / "suite.json").read_text())
    assert len(record["parts"]["tasks"]["scores"]) == 2
    assert "plan with gains" not in (out / "suite.md").read_text()
    monkeypatch.setattr("agents.experiments.training_task.train", diverge)
    assert main(["suite", "tiny", *verb, "--seeds", "2"]) == FAILURE
    record = json.loads((out / "suite.json").read_text())
    scores = record["parts"]["tasks"]["scores"]
    assert [(score["runs"], score["failed_trainings"]) for score in scores] == [(1, 1), (1, 1)]
    assert "The training of tiny-task-1, seed 1, failed: flights cost" in (out / "suite.md").read_text()
    (out / "suite.md").unlink()
    with pytest.raises(SuiteError, match="is not the JSON file of a suite"):  # before anybody flies
        CliRunner().invoke(suite_verb, ["tiny", *verb, "--check", str(file)], catch_exceptions=False)
    assert not (out / "suite.md").exists()
    file.write_text(json.dumps({**content, "agents": {"tiny": broken}}))
    with pytest.raises(ConfigurationError, match="demonstrations"):
        CliRunner().invoke(suite_verb, ["tiny", *verb], catch_exceptions=False)
