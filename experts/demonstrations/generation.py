"""Generate demonstrations: make the shards that a folder lacks, then write its manifest."""

import math
import os
import platform
from collections.abc import Callable
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from dq_space_arm_env import Scene
from experts.demonstrations.folder import Folder, Part
from experts.demonstrations.reading import Demonstrations, load_demonstrations
from experts.demonstrations.settings import SHARD_SIZE, Settings
from experts.demonstrations.shard import ShardResult, Task
from experts.demonstrations.tensors import DemonstrationsError, map_tensors
from experts.executors import Executor, ExecutorError, local_executor


class Advance(NamedTuple):
    """Progress of a run.

    Attributes:
        problems: Problems of this run.
        done: Problems whose shards are written, found ones included.
        found: Problems whose shards existed before.
        demonstrations: Demonstrations among those done.
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
        """Demonstrations per problem done, 0 to 1; 1 before the first ones."""
        return self.demonstrations / self.done if self.done else 1.0

    @property
    def seconds_left(self) -> float:
        """Estimated remaining time, s; inf if unknown."""
        if self.done == self.problems:
            return 0.0
        return (self.problems - self.done) / self.rate if self.rate > 0.0 else math.inf

    @property
    def total(self) -> int:
        """Problems of this run, as a progress display asks for it."""
        return self.problems

    def describe(self) -> str:
        """Summarize in one line."""
        line = f"{self.done} of {self.problems} problems"
        if self.found:
            line += f" ({self.found} found)"
        if self.done:
            line += f", {self.success_rate:.1%} demonstrations"
        if self.rate > 0.0:
            line += f", {self.rate:.2f} a second"
        if 0.0 < self.seconds_left < math.inf:
            line += f", {timedelta(seconds=round(self.seconds_left))} left"
        return line


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
    """Solve n problems drawn from the scene's spread, and write demonstrations for agents to learn from.

    Repeat the call to resume a run, however it was interrupted: existing shards are checked, and missing or
    damaged ones are made. The final files are those of an uninterrupted run, byte for byte.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file. It is taken in double precision.
        n: Number of problems. Those that the expert fails to solve are recorded apart.
        out: Folder to write; created if it does not exist.
        seed: Seed of the data set; the seed of problem i follows from it and i.
        shard_size: Problems per file.
        part: (i, k) does part i of k, i from 1, for several runs in the same folder, concurrent or not;
            the last one to end, or any later one, completes the folder.
        workers: Number of processes; by default one per processor. 1 does the work in this process.
        executor: Makes the shards, in place of processes.
        progress: Called at the start and after each shard.

    Returns:
        The demonstrations; None if other parts are still missing.

    Raises:
        SceneError: If the scene cannot be loaded.
        ValueError: If an argument is out of range or no whole number, or the scene is unsuitable for
            demonstrations.
        DemonstrationsError: If another run is writing to the folder, the folder was made with other settings,
            a file of another part is damaged, the disk is full, or processes are killed repeatedly. Finished
            shards remain; repeat the call to resume.
        KeyboardInterrupt: If the user interrupts the run; finished shards remain likewise.
    """
    settings = Settings.of(scene, n, seed, shard_size)
    folder = Folder(Path(out), settings, Part.of_pair(part))
    chosen = executor or local_executor(workers)
    try:
        with folder.opened():
            _fill(folder, chosen, progress or (lambda advance: None))
            complete = folder.complete()
    except ExecutorError as error:
        raise DemonstrationsError(str(error)) from error
    except OSError as error:
        raise DemonstrationsError(
            f"{error.filename or folder.path} cannot be written: {error.strerror or error}. Finished "
            "shards remain; run the same command again to resume"
        ) from error
    return load_demonstrations(folder.path) if complete else None


def _fill(folder: Folder, executor: Executor, progress: Callable[[Advance], None]) -> None:
    """Make the missing shards."""
    from dq_space_arm_env.common.provenance import provenance  # slow to import

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
