"""Who makes the shards: this process, some processes of this machine, or whatever else runs tasks."""

import os
import selectors
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from typing import Protocol

from experts.demonstrations.errors import DemonstrationsError
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.shard import ShardResult, Task, make_shard
from experts.demonstrations.worker import Worker, WorkerLost

MOST_LOSSES = 3
"""Processes that may be killed without a shard in between."""


class Executor(Protocol):
    """Runs tasks, in any order and at any place; what they give depends on neither."""

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards.

        Args:
            tasks: What to make. To be taken one by one, a limited number ahead of the results: there may be
                very many.

        Yields:
            The shards, as they get ready. Whoever closes the generator wants no more of them.

        Raises:
            DemonstrationsError: If there is no way to go on.
        """
        ...


class SerialExecutor:
    """This process, one task after another."""

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards.

        Args:
            tasks: What to make.

        Yields:
            The shards in the order of the tasks.
        """
        for task in tasks:
            yield make_shard(task)


class ProcessExecutor:
    """Processes of this machine, one thread each; those that are killed are replaced."""

    def __init__(self, workers: int) -> None:
        """Choose their number.

        Args:
            workers: Number of processes.

        Raises:
            ValueError: If there are none.
        """
        if workers < 1:
            raise ValueError(f"workers: {workers}, should be at least 1")
        self.workers = workers

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards.

        Args:
            tasks: What to make; at most one for each process is taken ahead of the results.

        Yields:
            The shards, as they get ready.

        Raises:
            DemonstrationsError: If processes are killed again and again.
        """
        remaining = iter(tasks)
        first = list(islice(remaining, self.workers))
        if first:
            # Compiles for all of them; what else it makes is not needed here.
            expert_of(first[0].settings.scene)
            expert_of.cache_clear()
        with selectors.DefaultSelector() as selector:
            try:
                for task in first:
                    selector.register(Worker(task), selectors.EVENT_READ)
                yield from self._answers(selector, remaining)
            finally:
                for key in list(selector.get_map().values()):
                    _dismiss(selector, key.fileobj)

    def _answers(self, selector: selectors.BaseSelector, remaining: Iterator[Task]) -> Generator[ShardResult]:
        """Collect what workers make, and give them more to do."""
        losses = 0
        while selector.get_map():
            for key, _ in selector.select():
                worker = key.fileobj
                assert isinstance(worker, Worker)
                try:
                    result = worker.answer()
                except WorkerLost as error:
                    losses += 1
                    _dismiss(selector, worker)
                    if losses > MOST_LOSSES:
                        raise DemonstrationsError(
                            f"{losses} processes have ended one after the other without a shard in between, "
                            f"perhaps for want of memory: take fewer than {self.workers}"
                        ) from error
                    selector.register(Worker(worker.task), selectors.EVENT_READ)
                    continue
                losses = 0
                following = next(remaining, None)
                if following is None:
                    _dismiss(selector, worker)
                else:
                    worker.assign(following)
                yield result


def _dismiss(selector: selectors.BaseSelector, worker: object) -> None:
    """End a worker."""
    assert isinstance(worker, Worker)
    selector.unregister(worker)
    worker.end()


def local_executor(workers: int | None = None) -> Executor:
    """Choose processes of this machine, or this one alone where one is enough.

    Args:
        workers: Number of processes; None for one for each processor.

    Returns:
        The executor.

    Raises:
        ValueError: If there are none.
    """
    if workers is None:
        affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
        workers = len(affinity(0)) if affinity else os.cpu_count() or 1
    return SerialExecutor() if workers == 1 else ProcessExecutor(workers)
