"""What a data set is, byte for byte, its problems solved one by one, and ways to interrupt its making."""

import hashlib
import json
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

from experts.demonstrations.outcomes import Expert, Outcome, expert_of, solve
from experts.demonstrations.reading import Demonstration
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import NOTES, ShardResult, Task, draw_starts, make_shard
from experts.demonstrations.tensors import map_tensors, pack


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the log, which may differ from run to run."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path.parent.name != "log"}


def shard_files(folder: Path) -> list[Path]:
    return sorted((folder / "shards").iterdir())


def rewrite(file: Path, change: Callable[[Any], Any]) -> None:
    content = json.loads(file.read_text())
    changed = change(content)
    file.write_text(json.dumps(content if changed is None else changed, indent=2) + "\n")


def ends_inside(demonstration: Demonstration) -> bool:
    """Whether a maneuver ends well within the tolerances: they had no say."""
    attitude, position = demonstration.facts["final_errors"]
    success = demonstration.scene.success
    return bool(attitude < 0.9 * success.attitude_error_deg and position < 0.9 * success.position_error)


def replace_first_shard(folder: Path, **changes: Any) -> None:
    """Write other arrays into the first shard, with a manifest that fits."""
    shard = min((folder / "shards").iterdir())
    arrays = {name: array.copy() for name, array in map_tensors(shard).arrays.items()} | changes
    content = pack({name: array for name, array in arrays.items() if array is not None}, NOTES)
    digest = hashlib.sha256(content).hexdigest()
    shard.unlink()
    (folder / "shards" / f"000000-{digest}.safetensors").write_bytes(content)

    def update(manifest: Any) -> None:
        name = f"000000-{digest}.safetensors"
        manifest["shards"][0].update(file=name, sha256=digest, bytes=len(content))

    rewrite(folder / "manifest.json", update)


def solved_problems(settings: Settings) -> tuple[Expert, list[Outcome]]:
    """The first solve of every problem."""
    expert = expert_of(settings.scene)
    seeds = [settings.problem_seed(problem) for problem in range(settings.n)]
    problems = zip(range(settings.n), seeds, *draw_starts(settings.scene, seeds), strict=True)
    return expert, [solve(expert, *problem) for problem in problems]


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
