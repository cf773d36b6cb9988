"""The option --ray, and the executor that it and --workers choose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from experts.executors import Executor

ray_option = click.option(
    "--ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Work on a Ray cluster: host:port of its head, or local for a new one on this machine. Default: the "
    "one that RAY_ADDRESS names, else the one that this machine belongs to, else a new one.",
)


def chosen_executor(workers: int | None, ray: str | None) -> Executor | None:
    """The executor that a command line asks for; None if it leaves the choice.

    Raises:
        click.UsageError: If it asks for both processes and a cluster.
        ValueError: If it asks for no process.
    """
    if workers is not None and ray is not None:
        raise click.UsageError("--workers and --ray exclude each other", click.get_current_context())
    if ray is not None:
        from experts.ray_executor import RayExecutor

        return RayExecutor(ray or None)
    if workers is not None:
        from experts.executors import local_executor

        return local_executor(workers)
    return None
