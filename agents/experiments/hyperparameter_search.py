"""A search for hyperparameters by Optuna: trials are trainings, judged by their learning curves.

The folder of a search:

| file | content |
|---|---|
| `journal.log` | the study: what was tried, and how good it was, by Optuna |
| `trials/<name>-trial-<number>-<seed>/` | the run folder of each trial |
| `best.yaml` | the best configuration, which `train` takes |
| `search.json`, `search.png` | table and picture of the trials |
| `.lock` | locked while a process searches here |
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agents.configuration import AgentConfiguration, ConfigurationError
from agents.experiments.many_trainings import (
    Overview,
    Report,
    run_trainings,
    training_executor,
    training_task,
)
from agents.experiments.search_space import SearchSpace, with_values
from agents.experiments.shared_demonstrations import SharedDemonstrations
from agents.experiments.training_task import FAILED, PRUNE, PRUNED, TRAINED, TrainingTask
from agents.run_folder import RunFolderError, learned, reserved
from dq_space_arm_env import load_scene
from dq_space_arm_env.common.files import differences, write_atomically
from dq_space_arm_env.common.tables import Row
from dq_space_arm_env.validation import dump_yaml
from experts.executors import Executor

if TYPE_CHECKING:
    import optuna

JOURNAL, TRIALS, BEST = "journal.log", "trials", "best.yaml"
TIE = 1e-4
"""Largest part of a score that the cost decides: less than one success of 10,000."""
_STUDY = "search"


class Found(NamedTuple):
    """Result of a search: a row for each trial, and the best one's file, if one was trained to the end."""

    trials: list[Row]
    best: Row | None
    file: Path | None


def score(point: Mapping[str, Any]) -> float:
    """Objective of a point of the learning curve: more successes, less violations, then the lower cost."""
    cost = max(float(point["median_cost"]), 0.0)
    share = float(point["success_rate"]) - (point.get("violating_episodes") or 0.0)
    return share + (TIE / (1.0 + cost) if np.isfinite(cost) else 0.0)


def search(
    configuration: AgentConfiguration,
    space: SearchSpace,
    trials: int,
    out: Path,
    *,
    prune: bool = True,
    executor: Executor | None = None,
    report: Report = lambda advance: None,
) -> Found:
    """Search for hyperparameters, or resume a search.

    Args:
        configuration: What is trained, with other values of some keys in each trial.
        space: These keys and their values.
        trials: Number of trials of the folder, those of earlier calls included.
        out: Folder of the search.
        prune: Whether to stop trials whose learning curve falls below the median of the others.
        executor: Runs the trials; processes of this machine by default.
        report: Called now and then with the progress of all.

    Returns:
        The trials, and the best configuration.

    Raises:
        ImportError: If Optuna is not installed.
        ConfigurationError: If there is no trial.
        SceneError: If the scene cannot be loaded.
        RunFolderError: If the folder is for another search, or damaged, or another process searches there.
        ExecutorError: If the cluster cannot be used.
    """
    if not isinstance(trials, int | np.integer) or trials < 1:
        raise ConfigurationError(f"trials: {trials!r}, should be a whole number of at least 1")
    with reserved(out):
        study = _opened(out, prune)
        _check_identity(study, configuration, space, out)
        chosen = executor or training_executor([configuration])
        running = _Search(study, configuration, space, out, trials)
        running.run(chosen, report)
        rows = running.rows()
        if not any(row["outcome"] == TRAINED for row in rows):
            return Found(rows, None, None)
        best = rows[study.best_trial.number]
        values = running.values(study.best_trial.params)
    kept = with_values(configuration, values, f"{configuration.name}-best")
    header = f"# The best of {len(rows)} trials, number {best['trial']}.\n"
    content = dump_yaml(kept.model_dump(mode="json", exclude_none=True), header)
    write_atomically(out / BEST, content)
    return Found(rows, best, out / BEST)


class _Search:
    """Trials of a study, some of them under way."""

    def __init__(
        self,
        study: optuna.Study,
        configuration: AgentConfiguration,
        space: SearchSpace,
        out: Path,
        trials: int,
    ) -> None:
        self._study, self._configuration, self._space = study, configuration, space
        self._out, self._trials = out, trials
        found = sum(trial.state.is_finished() for trial in study.get_trials(deepcopy=False))
        self._overview = Overview(max(trials, found), "trials", found)
        self._under_way: dict[str, tuple[optuna.Trial, TrainingTask]] = {}  # by folder
        self._lock = threading.Lock()  # a trial is told the study once, and nothing after that

    def run(self, executor: Executor, report: Report) -> None:
        """Run the trials that are missing, those first that were interrupted."""
        from optuna.trial import TrialState

        overview = self._overview
        demonstrations = SharedDemonstrations(executor, overview.say)
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            demonstrations.remember(self._task(trial.number, trial.params))

        def show(advance: Any) -> None:
            self._watch()
            report(advance)

        tasks = (demonstrations.provided(task) for task in self._tasks())
        for row in run_trainings(executor, tasks, overview, show):
            self._end(row)

    def values(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Values of a trial, as a configuration has them."""
        labels = {key: parameter.labels for key, parameter in self._space.search.items()}
        return {key: labels[key].get(value, value) for key, value in params.items()}

    def rows(self) -> list[Row]:
        """A row for each trial: number, values, outcome, and the last point of its learning curve."""
        from optuna.trial import TrialState

        outcomes = {TrialState.COMPLETE: TRAINED, TrialState.PRUNED: PRUNED, TrialState.FAIL: FAILED}
        rows: list[Row] = []
        for trial in self._study.get_trials(deepcopy=False):
            training = training_task(self._named(trial.number), self._out / TRIALS)
            facts = training.row(outcomes.get(trial.state, "interrupted"), **trial.user_attrs)
            kept = {name: value for name, value in facts.items() if name not in ("agent", "seed")}
            rows.append({"trial": trial.number, **self.values(trial.params), **kept})
        return rows

    def _tasks(self) -> Iterator[TrainingTask]:
        from optuna import Trial
        from optuna.trial import TrialState

        interrupted = self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        for trial in interrupted:  # some may lack values
            self._seed(trial.number)
            yield from self._begin(Trial(self._study, trial._trial_id))
        while (number := len(self._study.get_trials(deepcopy=False))) < self._trials:
            self._seed(number)
            yield from self._begin(self._study.ask())

    def _seed(self, number: int) -> None:
        """Seed the sampler by the trial: a resumed search does not repeat what it began with."""
        from optuna.samplers import TPESampler

        seed = np.random.SeedSequence([self._configuration.seed, number]).generate_state(1)[0]
        self._study.sampler = TPESampler(seed=int(seed))

    def _begin(self, trial: optuna.Trial) -> Iterator[TrainingTask]:
        """The training of a trial; none where its values do not go together."""
        from optuna.trial import TrialState

        params: dict[str, Any] = {}
        for key, parameter in self._space.search.items():
            if parameter.choices is not None:
                params[key] = trial.suggest_categorical(key, list(parameter.labels))
            elif parameter.is_whole:
                params[key] = trial.suggest_int(key, parameter.low, parameter.high, log=parameter.log)
            else:
                params[key] = trial.suggest_float(key, parameter.low, parameter.high, log=parameter.log)
        try:
            task = self._task(trial.number, params)
        except ConfigurationError as error:
            trial.set_user_attr("failure", str(error))
            self._study.tell(trial.number, state=TrialState.FAIL)
            self._overview.end({"folder": "", "outcome": FAILED})  # it has none
            return
        (task.folder / PRUNE).unlink(missing_ok=True)  # it is decided anew
        with self._lock:
            self._under_way[str(task.folder)] = trial, task
        yield task

    def _task(self, number: int, params: Mapping[str, Any]) -> TrainingTask:
        """The training of a trial; ConfigurationError where its values do not go together."""
        name = self._named(number).name
        configuration = with_values(self._configuration, self.values(params), name)
        return training_task(configuration, self._out / TRIALS)

    def _named(self, number: int) -> AgentConfiguration:
        name = f"{self._configuration.name}-trial-{number}"
        return self._configuration.model_copy(update={"name": name})

    def _watch(self) -> None:
        """Tell the study the new points of learning curves, and stop trials that it gives up."""
        with self._lock:
            for trial, task in self._under_way.values():
                if self._report(trial, task) and trial.should_prune():
                    (task.folder / PRUNE).touch()

    def _report(self, trial: optuna.Trial, task: TrainingTask) -> bool:
        """Tell the study the points that it does not know; whether there are any."""
        points: list[dict[str, Any]] = []
        with suppress(RunFolderError):
            points = learned(task.folder)
        known = len(self._study.get_trials(deepcopy=False)[trial.number].intermediate_values)
        for step, point in enumerate(points[known:], start=known):
            trial.report(score(point), step)
        return len(points) > known

    def _end(self, row: Row) -> None:
        from optuna.trial import TrialState

        with self._lock:
            trial, task = self._under_way.pop(row["folder"])
            self._report(trial, task)
            for name in ("failure", "traceback"):
                if name in row:
                    trial.set_user_attr(name, row[name])
            if row["outcome"] == TRAINED:
                self._study.tell(trial.number, score(row))
            else:
                state = TrialState.PRUNED if row["outcome"] == PRUNED else TrialState.FAIL
                self._study.tell(trial.number, state=state)


def _opened(out: Path, prune: bool) -> optuna.Study:
    """The study in a folder that this process has locked."""
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ImportError('a search needs optuna: pip install "dq-space-arm[search]"') from error
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal = out / JOURNAL
    _repair(journal)
    pruner = optuna.pruners.MedianPruner(n_warmup_steps=1) if prune else optuna.pruners.NopPruner()
    try:
        storage = JournalStorage(JournalFileBackend(str(journal)))
        return optuna.create_study(
            study_name=_STUDY, storage=storage, pruner=pruner, direction="maximize", load_if_exists=True
        )
    except (AssertionError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"{journal} is damaged ({type(error).__name__}: {error}): repair it, or use another folder"
        ) from error


def _repair(journal: Path) -> None:
    """Remove what a killed process left: a lock, and half a line at the end."""
    for left in journal.parent.glob(f"{JOURNAL}.lock*"):
        left.unlink(missing_ok=True)
    if journal.exists():
        content = journal.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            write_atomically(journal, content[:whole])


def _check_identity(
    study: optuna.Study, configuration: AgentConfiguration, space: SearchSpace, out: Path
) -> None:
    """Refuse a folder that was started with another configuration, space or scene."""
    here = {
        "configuration": configuration.model_dump(mode="json", exclude_none=True, exclude={"description"}),
        "space": space.model_dump(mode="json", exclude_none=True),
        "scene": load_scene(configuration.scene).content_hash(),
    }
    there = study.user_attrs.get("identity")
    if there is None:
        study.set_user_attr("identity", here)
        return
    found = differences(there, here)
    if found:
        raise RunFolderError(
            f"{out} was started with another search: {'; '.join(found)}. Use that one, or use another folder"
        )
