"""Generating demonstrations: what is missing in a folder is made, and then the manifest is written."""

import math
import os
import platform
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from dq_space_arm_env import Scene
from experts.demonstrations.errors import DemonstrationsError
from experts.demonstrations.executors import Executor, local_executor
from experts.demonstrations.folder import Folder, Part
from experts.demonstrations.reading import Demonstrations, load_demonstrations
from experts.demonstrations.settings import SHARD_SIZE, Settings
from experts.demonstrations.shard import ShardResult, Task
from experts.demonstrations.tensors import map_tensors


class Advance(NamedTuple):
    """How far a run has come.

    Attributes:
        problems: Number of problems of this run.
        done: Number of problems whose shards are written, found ones included.
        found: Number of problems whose shards were there before.
        demonstrations: Number of demonstrations in those that are written.
        seconds: Time since the run began to solve, s.
    """

    problems: int
    done: int
    found: int
    demonstrations: int
    seconds: float

    @property
    def rate(self) -> float:
        """Problems solved per second in this run; 0 before the first ones."""
        return (self.done - self.found) / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def success_rate(self) -> float:
        """Share of the problems that are demonstrations now, 0 to 1; 1 before the first ones."""
        return self.demonstrations / self.done if self.done else 1.0

    @property
    def seconds_left(self) -> float:
        """Time that the rest takes at this rate, s; inf if it is not known."""
        if self.done == self.problems:
            return 0.0
        return (self.problems - self.done) / self.rate if self.rate > 0.0 else math.inf


def generate_demonstrations(
    scene: Scene | str | Path,
    n: int,
    out: str | os.PathLike[str],
    seed: int = 0,
    *,
    shard_size: int = SHARD_SIZE,
    part: tuple[int, int] = (1, 1),
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] | None = None,
) -> Demonstrations | None:
    """Solve n problems drawn from the scene's spread, and write what agents learn from.

    A run that was interrupted, in whatever way, is resumed by the same call: shards that are there are
    checked, those that are missing or damaged are made. The final files are those of an uninterrupted run,
    byte for byte.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file. It is taken in double precision.
        n: Number of problems. Those that the expert fails at are recorded, and are no demonstrations.
        out: Folder to write; made if it does not exist.
        seed: Seed of the data set; problem i has a seed of its own, which follows from it and i.
        shard_size: Problems of a file.
        part: (i, k) does part i of k, i from 1, for several runs in the same folder, at once or not;
            whichever ends last, or any later one, completes the folder.
        workers: Number of processes; one for each processor by default. With 1 the work is done here.
        executor: Who makes the shards, in place of processes.
        progress: Called at the beginning and after each shard.

    Returns:
        The demonstrations; None if other parts are still missing.

    Raises:
        SceneError: If the scene cannot be loaded.
        ValueError: If an argument is out of range, or the scene is not one for demonstrations.
        DemonstrationsError: If another run is at work in the folder; if the folder is for other settings; if
            the disk is full, or processes are killed again and again. What is there remains, and the same
            call goes on with it.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    settings = Settings.of(scene, n, seed, shard_size)
    if not 1 <= part[0] <= part[1]:
        raise ValueError(f"part: {part}, should be (i, k) with 1 <= i <= k")
    folder = Folder(Path(out), settings, Part(*part))
    chosen = executor or local_executor(workers)
    try:
        with folder.opened():
            _fill(folder, chosen, progress or (lambda advance: None))
            complete = folder.complete()
    except OSError as error:
        raise DemonstrationsError(
            f"{error.filename or folder.path} cannot be written: {error.strerror or error}. The shards "
            "that are complete remain; the same command goes on with them"
        ) from error
    return load_demonstrations(folder.path) if complete else None


def _fill(folder: Folder, executor: Executor, progress: Callable[[Advance], None]) -> None:
    """Make the shards that are missing."""
    from experts.report.provenance import provenance  # loads all that reports need

    settings, missing, demonstrations, found = folder.settings, [], 0, 0
    for shard, path in folder.sound_shards():
        if path is None:
            missing.append(shard)
        else:
            demonstrations += len(map_tensors(path).arrays["index"])
            found += len(settings.problems(shard))
    problems = sum(len(settings.problems(shard)) for shard in folder.shards)
    started, done = perf_counter(), found
    progress(Advance(problems, done, found, demonstrations, 0.0))
    folder.log({"run": provenance("safetensors"), "host": platform.node()})
    tasks = (Task(settings, shard) for shard in missing)
    with closing(executor.run(tasks)) as results:
        for result in results:
            folder.write(result)
            folder.log(_log_entry(result))
            done += result.demonstrations + result.failures
            demonstrations += result.demonstrations
            progress(Advance(problems, done, found, demonstrations, perf_counter() - started))


def _log_entry(result: ShardResult) -> dict[str, object]:
    return {
        "shard": result.shard,
        "host": result.host,
        "demonstrations": result.demonstrations,
        "failures": result.failures,
        "seconds": result.seconds,
        "solve_seconds": result.solve_seconds,
    }
