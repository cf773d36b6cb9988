"""A process that works for this one, and may die without taking it along.

A worker has its own pipes, tasks on standard input and answers on standard output: if it is killed in the
middle of an answer, nobody waits for the rest of it, as with a shared queue.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from time import sleep
from typing import Any

# Ctrl-C is left to the parent. The package is imported from where the parent imported it, and nothing from
# the present folder, where a user's `signal.py` is another.
BEGIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); sys.path[:] = sys.argv[2:]; "
    "from dq_space_arm_env.common.worker_process import serve; serve(int(sys.argv[1]))"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

_work = {"is_worker": False}


class WorkerLostError(Exception):
    """A worker ended before its answer."""


class WorkerProcess:
    """A worker, seen from its parent."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Start it; a quiet one has no standard error, where libraries complain when they crash."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", BEGIN, str(os.getpid()), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if quiet or not _has_standard_error() else None,
            env={**os.environ, **_ONE_THREAD},
        )

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the worker answers or ends."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def assign(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Let it call a function of a module."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # noticed where the answer is read
            pickle.dump((function, arguments), self._process.stdin)
            self._process.stdin.flush()

    def answer(self) -> Any:
        """Wait for what the function returns; raise what it has raised, or `WorkerLostError`."""
        assert self._process.stdout is not None
        try:
            answer, error = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as broken:
            raise WorkerLostError from broken
        if error is not None:
            raise error
        return answer

    def close(self) -> None:
        """Kill the process."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                if pipe is not None:
                    pipe.close()
        self._process.wait()


def _has_standard_error() -> bool:
    """Tell whether this process has one, which others inherit."""
    try:
        return os.get_inheritable(2)
    except OSError:
        return False


def become_worker() -> None:
    """Note that this process is one of several that share the machine."""
    _work["is_worker"] = True


def is_worker() -> bool:
    """Tell whether this process is one of several that share the machine."""
    return _work["is_worker"]


def serve(parent: int) -> None:
    """Work for a parent until it closes standard input or exits."""
    become_worker()

    def watch() -> None:
        while os.getppid() == parent:
            sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    tasks = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # prints must not mix with answers
    with contextlib.suppress(BrokenPipeError), answers:  # a parent that was killed takes no answers
        while True:
            try:
                function, arguments = pickle.load(tasks)
            except EOFError:
                return
            except Exception as error:
                answers.write(_sent(error))
                return  # where the next task begins is not known
            try:
                answer = pickle.dumps((function(*arguments), None))
            except Exception as error:
                answer = _sent(error)
            answers.write(answer)
            answers.flush()
            del function, arguments, answer  # frees their memory before the next ones


def _sent(error: Exception) -> bytes:
    """An error as an answer: itself with its traceback, or its words if it would not arrive."""
    origin = "".join(traceback.format_exception(error))
    for sent in (error, RuntimeError(f"{type(error).__name__}: {error}")):
        sent.add_note(origin)
        with contextlib.suppress(Exception):
            answer = pickle.dumps((None, sent))
            pickle.loads(answer)
            break
    return answer
