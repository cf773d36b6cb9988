"""Destination of the results of a measuring command."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from dq_space_arm_env.common.console import print_document, table_console
from dq_space_arm_env.common.files import to_json, write_atomically
from dq_space_arm_env.common.report_page import NO_PICTURE


@dataclass(frozen=True)
class Destination:
    """Where the results of a measurement go; `document` prints JSON, and tables to standard error."""

    folder: Path
    picture: bool = True
    document: bool = False

    def console(self, width: int = 110) -> Console:
        """Make the console for tables."""
        return table_console(width, stderr=self.document)

    def write(self, name: str, record: dict[str, Any], draw: Callable[[], bytes] | None) -> list[str]:
        """Write a record as JSON, and draw its picture as PNG; lines that name the files.

        Write before anything is printed: nobody may be there to read it.
        """
        files, lines, picture = [f"{name}.json"], [], self.folder / f"{name}.png"
        write_atomically(self.folder / files[0], to_json(record))
        drawable = find_spec("matplotlib") is not None
        if draw is not None and self.picture and drawable:
            files.append(picture.name)
            write_atomically(picture, draw())
        elif draw is not None:
            picture.unlink(missing_ok=True)  # of an earlier run: it may show other results
            lines += [NO_PICTURE] if self.picture else []
        return [*lines, f"{self.folder}: {', '.join(files)}"]

    def print(self, record: dict[str, Any]) -> None:
        """Print the document, if one is wanted."""
        if self.document:
            print_document(record)
