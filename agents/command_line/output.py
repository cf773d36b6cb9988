"""Where a verb writes: tables for people and documents for programs to standard output, the rest not."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 110
"""Columns of tables where the output is a file or a pipe, which has no width of its own."""


def table_console(*, as_json: bool = False) -> Console:
    """The console for tables.

    Args:
        as_json: Whether standard output is for a document, so that tables go to standard error.

    Returns:
        A console; colors follow NO_COLOR and FORCE_COLOR, and there are none without a terminal.
    """
    from rich.console import Console

    stream = sys.stderr if as_json else sys.stdout
    known = stream.isatty() or "COLUMNS" in os.environ
    return Console(stderr=as_json, highlight=False, width=None if known else WIDTH)


def message_console() -> Console:
    """The console for progress and remarks: standard error."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def print_document(value: Any) -> None:
    """Print JSON to standard output; it is the only thing that may stand there.

    Args:
        value: JSON values; infinities and NaN become null.
    """
    # A terminal of another encoding gets what it can show; the document is the same.
    plain = (sys.stdout.encoding or "").lower().replace("-", "") != "utf8"
    click.echo(json.dumps(_finite(value), indent=2, ensure_ascii=plain, allow_nan=False))


def _finite(value: Any) -> Any:
    """Replace what JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_writable(folder: Path) -> None:
    """Refuse a folder that results cannot go to, before they are worked for; it is not made.

    Args:
        folder: The folder; it need not exist.

    Raises:
        ValueError: If it cannot be written, or made.
    """
    # Not Path.exists, which fails where a folder above may not be entered.
    nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise ValueError(f"{folder} cannot be made: {nearest} is no folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        place = "there" if nearest == folder else f"in {nearest}"
        raise ValueError(f"{folder}: no permission to write {place}")


def complain(sentence: str, *, label: str = "Error: ") -> None:
    """Print a sentence on standard error.

    Args:
        sentence: What is wrong.
        label: What stands before it, in red on a terminal.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, highlight=False)
    console.print(Text.assemble((label, "bold red"), sentence), soft_wrap=True)
