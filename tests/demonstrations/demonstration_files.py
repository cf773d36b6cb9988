"""What a data set is, byte for byte, and ways to interrupt its making."""

from collections.abc import Generator, Iterable
from pathlib import Path

from experts.demonstrations.shard import ShardResult, Task, make_shard


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the log, which may differ from run to run."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path.parent.name != "log"}


def shard_files(folder: Path) -> list[Path]:
    return sorted((folder / "shards").iterdir())


class CountingExecutor:
    """Makes shards here, notes which, in reverse order if asked to, and fails after some if told to."""

    def __init__(self, most: int | None = None, error: type[BaseException] = KeyboardInterrupt) -> None:
        self.made: list[int] = []
        self._most, self._error = most, error

    def run(self, tasks: Iterable[Task]) -> Generator[ShardResult]:
        for task in reversed(list(tasks)):
            if len(self.made) == self._most:
                raise self._error
            self.made.append(task.shard)
            yield make_shard(task)
