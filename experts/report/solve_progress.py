"""Progress of a solve."""

from time import perf_counter
from types import TracebackType
from typing import Self

from rich.console import Console

from dq_space_arm_env import Scene
from dq_space_arm_env.common.progress import ProgressDisplay
from experts.ddp.solution import IterationRecord

LINES_EVERY = 10  # iterations, without a terminal


class SolveProgress:
    """Shows the iterations of a preparation, and from `start` on of a solve.

    Use it as a context, and `update` as the solver's callback.
    """

    def __init__(self, console: Console, scene: Scene) -> None:
        self._minimized = "J + penalties" if scene.constraints else "J"
        self._display, self._started = ProgressDisplay(console, bar=False), perf_counter()
        self._every, self._attempts = 1 if console.is_terminal else LINES_EVERY, 0
        self._prepares = True

    def __enter__(self) -> Self:
        self._display.__enter__()
        self._display.show("preparing", now=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._display.__exit__(kind, error, traceback)

    def start(self) -> None:
        """Start the clock of the solve, and count its attempts."""
        self._started, self._attempts, self._prepares = perf_counter(), 0, False

    def update(self, record: IterationRecord) -> None:
        """Show an iteration; without a terminal, every tenth, and of the preparation one each 30 s.

        An attempt has one guess, and one length of steps.
        """
        self._attempts += record.iteration == 1
        if self._prepares:  # in steps of other lengths, whose costs are no J
            where = f"solve {self._attempts:2d}   iteration {record.iteration:3d}"
            self._display.show(f"preparing   {where}   {perf_counter() - self._started:5.2f} s")
            return
        if self._every > 1 and record.iteration % self._every != 1:
            return
        step = f"step {record.alpha:<6.3g}" if record.alpha > 0.0 else "no step    "
        self._display.show(
            f"attempt {self._attempts:2d}   iteration {record.iteration:3d}   "
            f"{self._minimized} {record.cost:<10.8g}   {step}   damping {record.regularization:<7.2g}   "
            f"{perf_counter() - self._started:5.2f} s",
            now=True,
        )
