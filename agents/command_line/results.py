"""Options that say where the results of a measurement go."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agents.command_line.verb import json_option

if TYPE_CHECKING:
    from experts.report.command import Destination

Function = Callable[..., Any]


def results_options(name: str, *, picture: bool = True) -> Callable[[Function], Function]:
    """Add --out, --json, and --no-picture to a verb; its arguments `out`, `as_json`, `picture`.

    Args:
        name: Name of its folder among the results.
        picture: Whether there is a picture that may be left out.

    Returns:
        What adds them to a function.
    """

    def add(function: Function) -> Function:
        function = json_option(function)
        if picture:
            function = click.option(
                "--picture/--no-picture",
                default=True,
                help="Whether to draw a picture (needs the extra plots).",
            )(function)
        folder = click.option(
            "--out",
            type=click.Path(file_okay=False, path_type=Path),
            default=Path("results") / name,
            show_default=True,
            help="Output folder.",
        )
        return folder(function)

    return add


def destination(out: Path, as_json: bool, picture: bool = True) -> Destination:
    """What the options ask for.

    Args:
        out: Output folder.
        as_json: Whether standard output is for a document.
        picture: Whether a picture is wanted.

    Returns:
        The destination.
    """
    from agents.command_line.output import check_writable
    from experts.report.command import Destination

    check_writable(out)
    return Destination(out, picture, as_json)
