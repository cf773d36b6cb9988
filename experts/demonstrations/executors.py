"""Executors make the shards: this process, a pool of processes of this machine, or anything that runs tasks.

Each worker process has its own pipes, tasks on standard input and shards on standard output: if it is killed
in the middle of an answer, nobody waits for the rest of it, as with a shared queue.
"""

import contextlib
import os
import pickle
import selectors
import subprocess
import sys
import threading
import traceback
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from time import sleep
from typing import Protocol

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
                    selector.register(Worker(task), selectors.EVENT_READ)
                yield from self._answers(selector, remaining)
            finally:
                for key in list(selector.get_map().values()):
                    _dismiss(selector, key.fileobj)

    def _answers(self, selector: selectors.BaseSelector, remaining: Iterator[Task]) -> Generator[ShardResult]:
        """Collect finished shards and assign the next tasks."""
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
                            f"{losses} processes in a row ended without finishing a shard, perhaps out of "
                            f"memory: use fewer than {self.workers} workers"
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
    assert isinstance(worker, Worker)
    selector.unregister(worker)
    worker.end()


def local_executor(workers: int | None = None) -> Executor:
    """Choose processes of this machine, by default one per processor; this process alone for one worker."""
    if workers is None:
        affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
        workers = len(affinity(0)) if affinity else os.cpu_count() or 1
    return SerialExecutor() if workers == 1 else ProcessExecutor(workers)


# Ctrl-C is left to the parent. The package is imported from where the parent imported it.
_BEGIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); sys.path[:] = sys.argv[2:]; "
    "from experts.demonstrations.executors import serve; serve(int(sys.argv[1]))"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkerLost(Exception):  # noqa: N818 - an event, not a mistake
    """A worker ended before its answer."""


class Worker:
    """A worker process, seen from its parent; `task` is its current task."""

    def __init__(self, task: Task) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _BEGIN, str(os.getpid()), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        self.assign(task)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the worker answers or ends."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def assign(self, task: Task) -> None:
        """Send a task."""
        assert self._process.stdin is not None
        self.task = task
        with contextlib.suppress(BrokenPipeError):  # noticed where the answer is read
            pickle.dump(task, self._process.stdin)
            self._process.stdin.flush()

    def answer(self) -> ShardResult:
        """Wait for the shard; raise what making it has raised, or `WorkerLost`."""
        assert self._process.stdout is not None
        try:
            answer = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as error:
            raise WorkerLost from error
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, ShardResult)
        return answer

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                if pipe is not None:
                    pipe.close()
        self._process.wait()


def serve(parent: int) -> None:
    """Work for a parent until it closes standard input or exits."""

    def watch() -> None:
        while os.getppid() == parent:
            sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    tasks = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # prints must not mix with answers
    with answers:
        while True:
            try:
                task = pickle.load(tasks)
            except EOFError:
                return
            answer: ShardResult | Exception
            try:
                answer = make_shard(task)
            except Exception as error:
                error.add_note("".join(traceback.format_exception(error)))
                answer = error
            pickle.dump(answer, answers)
            answers.flush()
            del answer  # frees its memory before the next one
