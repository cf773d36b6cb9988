"""Shards made by the machines of a Ray cluster, and brought back as bytes: they need not share a disk.

Ray runs the tasks again that were under way on a machine or in a process that is lost, and those whose shards
were made there and not yet fetched; they end with the same bytes. Every machine needs the same version of
this package and of those that it rests on, and says so if it has another one. Which kind of processor a
machine has is up to the cluster: kinds of different instruction sets agree up to rounding only.

The run itself, which writes the files, should be on a machine of the cluster. If that one is lost, or the
one where the cluster was started, the run ends, and is resumed as any other.
"""

import os
import pickle
import platform
import re
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import islice
from typing import Any

from dq_space_arm_env import Scene
from dq_space_arm_env.compiler.native import cache_directory
from experts.demonstrations.errors import DemonstrationsError
from experts.demonstrations.outcomes import expert_of
from experts.demonstrations.settings import differences, software
from experts.demonstrations.shard import ShardResult, Task, make_shard

AHEAD = 2
"""Tasks given to the cluster for each of its processors: so none of them waits for this process, and a
cluster that grows on demand sees the demand."""
WAITING = 2
"""Tasks beyond those, which a cluster without any processor yet is given too."""
MOST_LOSSES = 10
"""Times that a shard is made again after its process or its machine was lost."""
CONNECTION_SECONDS = 10.0
"""Time after which a cluster counts as out of reach."""

RemoteTask = Callable[[dict[str, Any], bytes], ShardResult | str]


class RayExecutor:
    """The machines of a Ray cluster, one process for each of their processors."""

    def __init__(self, address: str | None = None) -> None:
        """Choose the cluster.

        Args:
            address: As `ray.init` takes it: "host:port" of the cluster's head, "auto" for the cluster that
                this machine is part of, "local" for a new one of this machine alone, which ends with the
                run. By default the one that RAY_ADDRESS names, else the one that this machine is part of,
                else a new one. A connection that this process has already is used in any case, and kept.
        """
        self.address = address

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        """Make shards.

        Args:
            tasks: What to make.

        Yields:
            The shards, as they arrive.

        Raises:
            DemonstrationsError: If Ray is not installed; if the cluster cannot be reached; if a machine has
                other software; if one shard is lost again and again.
        """
        try:
            import ray
        except ModuleNotFoundError as error:
            raise DemonstrationsError(
                "a cluster needs Ray: pip install 'dq-space-arm[ray]', on all of its machines"
            ) from error
        with _connected(ray, self.address):
            yield from _run_on(ray, tasks)


@contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    """Be connected to a cluster inside a `with` block, and leave the process as it was."""
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
    """Try a connection where a host and a port are given: Ray itself tries for minutes."""
    match = re.fullmatch(r"([\w.-]+):(\d+)", address or "")
    if match:
        socket.create_connection((match[1], int(match[2])), CONNECTION_SECONDS).close()


@contextmanager
def _quiet(ray: Any) -> Iterator[None]:
    """Keep messages off the terminal that Ray prints for each task of a lost machine.

    There is no public switch for them; this one is what Ray's debugger uses.
    """
    worker = ray._private.worker
    worker._worker_logs_enabled = False
    try:
        yield
    finally:
        worker._worker_logs_enabled = True


@contextmanager
def _same_signals() -> Iterator[None]:
    """Restore what SIGTERM does, which Ray changes for good."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _run_on(ray: Any, tasks: Iterable[Task]) -> Generator[ShardResult]:
    """Run tasks on the cluster that this process is connected to."""
    under_way: list[Any] = []
    here, remaining = software(), iter(tasks)
    make = ray.remote(num_cpus=1, max_retries=MOST_LOSSES)(remote_task())
    try:
        while True:
            most = AHEAD * int(ray.cluster_resources().get("CPU", 0.0)) + WAITING
            for task in islice(remaining, max(most - len(under_way), 0)):
                under_way.append(make.remote(here, pickle.dumps(task)))
            if not under_way:
                return
            (ready,), under_way = ray.wait(under_way)
            result = _fetch(ray, ready)
            del ready  # and the cluster's copy with it
            yield result
    finally:
        for reference in under_way:
            ray.cancel(reference, force=True)


def _fetch(ray: Any, reference: Any) -> ShardResult:
    """Take a result from the cluster."""
    failures = ray.exceptions
    try:
        result: ShardResult | str = ray.get(reference)
    except failures.RayTaskError:
        raise  # a mistake in the code, with the traceback of where it happened
    except failures.RayError as error:
        reason = str(error).partition("\n")[0]
        raise DemonstrationsError(
            f"a shard was lost {MOST_LOSSES + 1} times with the process or the machine that made it: {reason}"
        ) from error
    if isinstance(result, str):
        raise DemonstrationsError(result)
    return result


def remote_task() -> RemoteTask:
    """Get what runs on the machines of a cluster.

    Returns:
        A function of the software of the machine that asks, see `software`, and a pickled task. It gives the
        shard, or a sentence why this machine cannot make it. Being local, it is pickled with its code, so
        that it runs, and can complain, where this package is missing or another version is installed.
    """

    def make(expected: dict[str, Any], packed: bytes) -> ShardResult | str:
        # Before NumPy is loaded, which looks at it only then.
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
        try:
            from experts.demonstrations import ray_executor
        except ImportError as error:
            return (
                f"machine {platform.node()} of the cluster cannot load this version of dq-space-arm "
                f"({error}): install the same one on all machines"
            )
        return ray_executor.make_here(expected, packed)

    return make


def make_here(expected: dict[str, Any], packed: bytes) -> ShardResult | str:
    """Make a shard on this machine, if it has the software for that.

    Args:
        expected: Software of the machine that asks.
        packed: Pickled task; it is opened only if the software is the same.

    Returns:
        The shard, or a sentence why there is none.
    """
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

    One process of a fresh machine compiles, and the others wait and load what it has compiled: dozens of
    compilers at once take more memory than dozens of solvers.
    """
    with _first_alone():
        expert_of(scene)


@contextmanager
def _first_alone() -> Iterator[None]:
    """Let the first process that enters do its work alone; those that come meanwhile follow all at once."""
    import fcntl  # not on Windows

    descriptor = None
    # Without a folder that can be locked, as on some network disks, all of them compile.
    with suppress(OSError):
        cache_directory().mkdir(parents=True, exist_ok=True)
        descriptor = os.open(cache_directory(), os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            fcntl.flock(descriptor, fcntl.LOCK_UN)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)
