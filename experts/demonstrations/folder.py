"""A folder of demonstrations on disk.

    FOLDER
    |-- settings.json                        all that the data follow from; written first
    |-- shards
    |   |-- 000000-<sha256>.safetensors      a shard, named after its content
    |   `-- ...
    |-- manifest.json                        outcome of every problem, hashes of the shards; written last
    |-- log                                  locks, machines and times, which differ from run to run
    |-- README.md                            data card
    `-- summary                              page with distributions, times and sample trajectories

A shard is written under a temporary name and renamed once it is on disk. Every file with its proper name is
therefore complete at any moment; the rest is left over from a killed run and is removed.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.common.files import differences, remove_leftovers, write_atomically
from dq_space_arm_env.common.locks import locked
from experts.demonstrations.outcomes import REASONS
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import ShardResult
from experts.demonstrations.tensors import DemonstrationsError, map_tensors

SETTINGS, MANIFEST, SHARDS, LOG, CARD = "settings.json", "manifest.json", "shards", "log", "README.md"
SHARD_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.safetensors")


class Part(NamedTuple):
    """Part `number` (from 1) of several runs that share the work, on one machine or many."""

    number: int
    of: int

    @classmethod
    def of_pair(cls, pair: tuple[int, int]) -> Self:
        """Check what a user asks for; the numbers name files."""
        fits = isinstance(pair, tuple | list) and len(pair) == 2
        whole = fits and all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in pair)
        if not whole or not 1 <= pair[0] <= pair[1]:
            raise ValueError(f"part: {pair!r}, should be (i, k), whole numbers with 1 <= i <= k")
        return cls(int(pair[0]), int(pair[1]))

    def shards(self, n_shards: int) -> range:
        """Return the numbers of this part's shards."""
        return range(self.number - 1, n_shards, self.of)


class Folder:
    """A folder that demonstrations are generated in; `shards` are the numbers of this part's."""

    def __init__(self, path: Path, settings: Settings, part: Part) -> None:
        self.path, self.settings, self.part = path, settings, part
        self.shards = part.shards(settings.n_shards)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create or open the folder, and lock this part of the work inside a `with` block.

        The operating system releases the locks when the process ends, however it ends.
        """
        if (self.path / CARD).exists() and not (self.path / SETTINGS).exists():
            raise DemonstrationsError(
                f"{self.path} has a {CARD} of its own, which the data card would replace; choose a new folder"
            )
        there = next(path for path in (self.path, *self.path.parents) if path.exists())
        if not there.is_dir():
            raise DemonstrationsError(f"out: {there} is a file, it should be a folder; choose another")
        for folder in (self.path, self.path / SHARDS, self.path / LOG):
            folder.mkdir(parents=True, exist_ok=True)
        with _reserved(self.path, self.part, self._remove_leftovers, self._check_settings):
            yield

    def _remove_leftovers(self) -> None:
        """Remove what killed runs left of this part's shards, and beside them if it is all of the work."""
        if self.part.of == 1:
            remove_leftovers(self.path)
        for path in (self.path / SHARDS).iterdir():
            match = SHARD_NAME.match(path.name.removeprefix("."))
            if match and int(match[1]) in self.shards and path.name != match[0]:
                path.unlink(missing_ok=True)

    def _check_settings(self) -> None:
        path, here = self.path / SETTINGS, self.settings.record()
        try:
            if not path.exists():
                write_atomically(path, self.settings.to_json(), durable=True)
                return
            there = read_mapping(path)
        except UnreadableError as error:
            raise DemonstrationsError(f"{path} is damaged ({error}); choose a new folder") from error
        found = differences(there, here)
        if found:
            raise DemonstrationsError(
                f"{self.path} was started with different settings: {'; '.join(found)}. Use those, or choose "
                "a new folder"
            )

    def sound_shards(self) -> Iterator[tuple[int, Path | None]]:
        """Yield each shard of this part and its file, or None; remove damaged files and duplicates."""
        files: dict[int, list[Path]] = {}
        for path in sorted((self.path / SHARDS).iterdir()):
            match = SHARD_NAME.fullmatch(path.name)
            if match and int(match[1]) in self.shards:
                files.setdefault(int(match[1]), []).append(path)
        for shard in self.shards:
            sound = None
            for path in files.get(shard, ()):
                if sound is None and sha256_of(path) == path.stem.partition("-")[2]:
                    sound = path
                else:
                    path.unlink()
            yield shard, sound

    def write(self, result: ShardResult) -> None:
        path = self.path / SHARDS / f"{result.shard:06d}-{result.sha256}.safetensors"
        write_atomically(path, result.content, durable=True)

    def log(self, entry: dict[str, Any]) -> None:
        """Append a line to the log of this part."""
        name = f"part-{self.part.number}-of-{self.part.of}.jsonl"
        with (self.path / LOG / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def complete(self) -> bool:
        """Write the manifest if all shards exist, those of other parts included; tell whether they do.

        Raises DemonstrationsError if one of another part is damaged; those of this part have been checked.
        """
        paths = sorted(path for path in (self.path / SHARDS).iterdir() if SHARD_NAME.fullmatch(path.name))
        known = {int(path.name.partition("-")[0]): path for path in paths}
        wanted = range(self.settings.n_shards)
        shards = {number: known[number] for number in wanted if number in known}  # and none of other sets
        if len(shards) < len(wanted):
            return False
        for number, path in shards.items():
            if number not in self.shards and sha256_of(path) != path.stem.partition("-")[2]:
                part = f"{number % self.part.of + 1} of {self.part.of}"
                raise DemonstrationsError(f"{path} is damaged: run part {part} again, which makes it anew")
        manifest = manifest_of(self.path / SETTINGS, list(shards.values()))
        write_atomically(self.path / MANIFEST, manifest_text(manifest), durable=True)
        return True


def sha256_of(path: Path) -> str:
    """Hash a file: 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def manifest_text(manifest: dict[str, Any]) -> str:
    return json.dumps(manifest, indent=2) + "\n"


def manifest_of(settings: Path, paths: list[Path]) -> dict[str, Any]:
    """Outcomes and shards; the same whichever part writes it."""
    shards, failures = [], np.zeros(len(REASONS), dtype=np.int64)
    for path in paths:
        arrays = map_tensors(path).arrays
        reasons = arrays["failures.stop_reason"]
        failures += np.bincount(reasons, minlength=len(REASONS))
        shards.append(
            {
                "file": path.name,
                "sha256": path.stem.partition("-")[2],
                "bytes": path.stat().st_size,
                "demonstrations": len(arrays["index"]),
                "failures": len(reasons),
            }
        )
    return {
        "settings_sha256": sha256_of(settings),
        "demonstrations": sum(shard["demonstrations"] for shard in shards),
        "failures": {reason: int(count) for reason, count in zip(REASONS, failures, strict=True) if count},
        "shards": shards,
    }


@contextmanager
def _reserved(
    folder: Path, part: Part, remove_leftovers: Callable[[], None], check: Callable[[], None]
) -> Iterator[None]:
    """Lock a part of the work, and check its settings while no other part begins.

    A run that does all of it excludes any other; parts exclude only that. Leftovers are removed unless the
    work is divided in another way beside: then they may be of a living run.
    """
    refusal = DemonstrationsError(
        f"another run is writing to {folder}: wait for it, or choose another folder"
    )
    log = folder / LOG
    mine = log / f"lock-{part.number}-of-{part.of}"
    with ExitStack() as held:
        with locked(log / "lock", refusal, seconds=10.0):  # held only while looking who is there
            for other in set(log.glob("lock-*" if part.of == 1 else "lock-1-of-1")) - {mine}:
                with locked(other, refusal):
                    pass
            held.enter_context(locked(mine, refusal))
            if not any(map(_is_held, set(log.glob("lock-*")) - set(log.glob(f"lock-*-of-{part.of}")))):
                remove_leftovers()
            check()
        yield


def _is_held(lock: Path) -> bool:
    """Whether a living run holds a lock."""
    try:
        with locked(lock, BlockingIOError()):
            return False
    except BlockingIOError:
        return True
