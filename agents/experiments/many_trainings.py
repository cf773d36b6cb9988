"""Several seeds of several configurations, trained side by side: finished runs are kept, others resume."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from time import perf_counter

import numpy as np

from agents.configuration import AgentConfiguration, ConfigurationError
from agents.evaluation.comparison_tables import COLUMNS
from agents.evaluation.statistics import interquartile_mean
from agents.experiments.shared_demonstrations import SharedDemonstrations
from agents.experiments.training_task import FAILED, TRAINED, TrainingTask
from agents.training import default_folder, is_trained, warn_of_equal_starts, with_changes
from dq_space_arm_env.common.host_machine import processors
from dq_space_arm_env.common.progress import Advance, Status
from dq_space_arm_env.common.tables import Column, Row, TextTable, tabulate
from experts.executors import Executor, ProcessExecutor

Report = Callable[[Advance], None]
_PARTS = 1000  # of a training, in the bar

SUCCESS = Column("success_rate", "success\n%", lambda share: f"{100.0 * share:.1f}")
COST = Column("median_cost", "cost", ".5g")
SECONDS = replace(COLUMNS["training_seconds"], key="seconds")
VIOLATING = Column("violating_episodes", "violating\n%", SUCCESS.format)
OUTCOME = Column("outcome", "")
_STEPS = Column("environment_steps", "environment\nsteps", COLUMNS["training_steps"].format)
_COLUMNS = ("agent", "seed", SUCCESS, VIOLATING, COST, _STEPS, SECONDS, OUTCOME)


class Overview:
    """How far many trainings have come, from what each notes in its folder."""

    def __init__(self, total: int, name: str = "trainings", found: int = 0) -> None:
        self._total, self._name = total, name
        self._found = float(found)  # trainings, and parts of some, that earlier calls have done
        self._under_way: dict[str, TrainingTask] = {}
        self._done, self._failed, self._begun, self._line = found, 0, perf_counter(), ""

    def begin(self, task: TrainingTask) -> None:
        """Watch a training from now on."""
        self._found += 1.0 if is_trained(task.configuration, task.folder) else _share(task.progress())
        self._line, self._under_way[str(task.folder)] = "", task

    def end(self, row: Row) -> None:
        """Count a training that has ended."""
        self._under_way.pop(row["folder"], None)
        self._done += 1
        self._failed += row["outcome"] == FAILED

    @property
    def is_complete(self) -> bool:
        """Whether all have ended; a cluster may take seconds to let go."""
        return self._done >= self._total

    def say(self, advance: Advance) -> None:
        """Show what happens before the next training begins."""
        self._line = f"; {advance.describe()}"

    def status(self) -> Status:
        """The progress of all of them together."""
        under_way = [(task.label, task.progress()) for task in list(self._under_way.values())]
        shares = [_share(each) for _, each in under_way]
        share = min((self._done + sum(shares)) / self._total, 1.0)
        line = f"{self._done} of {self._total} {self._name}, {share:.0%}"
        if self._failed:
            line += f", {self._failed} failed"
        spent = perf_counter() - self._begun
        new = share - self._found / self._total
        if new > 0.0 and share < 1.0:
            line += f", about {timedelta(seconds=round(spent * (1.0 - share) / new))} left"
        if self._line:
            line += self._line
        elif under_way:
            label, first = under_way[0]
            line += f"; {label}: {first.line}"
        return Status(int(_PARTS * share), _PARTS, line)


def _share(status: Status) -> float:
    """Share of a training that is done."""
    return min(status.done / max(status.total, 1), 1.0)


def run_trainings(
    executor: Executor, tasks: Iterable[TrainingTask], overview: Overview, report: Report
) -> Iterator[Row]:
    """Run trainings; yields the row of each that ends."""

    def begun() -> Iterator[TrainingTask]:
        for task in tasks:
            overview.begin(task)
            yield task

    def show() -> None:
        if not overview.is_complete:
            report(overview.status())

    with _every_second(show), closing(executor.run(begun())) as results:
        for row in results:
            overview.end(row)
            yield row
    report(overview.status())


def train_seeds(
    configurations: Sequence[AgentConfiguration],
    count: int,
    out: Path,
    *,
    first: int | None = None,
    executor: Executor | None = None,
    report: Report = lambda advance: None,
) -> list[Row]:
    """Train each configuration with several seeds, each in its folder, out/<name>-<seed>.

    Args:
        configurations: The configurations.
        count: Number of seeds.
        out: Folder of the run folders.
        first: First seed; that of each configuration by default.
        executor: Runs the trainings; processes of this machine by default.
        report: Called now and then with the progress of all.

    Returns:
        A row for each training, in this order: agent, seed, outcome, the last point of its learning curve
        (flights from validation starts), and where it failed, why.

    Raises:
        ConfigurationError: If two configurations share a name, or there is no seed.
        SceneError: If a scene cannot be loaded.
        ExecutorError: If the cluster cannot be used.
        ImportError: If an extra is not installed; finished runs remain.
    """
    if not isinstance(count, int | np.integer) or count < 1:
        raise ConfigurationError(f"seeds: {count!r}, should be a whole number of at least 1")
    names = [each.name for each in configurations]
    shared = next((name for name in names if names.count(name) > 1), None)
    if shared is not None:
        raise ConfigurationError(
            f"two configurations are named {shared!r}, and would share run folders: give them different names"
        )
    tasks = []
    for each in configurations:
        warn_of_equal_starts(each)
        begin = each.seed if first is None else first
        tasks += [training_task(with_changes(each, seed=begin + i), out) for i in range(count)]
    chosen = executor or training_executor(configurations)
    overview = Overview(len(tasks))
    demonstrations = SharedDemonstrations(chosen, overview.say)
    provided = (demonstrations.provided(task) for task in tasks)
    rows = {row["folder"]: row for row in run_trainings(chosen, provided, overview, report)}
    return [rows[str(task.folder)] for task in tasks]


def training_task(configuration: AgentConfiguration, out: Path) -> TrainingTask:
    """A training in its default folder inside of `out`."""
    folder = out.absolute() / default_folder(configuration).name
    return TrainingTask(configuration, folder, Path.cwd())


def training_executor(
    configurations: Sequence[AgentConfiguration], workers: int | None = None
) -> ProcessExecutor:
    """Processes for trainings: by default as many as have their threads' processors to themselves."""
    if workers is None:
        workers = max(1, processors() // max(each.threads for each in configurations))
    return ProcessExecutor(workers)


def trainings_table(rows: Sequence[Row]) -> TextTable:
    """A table of trainings."""
    return tabulate("Trainings, flown from validation starts; cost: median", rows, known(_COLUMNS, rows))


def known(columns: Sequence[Column | str], rows: Sequence[Row]) -> list[Column | str]:
    """The columns without that of violations where nothing can be violated."""
    can_violate = any(row.get(VIOLATING.key) is not None for row in rows)
    return [each for each in columns if can_violate or each is not VIOLATING]


def seeds_table(summaries: Sequence[Row]) -> TextTable:
    """A table of configurations, each over its seeds."""
    title = "Seeds taken together; cost: interquartile mean of their medians"
    columns: list[Column | str] = ["agent", "seeds", SUCCESS]
    columns += [Column(key, f"{key}\n%", SUCCESS.format) for key in ("lowest", "highest")]
    return tabulate(title, summaries, [*columns, COST, SECONDS])


def seed_summaries(rows: Sequence[Row]) -> Iterator[Row]:
    """A row for each configuration of which several seeds were trained to the end."""
    for agent in dict.fromkeys(row["agent"] for row in rows):
        trained = [row for row in rows if row["agent"] == agent and row["outcome"] == TRAINED]
        if len(trained) > 1:
            shares = [row["success_rate"] for row in trained]
            yield {
                "agent": agent,
                "seeds": len(trained),
                "success_rate": float(np.mean(shares)),
                "lowest": min(shares),
                "highest": max(shares),
                "median_cost": interquartile_mean([row["median_cost"] for row in trained]),
                "seconds": float(np.mean([row["seconds"] for row in trained])),
            }


@contextmanager
def _every_second(show: Callable[[], None]) -> Iterator[None]:
    """Call a function once a second inside a block, in a thread: the block waits for processes."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(1.0):
            show()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
