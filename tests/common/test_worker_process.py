"""What fails in another process is raised in this one, and no worker seems lost for it."""

import os
import shlex
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path
from types import ModuleType

import pytest

from dq_space_arm_env.common.worker_process import WorkerProcess


class TwoWordsError(Exception):
    """Unpickling calls it with one."""

    def __init__(self, file: str, line: int) -> None:
        super().__init__(f"{file}:{line}")


class HoldingError(ValueError):
    """It holds what no other process can have."""

    def __init__(self) -> None:
        super().__init__("held")
        self.lock = threading.Lock()


def two_words() -> None:
    raise TwoWordsError("a.npz", 3)


def holding() -> None:
    raise HoldingError


def test_what_cannot_be_sent_comes_in_words_and_the_worker_goes_on() -> None:
    with closing(WorkerProcess()) as worker:
        for function, words in ((two_words, r"^TwoWordsError: a\.npz:3"), (holding, "^HoldingError: held")):
            worker.assign(function)
            with pytest.raises(RuntimeError, match=words) as caught:
                worker.answer()
            assert any(f"in {function.__name__}" in note for note in caught.value.__notes__)
        worker.assign(threading.Lock)
        with pytest.raises(TypeError, match="cannot pickle"):
            worker.answer()
        worker.assign(int, "three")
        with pytest.raises(ValueError, match="'three'"):
            worker.answer()
        worker.assign(abs, -3)
        assert worker.answer() == 3


def test_files_of_the_present_folder_are_no_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "signal.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    with closing(WorkerProcess()) as worker:
        worker.assign(abs, -3)
        assert worker.answer() == 3


@pytest.mark.skipif(os.name == "nt", reason="POSIX shells")
def test_a_process_without_standard_error_has_workers() -> None:
    program = (
        "from dq_space_arm_env.common.worker_process import WorkerProcess\n"
        "from dq_space_arm_env.command_line.verb_program import _replace_closed_streams\n"
        "for _ in range(2):\n"
        "    worker = WorkerProcess()\n"
        "    worker.assign(abs, -3)\n"
        "    print(worker.answer())\n"
        "    worker.close()\n"
        "    _replace_closed_streams()\n"
    )
    command = ["sh", "-c", f"exec {shlex.quote(sys.executable)} -c {shlex.quote(program)} 2>&-"]
    assert subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout == b"3\n3\n"


def test_a_function_that_is_here_alone_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("only_here")
    exec("def work(): pass", module.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", module)
    with closing(WorkerProcess()) as worker:
        worker.assign(module.work)
        with pytest.raises(ModuleNotFoundError, match="only_here"):
            worker.answer()
