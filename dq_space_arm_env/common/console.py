"""Exit statuses, and the consoles that tables, progress and complaints go to."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

SUCCESS, FAILURE, UNUSABLE, INTERNAL, INTERRUPTED = 0, 1, 2, 70, 130
"""Exit statuses: done; done, but below what was asked for; unusable input; a bug; interrupted."""


def table_console(width: int = 110, *, stderr: bool = False) -> Console:
    """Make a console for tables; `width` applies to files and pipes, which have none."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    known = stream.isatty() or "COLUMNS" in os.environ
    return Console(stderr=stderr, highlight=False, width=None if known else width)


def message_console() -> Console:
    """Make the console for progress and remarks, on standard error."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def complain(sentence: str, *, label: str = "Error: ") -> None:
    """Print a sentence on standard error, its label in red on a terminal."""
    from rich.text import Text

    message_console().print(Text.assemble((label, "bold red"), sentence), soft_wrap=True)
