"""Destination of the results of a measuring command."""

from collections.abc import Callable, Mapping
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

    def write(
        self, name: str, record: dict[str, Any], pictures: Mapping[str, Callable[[], bytes]]
    ) -> list[str]:
        """Write a record as JSON, and pictures by the names of their files; lines that name the files.

        Write before anything is printed: nobody may be there to read it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        files, lines = [f"{name}.json"], []
        repeats = (self.folder / files[0]).exists()
        write_atomically(self.folder / files[0], to_json(record))
        if self.picture and find_spec("matplotlib") is not None:
            for file, draw in pictures.items():
                write_atomically(self.folder / file, draw())
                files.append(file)
        elif pictures:
            for file in pictures if repeats else ():  # of an earlier run: it may show other results
                (self.folder / file).unlink(missing_ok=True)
            lines += [NO_PICTURE] if self.picture else []
        return [*lines, f"{self.folder}: {', '.join(files)}"]

    def tell(self, console: Console, written: list[str], record: dict[str, Any]) -> None:
        """Print the lines that `write` returns, and the document, if one is wanted."""
        for line in written:
            console.print(line, markup=False)
        self.print(record)

    def print(self, record: dict[str, Any]) -> None:
        """Print the document, if one is wanted."""
        if self.document:
            print_document(record)
