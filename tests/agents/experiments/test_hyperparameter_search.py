"""A search proposes within its space, resumes after kills, judges by learning curves, and writes the best."""

import json
import math
import sys
from pathlib import Path

import pytest

pytest.importorskip("threadpoolctl")

from agents.command_line.search import search as search_verb
from agents.configuration import AgentConfiguration, ConfigurationError, load_configuration
from agents.configuration.gradients import FlightMismatch
from agents.experiments.hyperparameter_search import JOURNAL, score, search
from agents.experiments.search_space import SearchSpace, load_search_space, with_values
from agents.experiments.training_task import PRUNE
from agents.run_folder import RunFolderError, learned
from dq_space_arm_env.common.progress import Status
from experts.demonstrations import SerialExecutor

pytestmark = pytest.mark.agents

SPACE = """
search:
  algorithm.learning_rate: {low: 1e-3, high: 3e-2, log: true}
  algorithm.copies: {low: 4, high: 8}
  network.hidden: {choices: [[8], [6, 6]]}
"""


@pytest.fixture
def space_file(tmp_path: Path) -> Path:
    path = tmp_path / "space.yaml"
    path.write_text(SPACE)
    return path


@pytest.fixture
def space(space_file: Path, configuration: AgentConfiguration) -> SearchSpace:
    return load_search_space(space_file, configuration)


class Interrupted:
    """Runs trials here, and is interrupted before it hands out the result of one."""

    def __init__(self, after: int) -> None:
        self.after = after

    def run(self, tasks):
        for number, row in enumerate(SerialExecutor().run(tasks)):
            if number == self.after:
                raise KeyboardInterrupt
            yield row


def test_a_search_resumes_and_its_best_can_be_trained(
    configuration: AgentConfiguration, space: SearchSpace, tmp_path: Path
) -> None:
    pytest.importorskip("optuna")
    whole = search(configuration, space, 3, tmp_path / "whole", executor=SerialExecutor())
    out = tmp_path / "resumed"
    with pytest.raises(KeyboardInterrupt):
        search(configuration, space, 3, out, executor=Interrupted(1))
    # A killed process leaves a lock and half a line.
    (out / f"{JOURNAL}.lock").symlink_to(JOURNAL)
    with (out / JOURNAL).open("a") as journal:
        journal.write('{"op_code": 5, "wor')
    found = search(configuration, space, 3, out, executor=SerialExecutor())
    for one, other in zip(whole.trials, found.trials, strict=True):
        kept = one.keys() - {"folder", "seconds"}
        assert {name: one[name] for name in kept} == {name: other[name] for name in kept}
    for row in found.trials:
        assert row["outcome"] == "trained"
        assert 1e-3 <= row["algorithm.learning_rate"] <= 3e-2
        assert row["algorithm.copies"] in range(4, 9)
        assert row["network.hidden"] in ([8], [6, 6])
        trained = load_configuration(Path(row["folder"]) / "config.yaml")
        assert trained.algorithm.learning_rate == row["algorithm.learning_rate"]
        assert list(trained.network.hidden) == row["network.hidden"]
        assert row["median_cost"] == learned(Path(row["folder"]))[-1]["median_cost"]
    assert len({row["algorithm.learning_rate"] for row in found.trials}) == 3
    assert found.best is not None
    assert score(found.best) == max(map(score, found.trials))
    best = load_configuration(out / "best.yaml")
    assert best.name == "quick-best"
    assert best.algorithm.learning_rate == found.best["algorithm.learning_rate"]

    # It goes on from where it ended, and only with the same search.
    more = search(configuration, space, 4, out, executor=SerialExecutor())
    assert more.trials[:3] == found.trials
    assert len(more.trials) == 4
    wider = configuration.model_copy(update={"seed": 1})
    with pytest.raises(RunFolderError, match=r"another search: configuration.seed is 0 there and 1 here"):
        search(wider, space, 4, out, executor=SerialExecutor())


@pytest.mark.slow
def test_more_trials_learn_from_the_demonstrations_of_finished_ones(
    small_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    pytest.importorskip("torch")
    content = {"name": "clone", "scene": str(small_file), "demonstrations": {"problems": 4}}
    algorithm = {"name": "cloning", "optimization": {"updates": 3, "batch_size": 4}, "validate_every": 3}
    configuration = load_configuration({**content, "algorithm": algorithm})
    rates = {"algorithm.optimization.learning_rate": {"low": 1e-3, "high": 1e-2}}
    space = SearchSpace.model_validate({"search": rates})
    search(configuration, space, 1, tmp_path, executor=SerialExecutor())
    shared = "agents.experiments.shared_demonstrations.prepare_demonstrations"
    monkeypatch.setattr(shared, lambda *_, **__: pytest.fail("generated again"))
    found = search(configuration, space, 2, tmp_path, executor=SerialExecutor())
    assert [row["outcome"] for row in found.trials] == ["trained", "trained"]


def test_a_trial_that_is_given_up_stops(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    monkeypatch.setattr("agents.experiments.training_task.BETWEEN_NOTES", 0.0)
    space = SearchSpace.model_validate({"search": {"algorithm.learning_rate": {"low": 1e-3, "high": 1e-2}}})

    class Behind:
        """Gives up the second trial, as the median of many would."""

        def run(self, tasks):
            for number, task in enumerate(tasks):
                if number == 1:
                    (task.folder / PRUNE).touch()
                yield task.run()

    found = search(configuration, space, 2, tmp_path / "pruned", executor=Behind())
    assert [row["outcome"] for row in found.trials] == ["trained", "pruned"]
    assert not (Path(found.trials[1]["folder"]) / "policy.npz").exists()


def test_values_that_do_not_go_together_are_a_failed_trial(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    impossible = SearchSpace.model_validate(
        {
            "search": {
                "algorithm.copies": {"choices": [1000, 2_000_000]},
                "algorithm.decisions": {"choices": [2, 1000]},
            }
        }
    )

    def fail(*arguments, **options):
        raise ValueError("not trained here")

    monkeypatch.setattr("agents.experiments.training_task.train", fail)
    told: list[Status] = []
    out = tmp_path / "impossible"
    none = search(configuration, impossible, 8, out, executor=SerialExecutor(), report=told.append)
    assert told[-1].line == "8 of 8 trials, 100%, 8 failed"
    assert (none.best, none.file) == (None, None)
    for row in none.trials:
        together = row["algorithm.copies"] * row["algorithm.decisions"] > 100_000_000
        assert ("fit into memory" in row["failure"]) == together
        assert row["outcome"] == "failed"
    assert len({row["failure"] == "not trained here" for row in none.trials}) == 2


def test_the_median_of_the_others_decides(
    configuration: AgentConfiguration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Learning curves are read while trials are under way."""
    pytest.importorskip("optuna")
    space = SearchSpace.model_validate({"search": {"algorithm.learning_rate": {"low": 1e-3, "high": 1e-2}}})
    stopped: list[int] = []

    def curve(folder: Path, cost: float, points: int) -> None:
        lines = [
            {"environment_steps": 10 * step, "seconds": 1.0, "success_rate": 0.0, "median_cost": cost}
            for step in range(1, points + 1)
        ]
        (folder / "config.yaml").touch()
        (folder / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    class Flown:
        """Trainings whose curves are known; the sixth and seventh differ."""

        def run(self, tasks):
            for number, task in enumerate(tasks):
                task.folder.mkdir(parents=True, exist_ok=True)
                cost = {5: 900.0, 6: 1.0}.get(number, 100.0 + number)
                curve(task.folder, cost, 3)
                watched[0]()
                if (task.folder / PRUNE).exists():
                    stopped.append(number)
                yield task.row("trained")

    watched: list = []

    class Watched:
        def __enter__(self):
            return None

        def __exit__(self, *error):
            return None

    def every_second(show):
        watched.append(show)
        return Watched()

    monkeypatch.setattr("agents.experiments.many_trainings._every_second", every_second)
    found = search(configuration, space, 7, tmp_path, executor=Flown())
    assert stopped == [5]
    assert found.best is not None
    assert found.best["trial"] == 6


def test_more_successes_win_and_a_tie_goes_to_the_lower_cost() -> None:
    points = (0.0, math.inf), (0.0, 1e5), (0.0, 10.0), (1 / 64, 1e6), (1.0, 1422.2), (1.0, 1422.1)
    scores = [score({"success_rate": rate, "median_cost": cost}) for rate, cost in points]
    assert scores == sorted(scores)
    assert len(set(scores)) == len(scores)


def test_flights_that_violate_count_against_successes() -> None:
    careless = {"success_rate": 0.99, "median_cost": 1.0, "violating_episodes": 0.9}
    assert score(careless) < score({"success_rate": 0.98, "median_cost": 1.0, "violating_episodes": 0.0})


def test_a_trial_that_was_given_up_is_not_where_nothing_is(
    configuration: AgentConfiguration, tmp_path: Path
) -> None:
    """Its folder still says so after an interrupt."""
    pytest.importorskip("optuna")
    space = SearchSpace.model_validate({"search": {"algorithm.learning_rate": {"low": 1e-3, "high": 1e-2}}})
    folder = tmp_path / "trials" / f"{configuration.name}-trial-0-{configuration.seed}"
    folder.mkdir(parents=True)
    (folder / PRUNE).touch()
    found = search(configuration, space, 1, tmp_path, prune=False, executor=SerialExecutor())
    assert [(row["outcome"], row["folder"]) for row in found.trials] == [("trained", str(folder))]


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (
            "{algorithm.learning_rat: {low: 1e-3, high: 1e-2}}",
            "algorithm.learning_rat: unknown key; did you mean 'learning_rate'?",
        ),
        (
            "{algorithm.copies: {low: 0.5, high: 8}}",
            "algorithm.copies: the value 0.5 is not possible",
        ),
        ("{algorithm.copies: {low: 8, high: 8}}", r"high = 8: must be larger than low, which is 8"),
        ("{algorithm.copies: {low: 4.0, high: 8}}", r"algorithm.copies: the value 6\.47\d* is not possible"),
        (
            "{network: {choices: [{hidden: [8]}, {hidden: [9]}]}, network.hidden: {choices: [[4], [5]]}}",
            r"search.network.hidden: is part of search.network: give one of them",
        ),
        ("{algorithm.copies: {low: 8}}", "high = null: is missing: give low and high, or choices"),
        ("{algorithm.copies: {low: eight, high: 9}}", r"low = 'eight': must be a finite number"),
        (
            "{algorithm.copies: {low: 0, high: 9, log: true}}",
            "low = 0: must be positive",
        ),
        ("{algorithm.copies: {low: 1, high: 9, logg: true}}", "logg: unknown key; did you mean 'log'?"),
        ("{network.hidden: {choices: [[8]]}}", "must be two or more, all different"),
        ("{network.hidden: {choices: [[8], 9]}}", r"network.hidden = 9: must be a list"),
        ("{network.hidden: {choices: [[8], [9]], low: 1}}", "must stand alone"),
        ("{network.activation: {choices: [tanh, 2020-01-01]}}", r"network.activation: the value .*2020"),
        ("{seed: {low: 0, high: 9}}", "search.seed: seed is no hyperparameter: leave it out"),
        ("{demonstrations.seed: {low: 0, high: 9}}", "demonstrations.seed is no hyperparameter"),
        (
            "{progression.evaluation_episodes: {low: 1, high: 9}}",
            "search.progression.evaluation_episodes: progression says how trials are judged, and has to be",
        ),
        ("{schedule.total_steps: {low: 1, high: 9}}", "schedule says how trials are judged"),
        ("{curve: {choices: [{episodes: 1}, {episodes: 9}]}}", "curve says how trials are judged"),
        ("{}", "search"),
        ("3", "search = 3: must be a mapping"),
    ],
)
def test_wrong_spaces_are_named(
    space: str, message: str, configuration: AgentConfiguration, tmp_path: Path
) -> None:
    path = tmp_path / "space.yaml"
    path.write_text(f"search: {space}\n")
    with pytest.raises(ConfigurationError, match=message.replace("?", r"\?")) as caught:
        load_search_space(path, configuration)
    assert str(path) in str(caught.value)
    path.write_text("[search]\n")
    with pytest.raises(ConfigurationError, match=r"space\.yaml: must be a mapping"):
        load_search_space(path, configuration)


def test_the_mismatch_of_flights_that_judge_is_no_hyperparameter(
    configuration: AgentConfiguration, tmp_path: Path
) -> None:
    path = tmp_path / "space.yaml"
    path.write_text("search: {mismatch.push: {low: 0.0, high: 0.1}}\n")
    content = {"name": "corrections", "algorithm": {"name": "residual-PPO"}, "schedule": {"total_steps": 1}}
    with pytest.raises(ConfigurationError, match=r"mismatch\.push: mismatch says how trials are judged"):
        load_search_space(path, load_configuration(content))
    disturbed = configuration.model_copy(update={"mismatch": FlightMismatch()})  # its flights meet none
    assert "mismatch.push" in load_search_space(path, disturbed).search


def test_values_go_where_their_keys_point(configuration: AgentConfiguration) -> None:
    changed = with_values(configuration, {"network.hidden.0": 7, "algorithm.end_weight": 10.0}, "other")
    assert (changed.name, changed.network.hidden, changed.algorithm.end_weight) == ("other", (7,), 10.0)
    assert changed.algorithm.copies == configuration.algorithm.copies
    with pytest.raises(ConfigurationError, match="has 1 entries, the first is 0; there is no '3'"):
        with_values(configuration, {"network.hidden.3": 7})


def test_the_verb_prints_and_writes_the_trials(
    configuration_file: Path, space_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("optuna")
    out = tmp_path / "search"
    words = [str(configuration_file), str(space_file), "--trials", "2", "--workers", "1", "--out", str(out)]
    assert search_verb.main([*words, "--no-picture"], standalone_mode=False) == 0
    printed = capsys.readouterr().out
    assert "Best: trial" in printed
    record = json.loads((out / "search.json").read_text())
    assert [row["trial"] for row in record["trials"]] == [0, 1]
    assert record["search"]["algorithm.copies"] == {"low": 4, "high": 8, "log": False}
    pytest.importorskip("matplotlib")
    assert search_verb.main(words, standalone_mode=False) == 0
    assert (out / "search.png").read_bytes().startswith(b"\x89PNG")


def test_without_optuna_a_sentence_tells_how_to_get_it(
    configuration: AgentConfiguration, space: SearchSpace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ImportError, match=r'a search needs optuna: pip install "dq-space-arm\[search\]"'):
        search(configuration, space, 1, tmp_path)
