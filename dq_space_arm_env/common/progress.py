"""Progress of a run: a bar on a terminal, a line now and then elsewhere."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from types import TracebackType
from typing import NamedTuple, Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from dq_space_arm_env.common.console import message_console

SECONDS_BETWEEN_LINES = 30.0  # without a terminal


class Advance(Protocol):
    """How far a run, or a part of it, has come."""

    @property
    def done(self) -> int:
        """Amount done."""

    @property
    def total(self) -> int:
        """Amount to do."""

    def describe(self) -> str:
        """Put it into one line."""


class Status(NamedTuple):
    """An `Advance` whose line is already written."""

    done: int
    total: int
    line: str

    def describe(self) -> str:
        return self.line


class ProgressDisplay:
    """Shows the progress of a run; use it as a context, and `update` as the callback."""

    def __init__(self, console: Console, *, bar: bool = True, transient: bool = False) -> None:
        self._console, self._last_line = console, -math.inf
        # Refreshed by hand: a thread of its own would compete with the run.
        text = TextColumn("{task.description}", markup=False)
        columns = (BarColumn(), text) if bar else (text,)
        self._bar = Progress(
            *columns,
            console=console,
            auto_refresh=False,
            transient=transient,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("preparing", total=None)

    @property
    def is_live(self) -> bool:
        """Whether it changes in place, on a terminal."""
        return not self._bar.disable

    def __enter__(self) -> Self:
        self._bar.start()
        _present.append(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _present.remove(self)
        self._bar.stop()  # leaves the last line visible, unless it is transient

    def update(self, advance: Advance) -> None:
        """Show how far the run has come."""
        done, total = advance.done, advance.total
        self._bar.update(self._task, total=total, completed=done)
        self.show(advance.describe(), now=done >= total)

    def show(self, line: str, *, now: bool = False) -> None:
        """Show a line; without a terminal at most every 30 s, or `now`."""
        self._bar.update(self._task, description=line, refresh=True)
        due = now or perf_counter() - self._last_line >= SECONDS_BETWEEN_LINES
        if due and not self._console.is_terminal:
            self._last_line = perf_counter()
            self._console.print(line, markup=False, soft_wrap=True)


_present: list[ProgressDisplay] = []


@contextmanager
def present_display() -> Iterator[ProgressDisplay]:
    """The display of the run, if it is on a terminal, or one on standard error that vanishes in the end."""
    if _present and _present[-1].is_live:
        yield _present[-1]
    else:
        with ProgressDisplay(message_console(), bar=False, transient=True) as display:
            yield display
