"""Executors make the shards: this process, a pool of processes here, or anything that runs tasks."""

import os
import selectors
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from typing import Protocol

from dq_space_arm_env.common.worker_process import WorkerLostError, WorkerProcess
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.shard import ShardResult, Task, make_shard
from experts.demonstrations.tensors import DemonstrationsError

MOST_LOSSES = 3
"""Processes that may be killed in a row without a shard in between."""


class Executor(Protocol):
    """Runs tasks in any order and place; the results depend on neither."""

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards.

        Args:
            tasks: What to make, taken one by one, a limited number ahead of the results: there may be many.

        Yields:
            The shards as they are finished, until the generator is closed.

        Raises:
            DemonstrationsError: If the run cannot continue.
        """
        ...


class SerialExecutor:
    """Makes shards in this process, one after another."""

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards."""
        for task in tasks:
            yield make_shard(task)


class ProcessExecutor:
    """Makes shards in processes of this machine, one thread each, and replaces those that are killed."""

    def __init__(self, workers: int) -> None:
        """Set the number of processes.

        Args:
            workers: Number of processes.

        Raises:
            ValueError: If there are none.
        """
        if workers < 1:
            raise ValueError(f"workers: {workers}, should be at least 1")
        self.workers = workers

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards."""
        remaining = iter(tasks)
        first = list(islice(remaining, self.workers))
        if first:
            # Compile once for all of them; the expert itself is not needed here.
            expert_of(first[0].settings.scene)
            expert_of.cache_clear()
        with selectors.DefaultSelector() as selector:
            try:
                for task in first:
                    _employ(selector, task)
                yield from self._answers(selector, remaining)
            finally:
                for key in list(selector.get_map().values()):
                    _dismiss(selector, key.fileobj)

    def _answers(self, selector: selectors.BaseSelector, remaining: Iterator[Task]) -> Generator[ShardResult]:
        """Collect finished shards and assign the next tasks."""
        losses = 0
        while selector.get_map():
            for key, _ in selector.select():
                worker, task = key.fileobj, key.data
                assert isinstance(worker, WorkerProcess)
                try:
                    result: ShardResult = worker.answer()
                except WorkerLostError as error:
                    losses += 1
                    _dismiss(selector, worker)
                    if losses > MOST_LOSSES:
                        raise DemonstrationsError(
                            f"{losses} processes in a row ended without finishing a shard, perhaps out of "
                            f"memory: use fewer than {self.workers} workers"
                        ) from error
                    _employ(selector, task)
                    continue
                losses = 0
                following = next(remaining, None)
                if following is None:
                    _dismiss(selector, worker)
                else:
                    worker.assign(make_shard, following)
                    selector.modify(worker, selectors.EVENT_READ, following)
                yield result


def _employ(selector: selectors.BaseSelector, task: Task) -> None:
    worker = WorkerProcess()
    worker.assign(make_shard, task)
    selector.register(worker, selectors.EVENT_READ, task)


def _dismiss(selector: selectors.BaseSelector, worker: object) -> None:
    assert isinstance(worker, WorkerProcess)
    selector.unregister(worker)
    worker.close()


def local_executor(workers: int | None = None) -> Executor:
    """Choose processes of this machine, by default one per processor; this process alone for one worker."""
    if workers is None:
        affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
        workers = len(affinity(0)) if affinity else os.cpu_count() or 1
    return SerialExecutor() if workers == 1 else ProcessExecutor(workers)
