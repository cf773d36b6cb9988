"""A section of the report: what one part of it measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from io import StringIO
from typing import Any

from rich.console import Console

from experts.report.command import NO_PICTURE
from experts.report.tables import TextTable

_WIDTH = 110


@dataclass(frozen=True)
class Figure:
    """A picture.

    Attributes:
        name: Name of its file without the extension.
        caption: What is to be seen.
        png: The file's content.
    """

    name: str
    caption: str
    png: bytes


@dataclass
class Section:
    """What one part of the report measured.

    Attributes:
        name: Name on the command line.
        title: Its heading.
        caption: What it is about, and what is to be seen.
        tables: Tables.
        printed: Text that was made for a terminal, tables drawn with lines included.
        notes: Sentences below the tables.
        figures: Pictures.
        shortcomings: A sentence for each thing that is less accurate than declared.
        record: What was measured in JSON's types, for programs.
    """

    name: str
    title: str
    caption: str
    tables: list[TextTable] = field(default_factory=list)
    printed: str = ""
    notes: list[str] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    shortcomings: list[str] = field(default_factory=list)
    record: dict[str, Any] = field(default_factory=dict)

    def draw(self, name: str, caption: str, picture: Callable[[], bytes]) -> None:
        """Add a picture, or a note where Matplotlib is missing.

        Args:
            name: Name of its file without the extension.
            caption: What is to be seen.
            picture: Draws it, as PNG.
        """
        if find_spec("matplotlib") is None:
            self.notes.append(NO_PICTURE)
            return
        self.figures.append(Figure(name, caption, picture()))


def printed(print_it: Callable[[Console], object]) -> str:
    """What a function prints.

    Args:
        print_it: Prints on the console that it is given.

    Returns:
        The text, 110 columns wide.
    """
    file = StringIO()
    print_it(Console(file=file, width=_WIDTH, highlight=False, color_system=None))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines()).strip("\n")
