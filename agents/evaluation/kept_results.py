"""Finished results as files: an interrupted run resumes with them.

A file appears only once it is complete, so an interrupted process leaves no half of one, and two processes
may write the same file. A result is read only where it follows from the same inputs as the one asked for.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_json, read_mapping
from dq_space_arm_env.common.code_cache import cache_directory
from dq_space_arm_env.common.files import write_atomically

Row = dict[str, Any]
ROWS = "rows"
"""Folder of the finished rows of a comparison, beside its table."""
_DIGITS = 32


class CachedGroups:
    """Rows for a sequence of seeds in the cache folder, one file for each group of `size` seeds."""

    def __init__(
        self,
        kind: str,
        follows_from: Mapping[str, Any],  # JSON values; others have another folder
        columns: Iterable[str],  # of every row
        seeds: Sequence[int],
        size: int,
    ) -> None:
        self._folder = cache_directory() / kind / _digest(follows_from)[:_DIGITS]
        self._columns, self._seeds, self._size = frozenset(columns), list(seeds), size
        groups = range(-(-len(self._seeds) // size))
        found = ((group, self._read(group)) for group in groups)
        self.groups: dict[int, list[Row]] = {group: rows for group, rows in found if rows is not None}
        self.missing = [group for group in groups if group not in self.groups]

    def seeds(self, group: int) -> list[int]:
        """Seeds of a group."""
        return self._seeds[group * self._size : (group + 1) * self._size]

    @property
    def rows(self) -> list[Row]:
        """Rows of all groups that are known, in the order of the seeds."""
        return [row for group in sorted(self.groups) for row in self.groups[group]]

    def add(self, group: int, rows: list[Row]) -> None:
        """Write the rows of a group; JSON values with all columns, in the order of the seeds."""
        self.groups[group] = rows
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._file(group), json.dumps(rows))

    def _read(self, group: int) -> list[Row] | None:
        """Rows of a group; None if the file is missing or damaged."""
        try:
            rows = read_json(self._file(group))
        except UnreadableError:
            return None
        if not isinstance(rows, list) or not all(
            isinstance(row, dict)
            and row.keys() == self._columns
            and all(value is None or isinstance(value, int | float) for value in row.values())
            for row in rows
        ):
            return None
        return rows if [row["seed"] for row in rows] == self.seeds(group) else None

    def _file(self, group: int) -> Path:
        return self._folder / f"{group:03d}.json"


class KeptRows:
    """Rows of a comparison in the folder `rows` of its output; without an output folder nothing is kept."""

    def __init__(self, out: Path | None) -> None:
        self._folder = None if out is None else out / ROWS

    def read(self, name: str, follows_from: Mapping[str, Any]) -> Row | None:
        """A row; None if it is missing, damaged, or follows from other inputs."""
        if self._folder is None:
            return None
        try:
            record = read_mapping(self._file(name))
        except UnreadableError:
            return None
        return record if record.get("key") == _digest(follows_from) else None

    def write(self, name: str, follows_from: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write a row, JSON values."""
        if self._folder is None:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        content = {"key": _digest(follows_from), **record}
        write_atomically(self._file(name), json.dumps(content) + "\n")

    def _file(self, name: str) -> Path:
        assert self._folder is not None
        return self._folder / (re.sub(r"[^\w.-]+", "-", name) + ".json")


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
