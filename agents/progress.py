"""How a run goes, while it goes: a bar on a terminal, a line now and then elsewhere."""

import math
from time import perf_counter
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

SECONDS_BETWEEN_LINES = 30.0
"""Without a terminal, a line after at least so many seconds, and at the end."""


class Advance(Protocol):
    """How far a run, or a part of it, has come."""

    @property
    def done(self) -> int:
        """How much is done."""

    @property
    def total(self) -> int:
        """Of how much."""

    def describe(self) -> str:
        """Put it into one line."""


class ProgressDisplay:
    """Shows how far a run has come; use it as a context, and its method as the callback."""

    def __init__(self, console: Console) -> None:
        """Set up.

        Args:
            console: Where to write.
        """
        self._console, self._last_line = console, -math.inf
        # Refreshed by hand: a thread of its own would compete with the learner.
        columns = BarColumn(), TextColumn("{task.description}", markup=False)
        self._bar = Progress(*columns, console=console, auto_refresh=False, disable=not console.is_terminal)
        self._task = self._bar.add_task("preparing", total=None)

    def __enter__(self) -> Self:
        """Show an empty bar."""
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar where it is."""
        self._bar.stop()

    def update(self, advance: Advance) -> None:
        """Show how far the run has come.

        Args:
            advance: How far.
        """
        line, done, total = advance.describe(), advance.done, advance.total
        self._bar.update(self._task, description=line, total=total, completed=done, refresh=True)
        if not self._console.is_terminal and (
            perf_counter() - self._last_line >= SECONDS_BETWEEN_LINES or done >= total
        ):
            self._last_line = perf_counter()
            self._console.print(line, markup=False, soft_wrap=True)
