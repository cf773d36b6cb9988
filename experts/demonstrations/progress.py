"""How a run goes, while it goes: a bar on a terminal, a line now and then elsewhere."""

import math
from datetime import timedelta
from time import perf_counter
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from experts.demonstrations.generation import Advance

SECONDS_BETWEEN_LINES = 30.0
"""Without a terminal, a line after at least so many seconds, and at the end."""


class GenerationProgress:
    """Shows how far a run has come; use it as a context, and its method as the callback."""

    def __init__(self, console: Console) -> None:
        """Set up.

        Args:
            console: Where to write.
        """
        self._console = console
        self._bar: Progress | None = None
        if console.is_terminal:
            # Refreshed by hand: a thread of its own would compete with the solver.
            columns = BarColumn(), TextColumn("{task.description}", markup=False)
            self._bar = Progress(*columns, console=console, auto_refresh=False)
            self._task = self._bar.add_task("preparing", total=None)
        self._last_line = -math.inf

    def __enter__(self) -> Self:
        """Show an empty bar."""
        if self._bar is not None:
            self._bar.start()
            self._bar.refresh()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar where it is."""
        if self._bar is not None:
            self._bar.stop()

    def update(self, advance: Advance) -> None:
        """Show how far the run has come.

        Args:
            advance: How far.
        """
        line = describe(advance)
        if self._bar is not None:
            self._bar.update(
                self._task, description=line, total=advance.problems, completed=advance.done, refresh=True
            )
        elif perf_counter() - self._last_line >= SECONDS_BETWEEN_LINES or advance.done == advance.problems:
            self._last_line = perf_counter()
            self._console.print(line, markup=False, soft_wrap=True)


def describe(advance: Advance) -> str:
    """Put into one line how far a run has come.

    Args:
        advance: How far.

    Returns:
        The line.
    """
    line = f"{advance.done} of {advance.problems} problems"
    if advance.found:
        line += f" ({advance.found} found)"
    if advance.done:
        line += f", {advance.success_rate:.1%} demonstrations"
    if advance.rate > 0.0:
        line += f", {advance.rate:.2f} a second"
    if 0.0 < advance.seconds_left < math.inf:
        line += f", {timedelta(seconds=round(advance.seconds_left))} left"
    return line
