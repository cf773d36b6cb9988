"""Shards made by the machines of a Ray cluster, and returned as bytes: no shared disk is needed.

If a process or machine is lost, its tasks are given to Ray again, including those whose shards were not
fetched yet; the bytes are the same. Every machine needs the same version of this package and its
dependencies, and reports a difference. Processors with different instruction sets agree only up to rounding.

The run itself, which writes the files, should be on a machine of the cluster. If that machine or the head of
the cluster is lost, the run ends and is resumed like any other.
"""

import os
import pickle
import platform
import re
import signal
import socket
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from itertools import islice
from time import monotonic, sleep
from typing import Any

from dq_space_arm_env import Scene
from dq_space_arm_env.common.code_cache import cache_directory
from dq_space_arm_env.common.locks import locked
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.settings import differences, software
from experts.demonstrations.shard import ShardResult, Task, make_shard
from experts.demonstrations.tensors import DemonstrationsError

AHEAD = 2
"""Tasks queued per processor of the cluster, so that none waits for this process, and an autoscaling cluster
sees the demand."""
WAITING = 2
"""Additional tasks, queued even while the cluster has no processor yet."""
MOST_LOSSES = 10
"""Times that a shard is repeated after its process or machine was lost."""
LONGEST_PAUSE = 10.0
"""Time before the last repetitions, s; the first follow sooner. A cluster takes seconds to notice that a
machine is gone, and gives it tasks until then."""
CONNECTION_SECONDS = 10.0
"""Time after which a cluster counts as unreachable, and cancelled tasks are left to it."""

RemoteTask = Callable[[dict[str, Any], bytes], ShardResult | str]


class RayExecutor:
    """Makes shards on a Ray cluster, one process per processor."""

    def __init__(self, address: str | None = None) -> None:
        """Choose the cluster.

        Args:
            address: As for `ray.init`: "host:port" of the cluster's head, "auto" for the cluster of this
                machine, "local" for a new one on this machine alone, which ends with the run. By default that
                of RAY_ADDRESS, else the cluster of this machine, else a new one. An existing connection of
                this process takes precedence and is kept.
        """
        self.address = address

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards."""
        try:
            import ray
        except ModuleNotFoundError as error:
            raise DemonstrationsError(
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
            raise DemonstrationsError(f"no Ray cluster can be used at {where}: {error}") from error
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


def _run_on(ray: Any, tasks: Iterable[Task]) -> Generator[ShardResult]:
    """Run tasks on the connected cluster."""
    under_way: dict[Any, Task] = {}  # tasks by the references to their shards
    losses: Counter[int] = Counter()  # by shard
    here, remaining = software(), iter(tasks)
    # Ray's own repetitions are not counted where they can be seen.
    make = ray.remote(num_cpus=1, max_retries=0)(remote_task())
    try:
        while True:
            most = AHEAD * int(ray.cluster_resources().get("CPU", 0.0)) + WAITING
            for task in islice(remaining, max(most - len(under_way), 0)):
                under_way[make.remote(here, pickle.dumps(task))] = task
            if not under_way:
                return
            (ready, *_), _ = ray.wait(list(under_way))
            task = under_way.pop(ready)
            try:
                result = _fetch(ray, ready)
            except _ShardLost as loss:
                losses[task.shard] += 1
                if losses[task.shard] > MOST_LOSSES:
                    raise DemonstrationsError(
                        f"shard {task.shard} was lost {losses[task.shard]} times with the process or the "
                        f"machine that made it: {loss}"
                    ) from loss
                sleep(min(0.1 * 2.0 ** losses[task.shard], LONGEST_PAUSE))
                under_way[make.remote(here, pickle.dumps(task))] = task
                continue
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


class _ShardLost(Exception):  # noqa: N818 - an event, not a mistake
    """The process or machine that made a shard, or held it, is gone."""


def _fetch(ray: Any, reference: Any) -> ShardResult:
    failures = ray.exceptions
    try:
        result: ShardResult | str = ray.get(reference)
    except failures.RayTaskError:
        raise  # a bug, with its remote traceback
    except (
        failures.WorkerCrashedError,
        failures.NodeDiedError,
        failures.ObjectLostError,
        failures.OutOfMemoryError,
    ) as error:
        raise _ShardLost(str(error).partition("\n")[0]) from error
    except failures.RayError as error:
        reason = str(error).partition("\n")[0]
        raise DemonstrationsError(f"the Ray cluster cannot go on: {reason}") from error
    if isinstance(result, str):
        raise DemonstrationsError(result)
    return result


def remote_task() -> RemoteTask:
    """Return the function that machines of the cluster run.

    Being local, it is pickled with its code, so that it runs, and can complain, where this package is missing
    or has another version.
    """

    def make(expected: dict[str, Any], packed: bytes) -> ShardResult | str:
        # NumPy reads these when it is imported.
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
        try:
            from experts.demonstrations import ray_executor
        except ImportError as error:
            return (
                f"machine {platform.node()} of the cluster cannot load this version of dq-space-arm "
                f"({error}): install the same version on all machines"
            )
        return ray_executor.make_here(expected, packed)

    return make


def make_here(expected: dict[str, Any], packed: bytes) -> ShardResult | str:
    """Make a shard on this machine if it has the same software, else say what differs."""
    differing = differences(software(), expected)
    if differing:
        return (
            f"machine {platform.node()} of the cluster has other software: {'; '.join(differing)}. Install "
            "the same on all machines"
        )
    task: Task = pickle.loads(packed)
    _prepare(task.settings.scene)
    return make_shard(task)


@lru_cache(maxsize=1)
def _prepare(scene: Scene) -> None:
    """Compile or load the expert of this process.

    One process of a fresh machine compiles while the others wait for the cache: dozens of compilers at once
    take more memory than dozens of solvers.
    """
    with _first_alone():
        expert_of(scene)


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
