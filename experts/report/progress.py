"""How a solve goes, while it goes: a line that is rewritten on a terminal, a line now and then elsewhere."""

from time import perf_counter
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live

from experts.solution import IterationRecord

LINES_EVERY = 10
"""Without a terminal, a line for every so many iterations."""


class SolveProgress:
    """Shows the iterations of a solve; use it as a context, and its methods as callbacks."""

    def __init__(self, console: Console) -> None:
        """Set up.

        Args:
            console: Where to write.
        """
        self._console = console
        # Refreshed by hand: a thread of its own would compete with the solver.
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._started = perf_counter()

    def __enter__(self) -> Self:
        """Say that the preparations have begun."""
        if self._live is not None:
            self._live.start()
        self._show("preparing (a new scene is compiled first, which takes some 15 s)")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the last line where it is."""
        if self._live is not None:
            self._live.stop()

    def start(self) -> None:
        """Start the clock of the solve."""
        self._started = perf_counter()

    def update(self, record: IterationRecord) -> None:
        """Show an iteration.

        Args:
            record: Its numbers.
        """
        if self._live is None and record.iteration % LINES_EVERY != 1:
            return
        elapsed = perf_counter() - self._started
        step = f"step {record.alpha:<6.3g}" if record.alpha > 0.0 else "no step    "
        self._show(
            f"iteration {record.iteration:3d}   J {record.cost:<10.8g}   {step}   "
            f"damping {record.regularization:<7.2g}   {elapsed:5.2f} s"
        )

    def _show(self, line: str) -> None:
        if self._live is None:
            self._console.print(line, highlight=False)
        else:
            self._live.update(line, refresh=True)
