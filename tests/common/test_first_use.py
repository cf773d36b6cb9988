"""What is said while code is compiled: a line on a terminal, a message for each scene, or nothing."""

import gc
import io
import logging
import re
import time
from collections.abc import Iterator
from contextlib import redirect_stderr

import pytest
from rich.console import Console

from dq_space_arm_env.common import first_use
from dq_space_arm_env.common.progress import ProgressDisplay


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def shown(self) -> str:
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|[\r\n]", " ", self.getvalue())


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    stream = Terminal()
    logger = first_use._logger()
    level = logger.level
    logger.setLevel(logging.INFO)  # reports and benchmarks in the same process raise it
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(first_use, "SECONDS_TO_WAIT", 0.05)
    monkeypatch.setattr(first_use, "_ticker", first_use._Ticker())
    monkeypatch.setattr(first_use, "_announced", set())
    yield stream
    logger.setLevel(level)


def wait(terminal: Terminal) -> None:
    outer, inner = "scene 'paper' (3 of 9 functions)", "backward_pass of the solver"
    with redirect_stderr(terminal), first_use.compiling(lambda: outer), first_use.compiling(lambda: inner):
        time.sleep(0.3)


def test_who_waits_sees_what_is_compiled_and_for_how_long(terminal: Terminal) -> None:
    wait(terminal)
    line = "compiling scene 'paper' (3 of 9 functions), backward_pass of the solver, 0 s"
    assert line in terminal.shown()
    assert terminal.getvalue().endswith("\x1b[2K")  # the line is erased


def test_a_process_without_standard_error_compiles_in_silence(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_use.sys, "stderr", None)
    first_use.announce("scene 'paper'")
    with first_use.compiling(lambda: "step of scene 'paper'"):
        pass


def test_the_collector_is_paused_meanwhile_and_goes_on_after_an_error() -> None:
    was_on = []

    def fail() -> None:
        with first_use.compiling(lambda: "step of scene 'paper'"):
            with first_use.compiling(lambda: "linearize of scene 'paper'"):
                was_on.append(gc.isenabled())
            was_on.append(gc.isenabled())
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert was_on == [False, False]
    assert gc.isenabled()


def test_a_short_wait_and_a_file_show_nothing(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_use, "SECONDS_TO_WAIT", 30.0)
    wait(terminal)
    monkeypatch.setattr(first_use, "SECONDS_TO_WAIT", 0.05)
    monkeypatch.setattr(terminal, "isatty", lambda: False)
    wait(terminal)
    assert terminal.getvalue() == ""


def test_short_works_in_a_row_are_one_wait(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_use, "SECONDS_TO_WAIT", 0.5)
    for name in "abcdefgh":
        with redirect_stderr(terminal), first_use.compiling(lambda name=name: name):  # type: ignore[misc]
            time.sleep(0.1)
    assert "compiling" in terminal.shown()


def test_the_progress_of_a_run_shows_the_line(terminal: Terminal) -> None:
    console = Console(file=Terminal(), width=100, force_terminal=True)
    with ProgressDisplay(console, bar=False):
        wait(terminal)
    assert "backward_pass of the solver" in console.file.getvalue()  # type: ignore[attr-defined]
    assert terminal.getvalue() == ""


def test_the_level_of_the_logger_silences_both(terminal: Terminal) -> None:
    first_use._logger().setLevel(logging.WARNING)
    wait(terminal)
    with redirect_stderr(terminal):
        first_use.announce("scene 'paper'")
    assert terminal.getvalue() == ""


def test_there_is_one_message_for_a_scene_and_its_solver(terminal: Terminal) -> None:
    with redirect_stderr(terminal):
        for _ in range(2):
            first_use.announce("scene 'paper'")
            first_use.announce("the solver", if_first=True)
    assert terminal.getvalue().count("\n") == 1
    assert (
        "compiling what is used of scene 'paper' for the first time, mostly under a minute"
        in terminal.getvalue()
    )
