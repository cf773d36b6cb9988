"""Processes give what this process gives, and survive the loss of some."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from demonstration_files import contents

from dq_space_arm_env import Scene
from dq_space_arm_env.common import worker_process
from experts import generate_demonstrations
from experts.demonstrations import Demonstrations, DemonstrationsError, ProcessExecutor
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import Task

pytestmark = pytest.mark.slow


def children() -> list[int]:
    """Workers that this process has started."""
    found = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return [int(pid) for pid in found if b"worker_process" in Path(f"/proc/{pid}/cmdline").read_bytes()]


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux")


@needs_proc
def test_killed_workers_are_replaced_and_the_bytes_are_the_same(
    whole: Demonstrations, quick_scene: Scene, tmp_path: Path
):
    killed = []

    def kill(advance) -> None:
        if advance.done and len(killed) < 2:
            killed.append(children()[0])
            os.kill(killed[-1], signal.SIGKILL)

    made = generate_demonstrations(
        quick_scene, 18, tmp_path, 3, shard_size=4, executor=ProcessExecutor(2), progress=kill
    )
    assert made is not None
    assert len(killed) == 2
    assert contents(tmp_path) == contents(whole.path)
    assert not children()


def test_workers_that_end_again_and_again_end_the_run_with_a_sentence(
    quick_scene: Scene, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(worker_process, "BEGIN", "import os, sys; sys.stdin.buffer.read(1); os._exit(1)")
    settings = Settings.of(quick_scene, 18, 3, 4)
    tasks = [Task(settings, shard) for shard in range(5)]
    with pytest.raises(DemonstrationsError, match=r"4 processes in a row ended .* use fewer than 2"):
        list(ProcessExecutor(2).run(tasks))


def test_errors_of_workers_are_raised_here(quick_scene: Scene):
    settings = Settings.of(quick_scene, 18, 3, 4)
    with pytest.raises(ValueError, match="num_envs: 0") as caught:
        list(ProcessExecutor(1).run([Task(settings, 99)]))
    assert any("make_shard" in note for note in caught.value.__notes__)


def test_tasks_are_taken_few_at_a_time(quick_scene: Scene):
    """So that neither tasks nor results pile up, however many there are."""
    settings, taken = Settings.of(quick_scene, 40, 3, 2), []

    def tasks() -> Iterator[Task]:
        for shard in range(settings.n_shards):
            taken.append(shard)
            yield Task(settings, shard)

    results = ProcessExecutor(2).run(tasks())
    for seen, _ in enumerate(results, start=1):
        assert len(taken) <= seen + 2
        if seen == 5:
            break
    results.close()
    assert len(taken) <= 7


def test_the_next_task_may_depend_on_the_last_result(quick_scene: Scene):
    settings, events = Settings.of(quick_scene, 3, 3, 1), []

    def tasks() -> Iterator[Task]:
        for shard in range(settings.n_shards):
            events.append("asked")
            yield Task(settings, shard)

    for _ in ProcessExecutor(1).run(tasks()):
        events.append("told")
    assert events == ["asked", "told"] * 3
