"""A folder of demonstrations on the disk: what it is for, which shards it has, who is at work in it.

| file | content |
|---|---|
| `settings.json` | all that the data follow from; written first |
| `shards/<number>-<sha256>.safetensors` | a shard, under the name of its content: what differs is damaged |
| `manifest.json` | what became of every problem, and the shards with their hashes; written last |
| `log/` | locks, and who took how long for what: this may differ from run to run |
| `README.md`, `summary/` | a data card, and a page with times, from `experts.report.demonstrations` |

A shard is written under another name, and renamed once the disk has it. So at any moment every file with its
proper name is whole, and the rest is rubbish to be removed.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experts.demonstrations.errors import DemonstrationsError
from experts.demonstrations.outcomes import REASONS
from experts.demonstrations.settings import Settings, differences
from experts.demonstrations.shard import ShardResult
from experts.demonstrations.tensors import map_tensors
from experts.files import write_atomically

SETTINGS, MANIFEST, SHARDS, LOG = "settings.json", "manifest.json", "shards", "log"
_SHARD_NAME = re.compile(r"(\d{6,})-([0-9a-f]{64})\.safetensors")


class Part(NamedTuple):
    """One of several runs that share the work, on one machine or many.

    Attributes:
        number: From 1.
        of: Number of parts.
    """

    number: int
    of: int

    def shards(self, n_shards: int) -> range:
        """Shards of this part.

        Args:
            n_shards: Number of all shards.

        Returns:
            Every `of`-th shard.
        """
        return range(self.number - 1, n_shards, self.of)


class Folder:
    """A folder that demonstrations are generated in.

    Attributes:
        path: Where it is.
        settings: What it is for.
        part: The part of the work that is done here.
        shards: Numbers of the shards of this part.
    """

    def __init__(self, path: Path, settings: Settings, part: Part) -> None:
        """Name the folder; nothing is written yet.

        Args:
            path: Where it is, or will be.
            settings: What it is for.
            part: The part of the work that is done here; 1 of 1 for all of it.
        """
        self.path, self.settings, self.part = path, settings, part
        self.shards = part.shards(settings.n_shards)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make or find the folder, and keep others out of the same work inside a `with` block.

        The locks are those of the operating system: they vanish with the process, however it ends.

        Raises:
            DemonstrationsError: If another run is at work on the same shards, or the folder is for other
                settings.
        """
        for folder in (self.path, self.path / SHARDS, self.path / LOG):
            folder.mkdir(parents=True, exist_ok=True)
        whole, part = self.path / LOG / "lock", self.path / LOG / f"lock-{self.part.number}-of-{self.part.of}"
        with _locked(whole, exclusive=self.part.of == 1), _locked(part, exclusive=True):
            if self.part.of == 1:  # nobody else is writing
                for name in (SETTINGS, MANIFEST):
                    for unfinished in self.path.glob(f".{name}.*.part"):
                        unfinished.unlink()
            self._check_settings()
            yield

    def _check_settings(self) -> None:
        path, here = self.path / SETTINGS, self.settings.record()
        try:
            there = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            write_atomically(path, self.settings.to_json(), durable=True)
            return
        except ValueError as error:
            raise DemonstrationsError(f"{path} is damaged ({error}); take a new folder") from error
        found = differences(there, here)
        if found:
            raise DemonstrationsError(
                f"{self.path} was begun with other settings: {'; '.join(found)}. Repeat them, or take a new "
                "folder"
            )

    def sound_shards(self) -> Iterator[tuple[int, Path | None]]:
        """Check the shards of this part; remove what is damaged, left over, or there twice.

        Yields:
            The number of each shard, and its file, or None if it has to be made.
        """
        files: dict[int, list[Path]] = {}
        for path in sorted((self.path / SHARDS).iterdir()):
            name = path.name.removeprefix(".")
            match = _SHARD_NAME.match(name)
            if match and int(match[1]) in self.shards:
                if path.name == match[0]:
                    files.setdefault(int(match[1]), []).append(path)
                else:
                    path.unlink(missing_ok=True)  # what a killed run has begun to write
        for shard in self.shards:
            sound = None
            for path in files.get(shard, ()):
                if sound is None and sha256_of(path) == path.stem.partition("-")[2]:
                    sound = path
                else:
                    path.unlink()
            yield shard, sound

    def write(self, result: ShardResult) -> None:
        """Write a shard.

        Args:
            result: The shard.

        Raises:
            OSError: If that is impossible; the folder is as it was then.
        """
        path = self.path / SHARDS / f"{result.shard:06d}-{result.sha256}.safetensors"
        write_atomically(path, result.content, durable=True)

    def log(self, entry: dict[str, Any]) -> None:
        """Add a line to the log of this part.

        Args:
            entry: JSON values.
        """
        name = f"part-{self.part.number}-of-{self.part.of}.jsonl"
        with (self.path / LOG / name).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def complete(self) -> bool:
        """Write the manifest if all shards are there, those of other parts included.

        Returns:
            Whether they are.
        """
        paths = sorted(path for path in (self.path / SHARDS).iterdir() if _SHARD_NAME.fullmatch(path.name))
        shards = {int(path.name.partition("-")[0]): path for path in paths}
        if len(shards) < self.settings.n_shards:
            return False
        manifest = _manifest(self.path / SETTINGS, [shards[i] for i in range(self.settings.n_shards)])
        write_atomically(self.path / MANIFEST, json.dumps(manifest, indent=2) + "\n", durable=True)
        return True


def sha256_of(path: Path) -> str:
    """Hash a file.

    Args:
        path: The file.

    Returns:
        SHA-256, 64 hexadecimal digits.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _manifest(settings: Path, paths: list[Path]) -> dict[str, Any]:
    """What became of every problem, and where; the same whoever writes it."""
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
def _locked(path: Path, *, exclusive: bool) -> Iterator[None]:
    """Hold a lock, together with others if it is not exclusive."""
    import fcntl  # not on Windows

    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DemonstrationsError(
                f"another run is at work in {path.parent.parent}: wait for it, or take another folder"
            ) from error
        yield
    finally:
        os.close(descriptor)
