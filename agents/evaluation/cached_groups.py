"""Results for groups of starts as files in the cache folder: what was interrupted goes on with them.

A file holds a row for each start of a group. It has its name only once it is whole, so a process that is
killed leaves none behind, and of two that make the same one either will do.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dq_space_arm_env.compiler.native import cache_directory
from experts.files import write_atomically

Row = dict[str, Any]

_DIGITS = 32


class CachedGroups:
    """The files of one kind of results that follow from the same things."""

    def __init__(self, kind: str, follows_from: Mapping[str, Any], columns: Iterable[str]) -> None:
        """Find the folder; it need not be there.

        Args:
            kind: Name of the folder of all results of this kind.
            follows_from: JSON values that the results follow from; others have another folder.
            columns: Names that every row has.
        """
        digest = hashlib.sha256(json.dumps(follows_from, sort_keys=True).encode()).hexdigest()
        self._folder = cache_directory() / kind / digest[:_DIGITS]
        self._columns = frozenset(columns)

    def read(self, group: int, seeds: Sequence[int]) -> list[Row] | None:
        """Read a group.

        Args:
            group: Its number.
            seeds: The seed of each of its starts.

        Returns:
            A row for each start; None if there is no such file, or somebody has damaged it.
        """
        try:
            rows = json.loads(self._file(group).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(rows, list) or not all(
            isinstance(row, dict) and row.keys() == self._columns for row in rows
        ):
            return None
        return rows if [row["seed"] for row in rows] == list(seeds) else None

    def write(self, group: int, rows: list[Row]) -> None:
        """Write a group.

        Args:
            group: Its number.
            rows: A row for each of its starts, JSON values, with all columns.

        Raises:
            OSError: If that is impossible.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._file(group), json.dumps(rows))

    def _file(self, group: int) -> Path:
        return self._folder / f"{group:03d}.json"


def known_groups(
    files: CachedGroups, groups: Iterable[int], seeds_of: Callable[[int], Sequence[int]]
) -> tuple[dict[int, list[Row]], list[int]]:
    """Read what is there of some groups.

    Args:
        files: Their files.
        groups: Their numbers.
        seeds_of: The seeds of a group.

    Returns:
        Rows of the groups that are there, and the numbers of the others.
    """
    found: dict[int, list[Row]] = {}
    missing = []
    for group in groups:
        rows = files.read(group, seeds_of(group))
        if rows is None:
            missing.append(group)
        else:
            found[group] = rows
    return found, missing
