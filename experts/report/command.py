"""What measuring scripts have in common: exit statuses, options, refusals, and files with a picture."""

import argparse
import sys
from collections.abc import Callable, Sequence
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


def parser_of(description: str, name: str, *, picture: bool = True) -> argparse.ArgumentParser:
    """A parser with the options that say where results go.

    Args:
        description: What the script does.
        name: Name of its folder among the results.
        picture: Whether there is a picture that may be left out.

    Returns:
        A parser with --out, and --no-picture.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / name, help="output folder")
    if picture:
        parser.add_argument("--no-picture", dest="picture", action="store_false", help="tables and JSON only")
    return parser


def table_console(width: int = 110) -> Console:
    """The console for tables.

    Args:
        width: Columns of the tables where the output is a file or a pipe, which has no width of its own.

    Returns:
        Standard output.
    """
    return Console(highlight=False, width=None if sys.stdout.isatty() else width)


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


def save(
    console: Console,
    options: argparse.Namespace,
    name: str,
    record: dict[str, Any],
    draw: Callable[[], bytes] | None,
) -> None:
    """Write a record as JSON and its picture, and say which files there are.

    Args:
        console: Where to say it.
        options: With those of `parser_of`.
        name: Name of the files.
        record: JSON values.
        draw: Draws the picture, a PNG; None if there is nothing to draw. It is not called where no picture is
            wanted or Matplotlib is not installed.
    """
    files = [f"{name}.json"]
    write_atomically(options.out / files[0], to_json(record))
    if draw is not None and options.picture:
        if find_spec("matplotlib") is None:
            console.print(
                'No picture: it needs matplotlib (pip install "dq-space-arm[plots]").', markup=False
            )
        else:
            files.append(f"{name}.png")
            write_atomically(options.out / files[1], draw())
    console.print(f"{options.out}: {', '.join(files)}", markup=False)
