"""What measuring commands have in common: exit statuses, options, refusals, and files with a picture."""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from dq_space_arm_env import SceneError
from experts.files import write_atomically
from experts.report.summary import to_json

SUCCESS, INACCURATE, UNUSABLE, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: done; something is less accurate than declared; unusable input; interrupted by the user."""
NO_PICTURE = 'No picture: it needs matplotlib (pip install "dq-space-arm[plots]").'


@dataclass(frozen=True)
class Destination:
    """Where the results of a measurement go.

    Attributes:
        folder: Gets the files; it need not exist.
        picture: Whether a picture is wanted.
        document: Whether the record goes to standard output too, as JSON, and tables to standard error.
    """

    folder: Path
    picture: bool = True
    document: bool = False

    def console(self, width: int = 110) -> Console:
        """The console for tables.

        Args:
            width: Columns where the output is a file or a pipe, which has no width of its own.

        Returns:
            Standard output, or standard error beside a document.
        """
        return table_console(width, stderr=self.document)

    def save(
        self, console: Console, name: str, record: dict[str, Any], draw: Callable[[], bytes] | None
    ) -> None:
        """Write a record as JSON and its picture, and say which files there are.

        Args:
            console: Where to say it.
            name: Name of the files.
            record: JSON values.
            draw: Draws the picture, a PNG; None if there is nothing to draw. It is not called where no
                picture is wanted or Matplotlib is not installed.
        """
        files = [f"{name}.json"]
        write_atomically(self.folder / files[0], to_json(record))
        if draw is not None and self.picture:
            if find_spec("matplotlib") is None:
                console.print(NO_PICTURE, markup=False)
            else:
                files.append(f"{name}.png")
                write_atomically(self.folder / files[1], draw())
        console.print(f"{self.folder}: {', '.join(files)}", markup=False)
        self.print(record)

    def print(self, record: dict[str, Any]) -> None:
        """Print a record to standard output, if that is wanted.

        Args:
            record: JSON values.
        """
        if self.document:
            sys.stdout.write(to_json(record))


def parser_of(description: str, name: str) -> argparse.ArgumentParser:
    """A parser with the option that says where results go.

    Args:
        description: What the script does.
        name: Name of its folder among the results.

    Returns:
        A parser with --out.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / name, help="output folder")
    return parser


def table_console(width: int = 110, *, stderr: bool = False) -> Console:
    """The console for tables.

    Args:
        width: Columns of the tables where the output is a file or a pipe, which has no width of its own.
        stderr: Whether to write to standard error.

    Returns:
        Standard output, or standard error.
    """
    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, highlight=False, width=None if stream.isatty() else width)


def guarded(run: Callable[[], int]) -> int:
    """Run a script; a mistake of its user ends in a sentence, an interrupt in silence.

    Args:
        run: Does the work.

    Returns:
        Exit status: that of `run`, `UNUSABLE` or `INTERRUPTED`.
    """
    try:
        return run()
    except (SceneError, ImportError, ValueError, OSError) as error:
        complain([str(error)])
        return UNUSABLE
    except KeyboardInterrupt:
        Console(highlight=False).print("Interrupted: nothing is saved.")
        return INTERRUPTED


def complain(sentences: Sequence[str]) -> None:
    """Print on standard error.

    Args:
        sentences: What is wrong.
    """
    console = Console(stderr=True, highlight=False)
    for sentence in sentences:
        console.print(sentence, style="red", markup=False, soft_wrap=True)


def judge(shortcomings: Sequence[str]) -> int:
    """Say what is less accurate than declared.

    Args:
        shortcomings: A sentence for each.

    Returns:
        Exit status.
    """
    complain(shortcomings)
    return INACCURATE if shortcomings else SUCCESS
