"""A process that makes shards for another: tasks come in by standard input, shards go out by standard output.

Each worker has pipes of its own. So one that is killed in the middle of an answer leaves nobody waiting for
the rest of it, as a queue that is shared by several would.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import traceback
from time import sleep

from experts.demonstrations.shard import ShardResult, Task, make_shard

# Ctrl-C is the parent's affair. The package is found where the parent has found it.
_BEGIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); sys.path[:] = sys.argv[2:]; "
    "from experts.demonstrations.worker import serve; serve(int(sys.argv[1]))"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkerLost(Exception):  # noqa: N818 - what happened to it, in the words of who waits for it
    """A worker has ended before its answer."""


class Worker:
    """A process, as its parent sees it.

    Attributes:
        task: What it is at work on.
    """

    def __init__(self, task: Task) -> None:
        """Start the process.

        Args:
            task: Its first task.
        """
        self._process = subprocess.Popen(
            [sys.executable, "-c", _BEGIN, str(os.getpid()), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        self.assign(task)

    def fileno(self) -> int:
        """Descriptor that becomes readable when the worker answers, or ends."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def assign(self, task: Task) -> None:
        """Give it something to do.

        Args:
            task: What.
        """
        assert self._process.stdin is not None
        self.task = task
        with contextlib.suppress(BrokenPipeError):  # who waits for the answer will notice
            pickle.dump(task, self._process.stdin)
            self._process.stdin.flush()

    def answer(self) -> ShardResult:
        """Wait for the shard.

        Returns:
            The shard.

        Raises:
            WorkerLost: If the process has ended.
            Exception: Whatever making the shard has raised.
        """
        assert self._process.stdout is not None
        try:
            answer = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as error:
            raise WorkerLost from error
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, ShardResult)
        return answer

    def end(self) -> None:
        """End the process at once, whatever it is doing."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                if pipe is not None:
                    pipe.close()
        self._process.wait()


def serve(parent: int) -> None:
    """Work for a parent until it wants no more, or is no more.

    Args:
        parent: Its process id.
    """

    def watch() -> None:
        while os.getppid() == parent:
            sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    tasks = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever is printed is no answer
    with answers:
        while True:
            try:
                task = pickle.load(tasks)
            except EOFError:
                return
            answer: ShardResult | Exception
            try:
                answer = make_shard(task)
            except Exception as error:
                error.add_note("".join(traceback.format_exception(error)))
                answer = error
            pickle.dump(answer, answers)
            answers.flush()
            del answer  # before the next one needs its memory
