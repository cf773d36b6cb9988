"""Kernels, and other code, that another process compiles while this one has other work.

LLVM compiles in one thread of a process at a time; another process can fill the cache meanwhile. Nothing
depends on it: what it does not leave there is compiled where it is used.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from dq_space_arm_env.common.code_cache import cache_directory
from dq_space_arm_env.common.first_use import announce, compiling
from dq_space_arm_env.common.host_machine import processors
from dq_space_arm_env.common.worker_process import WorkerProcess, is_worker
from dq_space_arm_env.kernels.kernels import Kernels, compile_scene
from dq_space_arm_env.scene.schema import Scene

_FEWEST = 4
"""Kernels to compile for which another process, which takes a second to begin, is worth its while."""


class Request(NamedTuple):
    """A kernel, by the arguments of `KernelLibrary.kernel`."""

    name: str
    integrator: str | None = None
    lanes: int | None = None


@contextmanager
def compiling_aside(
    kernels: Kernels, requests: Sequence[Request], before: Callable[[], None] | None = None
) -> Iterator[None]:
    """Let another process compile the kernels that are missing while a `with` block runs.

    At the end of the block this process takes the last of those that the other has not begun, and waits for
    it to finish. There is no other process where one processor or several processes like this one share the
    work, or where the cache cannot be written.

    Args:
        kernels: Those of the scene.
        requests: The kernels, those that take longest first.
        before: A function of a module that the other process calls first, to fill a cache of its own.
    """
    missing = [request for request in requests if not kernels.is_ready(**request._asdict())]
    if len(missing) < _FEWEST or not _may_start():
        yield
        return
    announce(f"scene {kernels.scene.name!r}")
    try:
        helper = _Helper(kernels, missing, before)
    except OSError:  # no more processes
        yield
        return
    try:
        with compiling(helper.describe):
            yield
            helper.finish()
    finally:
        helper.close()


def _may_start() -> bool:
    """Whether another process can start, would have a processor, and can hand over what it compiles."""
    if is_worker() or processors() == 1 or multiprocessing.parent_process() is not None:
        return False
    if not sys.executable or getattr(sys, "frozen", False):  # a program with Python inside
        return False
    folder = cache_directory()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


class _Helper:
    """The other process, and what is left to do."""

    def __init__(
        self, kernels: Kernels, requests: Sequence[Request], before: Callable[[], None] | None
    ) -> None:
        self._kernels, self._requests = kernels, list(requests)
        self._finished, self._alive, self._changed = 0, True, threading.Condition()
        self._worker = WorkerProcess(quiet=True)
        if before is not None:
            self._worker.assign(before)
        for request in requests:
            self._worker.assign(_compile, kernels.scene, request)
        self._total = self._left = len(requests) + (before is not None)
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        """Count what the process has finished, until it is done, fails or ends."""
        try:
            for _ in range(self._total):
                self._worker.answer()
                with self._changed:
                    self._finished += 1
                    self._changed.notify()
        except Exception:  # whatever it was, it shows again where the code is compiled here
            pass
        finally:
            with self._changed:
                self._alive = False
                self._changed.notify()

    def finish(self) -> None:
        """Compile the last kernels here, and wait for what the process is at."""
        while self._alive and self._finished < self._left:
            if self._requests and self._finished + 1 < self._left:
                self._left -= 1
                self._kernels.kernel(**self._requests.pop()._asdict())
                continue
            with self._changed:
                self._changed.wait_for(lambda: not self._alive or self._finished >= self._left)

    def describe(self) -> str:
        """Say how far the two have come."""
        done = self._finished + self._total - self._left
        return f"scene {self._kernels.scene.name!r} ({done} of {self._total} functions)"

    def close(self) -> None:
        """End the process."""
        self._worker.close()


def _compile(scene: Scene, request: Request) -> None:
    """Compile a kernel, in the other process."""
    compile_scene(scene).kernel(**request._asdict())
