"""Exit statuses, and the consoles that tables, progress and complaints go to."""

from __future__ import annotations

import json
import os
import sys
from functools import cache
from typing import IO, TYPE_CHECKING, Any

from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.shown_text import printable

if TYPE_CHECKING:
    from rich.console import Console

SUCCESS, FAILURE, UNUSABLE, INTERNAL, INTERRUPTED = 0, 1, 2, 70, 130
"""Exit statuses: done; done, but below what was asked for; unusable input; a bug; interrupted."""

WIDTH = 110
"""Columns of tables in files and pipes."""


@cache
def _console_class() -> type[Console]:
    """A console that shows control characters in what it prints, rather than send them to the terminal.

    Of what its encoding lacks it shows question marks: a degree sign must not cost the results.
    """
    from rich.console import Console
    from rich.segment import Segment

    class PrintableConsole(Console):
        def render(self, *renderable: Any, **options: Any) -> Any:
            for segment in super().render(*renderable, **options):
                if not segment.control:  # as rich's own control codes are marked
                    text = _encodable(printable(segment.text), self.file)
                    segment = Segment(text, segment.style)
                yield segment

    return PrintableConsole


def table_console(width: int = WIDTH, *, stderr: bool = False) -> Console:
    """Make a console for tables; `width` applies to files and pipes, which have none."""
    known = has_width(sys.stderr if stderr else sys.stdout)
    return _console_class()(stderr=stderr, highlight=False, width=None if known else width)


def has_width(stream: IO[str]) -> bool:
    """Whether a terminal or the user sets the width of a stream, unlike that of a file or a pipe."""
    return stream.isatty() or os.environ.get("COLUMNS", "").strip("0").isdigit()


def message_console() -> Console:
    """Make the console for progress and remarks, on standard error."""
    return _console_class()(stderr=True, highlight=False)


def _encodable(text: str, stream: IO[str]) -> str:
    """Text with question marks for what a stream cannot encode and would raise an error for."""
    encoding = getattr(stream, "encoding", None)
    if encoding is None or text.isascii() or getattr(stream, "errors", "strict") != "strict":
        return text
    return text.encode(encoding, "replace").decode(encoding)


def say(sentence: str) -> None:
    """Print a line on standard output."""
    import click

    click.echo(_encodable(printable(sentence), sys.stdout))


def print_document(value: Any) -> None:
    """Print JSON to standard output; infinities and NaN become null."""
    import click

    text = json.dumps(json_value(value), indent=2, ensure_ascii=False, allow_nan=False)
    # Terminals with another encoding get escapes, and all where they would obey a character.
    if (sys.stdout.encoding or "").lower().replace("-", "") != "utf8" or printable(text) != text:
        text = json.dumps(json_value(value), indent=2, allow_nan=False)
    click.echo(text)


def complain(sentence: str, *, label: str = "Error: ") -> None:
    """Print a sentence on standard error, its label in red on a terminal."""
    from rich.text import Text

    message_console().print(Text.assemble((label, "bold red"), sentence), soft_wrap=True)
