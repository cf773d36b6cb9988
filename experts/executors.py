"""Executors run tasks: in this process, in a pool of processes here, or on a cluster (`RayExecutor`)."""

import selectors
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from typing import Any, Protocol, TypeVar

from dq_space_arm_env.common.host_machine import processors
from dq_space_arm_env.common.worker_process import WorkerLostError, WorkerProcess, is_worker

MOST_LOSSES = 3
"""Times that a task is repeated after its process was killed."""

Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)


class ExecutorError(RuntimeError):
    """Tasks cannot be run here; the message says why, and what to do."""


class Task(Protocol[Result_co]):
    """Work for some process of some machine, which is sent there pickled."""

    @property
    def label(self) -> str:
        """Its name in messages, such as "shard 3"."""

    def prepare(self) -> None:
        """Compile what it needs; called in one process before many begin."""

    def run(self) -> Result_co:
        """Do the work; an error ends the whole run."""

    def lost(self, sentence: str) -> Result_co:
        """Give a result after its processes have been killed again and again, or raise an error."""

    @staticmethod
    def software() -> dict[str, Any]:
        """Versions, JSON values, that all machines have to have in common."""


class Executor(Protocol):
    """Runs tasks in any order and place; the results depend on neither."""

    def run(self, tasks: Iterable[Task[Result]]) -> Generator[Result]:
        """Run tasks.

        Args:
            tasks: What to do, taken one by one, a limited number ahead of the results: there may be many.

        Yields:
            Their results as they are finished, until the generator is closed.

        Raises:
            ExecutorError: If nothing can be run.
        """
        ...


class SerialExecutor:
    """Runs tasks in this process, one after another."""

    def run(self, tasks: Iterable[Task[Result]]) -> Generator[Result]:
        """Run tasks."""
        for task in tasks:
            yield task.run()


class ProcessExecutor:
    """Runs tasks in processes of this machine, one thread each, and replaces those that are killed."""

    def __init__(self, workers: int) -> None:
        """Set the number of processes.

        Args:
            workers: Number of processes.

        Raises:
            ValueError: If there are none, or it is no whole number.
        """
        if isinstance(workers, bool) or not hasattr(workers, "__index__"):
            raise ValueError(f"workers: {workers!r}, should be a whole number of at least 1")
        if workers < 1:
            raise ValueError(f"workers: {workers}, should be at least 1")
        self.workers = workers

    def run(self, tasks: Iterable[Task[Result]]) -> Generator[Result]:
        """Run tasks."""
        remaining = iter(tasks)
        first = list(islice(remaining, self.workers))
        for task in first:
            task.prepare()
        with selectors.DefaultSelector() as selector:
            try:
                for task in first:
                    _employ(selector, task)
                yield from self._answers(selector, remaining)
            finally:
                for key in list(selector.get_map().values()):
                    _dismiss(selector, key.fileobj)

    def _answers(
        self, selector: selectors.BaseSelector, remaining: Iterator[Task[Result]]
    ) -> Generator[Result]:
        """Collect results and assign the next tasks."""
        while selector.get_map():
            for key, _ in selector.select():
                worker, (task, losses) = key.fileobj, key.data
                assert isinstance(worker, WorkerProcess)
                try:
                    result = worker.answer()
                except WorkerLostError:
                    _dismiss(selector, worker)
                    if losses < MOST_LOSSES:
                        _employ(selector, task, losses + 1)
                        continue
                    yield task.lost(
                        f"{losses + 1} processes in a row ended without finishing {task.label}, perhaps out "
                        f"of memory: use fewer than {self.workers} workers"
                    )
                    following = next(remaining, None)
                    if following is not None:
                        _employ(selector, following)
                else:
                    yield result
                    following = next(remaining, None)  # which may depend on that result
                    if following is None:
                        _dismiss(selector, worker)
                    else:
                        _assign(worker, following)
                        selector.modify(worker, selectors.EVENT_READ, (following, 0))


def _employ(selector: selectors.BaseSelector, task: Task[Any], losses: int = 0) -> None:
    worker = WorkerProcess()
    _assign(worker, task)
    selector.register(worker, selectors.EVENT_READ, (task, losses))


def _assign(worker: WorkerProcess, task: Task[Any]) -> None:
    worker.assign(type(task).run, task)


def _dismiss(selector: selectors.BaseSelector, worker: object) -> None:
    assert isinstance(worker, WorkerProcess)
    selector.unregister(worker)
    worker.close()


def local_executor(workers: int | None = None) -> Executor:
    """Choose processes of this machine, by default one per processor; this process alone for one worker.

    A worker, which is one of several, works alone by default.
    """
    if workers is None:
        workers = 1 if is_worker() else processors()
    return SerialExecutor() if workers == 1 and workers is not True else ProcessExecutor(workers)
