"""Compiling code for its first use: what is said meanwhile, once for each scene and in a line on a terminal.

Both follow the level of the logger `dq_space_arm_env`: above INFO, neither appears.
"""

from __future__ import annotations

import gc
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from time import monotonic
from typing import TextIO

from dq_space_arm_env.common.code_cache import cache_directory

SECONDS_TO_WAIT = 1.0
"""How long whoever waits is told nothing."""
_SECONDS_BETWEEN_LINES = 0.5
_SECONDS_APART = 0.5  # work that begins sooner after the last continues it


class _StandardError(logging.StreamHandler[TextIO]):
    """Writes to the present standard error, not the one at the logger's creation."""

    @property
    def stream(self) -> TextIO:
        """The present standard error."""
        return sys.stderr

    @stream.setter
    def stream(self, value: TextIO) -> None:
        """Nothing is kept."""


@cache
def _logger() -> logging.Logger:
    """The package's logger; its messages are shown unless its level is raised."""
    logger = logging.getLogger("dq_space_arm_env")
    if not logger.handlers:
        handler = _StandardError()
        handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
        logger.addHandler(handler)
        logger.propagate = False
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.INFO)
    return logger


def announce(what: str, *, if_first: bool = False) -> None:
    """Explain, once in a process, why the first use of something takes a moment.

    Args:
        what: What is compiled, such as "scene 'paper'".
        if_first: Whether any earlier message will do.
    """
    if what in _announced or (if_first and _announced):
        return
    _announced.add(what)
    _logger().info(
        "compiling what is used of %s for the first time, mostly under a minute on free cores; the result is "
        "kept in %s",
        what,
        cache_directory(),
    )


_announced: set[str] = set()


@contextmanager
def collector_paused() -> Iterator[None]:
    """Keep Python's garbage collector off.

    A compiler keeps millions of objects to its end, and the collector goes through them again and again.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextmanager
def compiling(line: Callable[[], str]) -> Iterator[None]:
    """Show what is being compiled, from the second second on: in the run's progress, or on standard error.

    Nothing is shown where that is no terminal, or closed. The collector is paused, see `collector_paused`.

    Args:
        line: Tells what is compiled, such as "linearize of scene 'paper'".
    """
    is_shown = sys.stderr and sys.stderr.isatty() and _logger().isEnabledFor(logging.INFO)
    with collector_paused():
        if not is_shown:
            yield
            return
        _ticker.begin(line)
        try:
            yield
        finally:
            _ticker.end(line)


class _Ticker:
    """Shows the works in progress, which are mostly inside one another."""

    def __init__(self) -> None:
        self._lock, self._lines = threading.Lock(), list[Callable[[], str]]()
        self._began = self._ended = -float("inf")
        self._finished, self._thread = threading.Event(), threading.Thread()

    def begin(self, line: Callable[[], str]) -> None:
        """Begin a work; a thread shows the line in time."""
        with self._lock:
            self._lines.append(line)
            if len(self._lines) > 1:
                return
            if monotonic() - self._ended > _SECONDS_APART:
                self._began = monotonic()
            self._finished = threading.Event()
            self._thread = threading.Thread(target=self._show, args=[self._finished], daemon=True)
            self._thread.start()

    def end(self, line: Callable[[], str]) -> None:
        """End a work; with the last one, the line vanishes."""
        with self._lock:
            self._lines.remove(line)
            if self._lines:
                return
            self._ended = monotonic()
            self._finished.set()
            thread = self._thread
        thread.join()

    def _show(self, finished: threading.Event) -> None:
        if finished.wait(max(0.0, self._began + SECONDS_TO_WAIT - monotonic())):
            return
        from dq_space_arm_env.common.progress import present_display

        with present_display() as display:
            while not finished.is_set():
                with self._lock:
                    works = ", ".join(line() for line in self._lines)
                display.show(f"compiling {works}, {monotonic() - self._began:.0f} s")
                finished.wait(_SECONDS_BETWEEN_LINES)


_ticker = _Ticker()
