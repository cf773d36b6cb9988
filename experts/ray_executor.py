"""Tasks run by the machines of a Ray cluster, whose results are sent back.

If a process or machine is lost, its tasks are given to Ray again, including those whose results were not
fetched yet. Every machine needs the same version of this package and its
dependencies, and reports a difference. Processors with different instruction sets agree only up to rounding.

The process that runs the executor should be on a machine of the cluster. If that machine or the head of the
cluster is lost, the run ends and is resumed like any other.
"""

import os
import pickle
import platform
import re
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from time import monotonic, sleep
from typing import Any, NamedTuple

from dq_space_arm_env.common.code_cache import cache_directory
from dq_space_arm_env.common.files import differences
from dq_space_arm_env.common.locks import locked
from dq_space_arm_env.common.worker_process import become_worker
from experts.executors import ExecutorError, Result, Task

AHEAD = 2
"""Tasks queued per processor of the cluster, so that none waits for this process, and an autoscaling cluster
sees the demand."""
WAITING = 2
"""Additional tasks, queued even while the cluster has no processor yet."""
MOST_LOSSES = 10
"""Times that a task is repeated after its process or machine was lost."""
LONGEST_PAUSE = 10.0
"""Time before the last repetitions, s; the first follow sooner. A cluster takes seconds to notice that a
machine is gone, and gives it tasks until then."""
CONNECTION_SECONDS = 10.0
"""Time after which a cluster counts as unreachable, and cancelled tasks are left to it."""


class _UnderWay(NamedTuple):
    """A task that Ray has, and how often it was lost."""

    task: Task[Any]
    losses: int


Answer = tuple[Any, str | None]
"""Of a machine: a result, and why there is none."""
RemoteTask = Callable[[dict[str, Any], bytes, bytes], Answer]


class RayExecutor:
    """Runs tasks on a Ray cluster, one process per processor."""

    def __init__(self, address: str | None = None) -> None:
        """Choose the cluster.

        Args:
            address: As for `ray.init`: "host:port" of the cluster's head, "auto" for the cluster of this
                machine, "local" for a new one on this machine alone, which ends with the run. By default that
                of RAY_ADDRESS, else the cluster of this machine, else a new one. An existing connection of
                this process takes precedence and is kept.
        """
        self.address = address

    def run(self, tasks: Iterable[Task[Result]]) -> Generator[Result]:
        """Run tasks."""
        try:
            import ray
        except ModuleNotFoundError as error:
            raise ExecutorError(
                "a cluster needs Ray: pip install 'dq-space-arm[ray]' on all of its machines"
            ) from error
        with _connected(ray, self.address):
            yield from _run_on(ray, tasks)


@contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    """Connect to a cluster inside a `with` block, and restore the process afterwards."""
    if ray.is_initialized():
        yield
        return
    asked = address or os.environ.get("RAY_ADDRESS")
    with _quiet(ray), _same_signals():
        try:
            _check_reachable(asked)
            ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except (OSError, RuntimeError, ValueError) as error:
            where = asked or "the default address"
            raise ExecutorError(f"no Ray cluster can be used at {where}: {error}") from error
        try:
            yield
        finally:
            ray.shutdown()


def _check_reachable(address: str | None) -> None:
    """Try host and port first: Ray itself keeps trying for minutes."""
    match = re.fullmatch(r"([\w.-]+):(\d+)", address or "")
    if match:
        socket.create_connection((match[1], int(match[2])), CONNECTION_SECONDS).close()


@contextmanager
def _quiet(ray: Any) -> Iterator[None]:
    """Suppress Ray's messages about each task of a lost machine.

    There is no public switch for them; Ray's debugger uses this one.
    """
    worker = ray._private.worker
    worker._worker_logs_enabled = False
    try:
        yield
    finally:
        worker._worker_logs_enabled = True


@contextmanager
def _same_signals() -> Iterator[None]:
    """Restore the handler of SIGTERM, which Ray replaces for good."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _run_on(ray: Any, tasks: Iterable[Task[Result]]) -> Generator[Result]:
    """Run tasks on the connected cluster."""
    under_way: dict[Any, _UnderWay] = {}  # by the references to their results
    remaining = iter(tasks)
    # Ray's own repetitions are not counted where they can be seen.
    remote = ray.remote(num_cpus=1, max_retries=0)(remote_task())

    def begin(task: Task[Result], losses: int = 0) -> None:
        software = type(task).software
        reference = remote.remote(software(), pickle.dumps(software), pickle.dumps(task))
        under_way[reference] = _UnderWay(task, losses)

    try:
        while True:
            most = AHEAD * int(ray.cluster_resources().get("CPU", 0.0)) + WAITING
            for task in islice(remaining, max(most - len(under_way), 0)):
                begin(task)
            if not under_way:
                return
            (ready, *_), _ = ray.wait(list(under_way))
            task, losses = under_way.pop(ready)
            try:
                result = _fetch(ray, ready)
            except _TaskLost as loss:
                losses += 1
                if losses <= MOST_LOSSES:
                    sleep(min(0.1 * 2.0**losses, LONGEST_PAUSE))
                    begin(task, losses)
                    continue
                result = task.lost(
                    f"{task.label} was lost {losses} times with the process or the machine that ran it: "
                    f"{loss}"
                )
            del ready  # frees the cluster's copy
            yield result
    finally:
        _cancel(ray, list(under_way))


def _cancel(ray: Any, references: list[Any]) -> None:
    """End tasks. Ray can lose the order for one that is just starting, which would then go on for minutes."""
    last = monotonic() + CONNECTION_SECONDS
    with suppress(ray.exceptions.RayError):  # of a cluster that is lost
        while references and monotonic() < last:
            for reference in references:
                ray.cancel(reference, force=True)
            _, references = ray.wait(references, num_returns=len(references), timeout=0.5, fetch_local=False)


class _TaskLost(Exception):  # noqa: N818 - an event, not a mistake
    """The process or machine that ran a task, or held its result, is gone."""


def _fetch(ray: Any, reference: Any) -> Any:
    failures = ray.exceptions
    try:
        result, refusal = ray.get(reference)
    except failures.RayTaskError:
        raise  # a bug, with its remote traceback
    except (
        failures.WorkerCrashedError,
        failures.NodeDiedError,
        failures.ObjectLostError,
        failures.OutOfMemoryError,
    ) as error:
        raise _TaskLost(str(error).partition("\n")[0]) from error
    except failures.RayError as error:
        reason = str(error).partition("\n")[0]
        raise ExecutorError(f"the Ray cluster cannot go on: {reason}") from error
    if refusal is not None:
        raise ExecutorError(refusal)
    return result


def remote_task() -> RemoteTask:
    """Return the function that machines of the cluster run.

    Being local, it is pickled with its code, so that it runs, and can complain, where this package is missing
    or has another version.
    """

    def run(expected: dict[str, Any], software: bytes, packed: bytes) -> Answer:
        # NumPy reads these when it is imported.
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
        try:
            from experts import ray_executor

            known = pickle.loads(software)
        except (ImportError, AttributeError) as error:
            return None, (
                f"machine {platform.node()} of the cluster cannot load this version of dq-space-arm "
                f"({error}): install the same version on all machines"
            )
        return ray_executor.run_here(expected, known(), packed)

    return run


def run_here(expected: dict[str, Any], software: dict[str, Any], packed: bytes) -> Answer:
    """Run a task on this machine if it has the expected software, else say what differs."""
    differing = differences(software, expected)
    if differing:
        return None, (
            f"machine {platform.node()} of the cluster has other software: {'; '.join(differing)}. Install "
            "the same on all machines"
        )
    become_worker()
    task: Task[Any] = pickle.loads(packed)
    with _first_alone():
        task.prepare()
    return task.run(), None


@contextmanager
def _first_alone() -> Iterator[None]:
    """Let the first process work alone; those that wait for it then continue together."""
    lock = cache_directory() / "compiling.lock"
    with ExitStack() as held:
        # All compile where the folder cannot be locked, as on some network disks.
        with suppress(OSError):
            lock.parent.mkdir(parents=True, exist_ok=True)
            try:
                held.enter_context(locked(lock, BlockingIOError()))
            except BlockingIOError:
                with locked(lock, BlockingIOError(), seconds=-1.0):
                    pass
        yield
