"""Finished rows of a comparison as files: what was interrupted goes on with them.

A row is taken up only if it follows from the same things as the one that is asked for.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experts.files import write_atomically

ROWS = "rows"
"""Folder of finished rows, with each episode, beside the table that they make."""


class KeptRows:
    """The rows of a folder."""

    def __init__(self, out: Path | None) -> None:
        """Take the folder; it need not be there.

        Args:
            out: Folder of the comparison, whose folder `rows` is meant; None keeps nothing.
        """
        self._folder = None if out is None else out / ROWS

    def read(self, name: str, follows_from: Mapping[str, Any]) -> dict[str, Any] | None:
        """Read a row.

        Args:
            name: Its name.
            follows_from: JSON values that it follows from.

        Returns:
            What was written; None if there is none, it follows from other things, or it is damaged.
        """
        if self._folder is None:
            return None
        try:
            record = json.loads(self._file(name).read_text(encoding="utf-8"))
            return dict(record) if record["key"] == _key(follows_from) else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, name: str, follows_from: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write a row.

        Args:
            name: Its name.
            follows_from: JSON values that it follows from.
            record: JSON values.

        Raises:
            OSError: If that is impossible.
        """
        if self._folder is None:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        content = {"key": _key(follows_from), **record}
        write_atomically(self._file(name), json.dumps(content) + "\n")

    def _file(self, name: str) -> Path:
        assert self._folder is not None
        return self._folder / (re.sub(r"[^\w.-]+", "-", name) + ".json")


def _key(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
