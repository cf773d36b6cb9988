"""Another process compiles kernels: it hands them over by the cache, and nothing depends on it."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import Kernels, Scene
from dq_space_arm_env.common import worker_process
from dq_space_arm_env.common.code_cache import cache_directory
from dq_space_arm_env.compiler import build
from dq_space_arm_env.kernels import parallel_compilation
from dq_space_arm_env.kernels.parallel_compilation import Request, compiling_aside

REQUESTS = [Request(name, lanes=1) for name in ("energy", "tip_pose", "momentum", "difference", "retract")]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(parallel_compilation, "processors", lambda: 2)
    return tmp_path / "cache"


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[worker_process.WorkerProcess]]:
    """The processes that were begun; none may be left at the end."""
    begun: list[worker_process.WorkerProcess] = []

    class Noted(worker_process.WorkerProcess):
        def __init__(self, *, quiet: bool = False) -> None:
            super().__init__(quiet=quiet)
            begun.append(self)

    monkeypatch.setattr(parallel_compilation, "WorkerProcess", Noted)
    yield begun
    assert all(worker._process.poll() is not None for worker in begun)


def energy(kernels: Kernels) -> float:
    layout = kernels.layout
    return float(np.asarray(kernels.energy(layout.initial_state)).flat[0])


@pytest.mark.slow
def test_what_another_process_has_compiled_is_loaded(
    cache: Path, short_scene: Scene, workers: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("compiled here")

    monkeypatch.setattr(build, "build_program", refuse)
    kernels, deadline = Kernels(short_scene), time.monotonic() + 120.0
    with compiling_aside(kernels, REQUESTS):
        while len(list(cache.glob("scene.*.kernel"))) < len(REQUESTS) and time.monotonic() < deadline:
            time.sleep(0.05)
    assert all(kernels.is_ready(**request._asdict()) for request in REQUESTS)
    assert energy(kernels) >= 0.0
    assert len(workers) == 1
    with compiling_aside(Kernels(short_scene), REQUESTS):  # nothing is missing
        pass
    assert len(workers) == 1


@pytest.mark.slow
def test_what_is_to_come_before_is_called_there(
    cache: Path, short_scene: Scene, workers: list[object]
) -> None:
    with compiling_aside(Kernels(short_scene), REQUESTS, leave_a_mark):
        pass
    assert (cache / "mark").read_text() != str(os.getpid())
    assert all(Kernels(short_scene).is_ready(**request._asdict()) for request in REQUESTS)
    (cache / "mark").unlink()
    with compiling_aside(Kernels(short_scene), REQUESTS, leave_a_mark):  # nothing is missing
        pass
    assert not (cache / "mark").exists()


def leave_a_mark() -> None:
    (cache_directory() / "mark").write_text(str(os.getpid()))


@pytest.mark.parametrize("end", ["os._exit(1)", "sys.stdin.buffer.read(1); os._exit(1)"])
def test_without_the_other_process_kernels_are_compiled_here(
    end: str,
    cache: Path,
    short_scene: Scene,
    workers: list[object],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(worker_process, "BEGIN", f"import os, sys; {end}")
    kernels = Kernels(short_scene)
    with compiling_aside(kernels, REQUESTS):
        pass
    assert len(workers) == 1
    assert energy(kernels) >= 0.0


@pytest.mark.parametrize("reason", ["one processor", "worker", "no cache", "few kernels", "no process"])
def test_there_is_no_other_process_where_it_would_not_help(
    reason: str, cache: Path, short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[bool] = []

    def refuse(*, quiet: bool) -> None:
        begun.append(quiet)
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(parallel_compilation, "WorkerProcess", refuse)
    if reason == "one processor":
        monkeypatch.setattr(parallel_compilation, "processors", lambda: 1)
    elif reason == "worker":
        monkeypatch.setattr(parallel_compilation, "is_worker", lambda: True)
    elif reason == "no cache":
        cache.touch()
    with compiling_aside(Kernels(short_scene), REQUESTS[: 3 if reason == "few kernels" else None]):
        pass
    assert begun == ([True] if reason == "no process" else [])


def test_an_interrupt_ends_the_other_process(cache: Path, short_scene: Scene, workers: list[object]) -> None:
    with pytest.raises(KeyboardInterrupt), compiling_aside(Kernels(short_scene), REQUESTS):
        raise KeyboardInterrupt
    assert len(workers) == 1  # and the fixture sees that it has ended
