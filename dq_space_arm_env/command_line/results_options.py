"""Options for the results of a measurement."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dq_space_arm_env.command_line.verb import json_option

if TYPE_CHECKING:
    from dq_space_arm_env.common.results import Destination

Function = Callable[..., Any]


def results_options(name: str, *, picture: bool = True) -> Callable[[Function], Function]:
    """Add --out, --json, and --no-picture to a verb; its arguments `out`, `as_json`, `picture`."""

    def add(function: Function) -> Function:
        function = json_option(function)
        if picture:
            function = click.option(
                "--picture/--no-picture", default=True, help="Draw a picture (needs the extra plots)."
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
    """Check the options, and build the destination."""
    from dq_space_arm_env.common.files import check_writable
    from dq_space_arm_env.common.results import Destination

    check_writable(out)
    return Destination(out, picture, as_json)
