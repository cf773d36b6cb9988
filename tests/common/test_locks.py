"""Locks exclude others, and end with the process that holds them, whatever it has started."""

import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from dq_space_arm_env.common.locks import locked

TAKEN = RuntimeError("taken")


def test_a_lock_excludes_other_threads_and_ends_with_the_block(tmp_path: Path) -> None:
    outcomes: list[str] = []

    def attempt() -> None:
        try:
            with locked(tmp_path / "lock", TAKEN):
                outcomes.append("held")
        except RuntimeError as error:
            outcomes.append(str(error))

    with locked(tmp_path / "lock", TAKEN):
        attempt()
        thread = threading.Thread(target=attempt)
        thread.start()
        thread.join()
    attempt()
    assert outcomes == ["taken", "taken", "held"]


def test_one_can_wait_for_a_lock(tmp_path: Path) -> None:
    waiting = threading.Event()

    def follow() -> None:
        waiting.set()
        with locked(tmp_path / "lock", TAKEN, seconds=-1.0):
            waiting.clear()

    with locked(tmp_path / "lock", TAKEN):
        follower = threading.Thread(target=follow)
        follower.start()
        waiting.wait()
    follower.join(10.0)
    assert not waiting.is_set()


HOLDER = """
import multiprocessing, subprocess, sys, time
from pathlib import Path
from dq_space_arm_env.common.locks import locked

def work(started):
    started.set()
    time.sleep(600.0)

if __name__ == "__main__":
    with locked(Path(sys.argv[1]), RuntimeError()):
        if sys.argv[2] == "command":
            sleep = [sys.executable, "-c", "import time; time.sleep(600.0)"]
            child = subprocess.Popen(sleep, close_fds=False)
        else:
            context = multiprocessing.get_context(sys.argv[2])
            started = context.Event()
            child = context.Process(target=work, args=(started,), daemon=True)
            child.start()
            started.wait()
        print(child.pid, flush=True)
        sys.stdin.read()
"""


@pytest.mark.skipif(os.name == "nt", reason="needs kill and fork")
@pytest.mark.parametrize("start", ["fork", "spawn", "command"])
def test_a_killed_process_keeps_no_lock_though_its_workers_live_on(tmp_path: Path, start: str) -> None:
    if start not in (*multiprocessing.get_all_start_methods(), "command"):
        pytest.skip(f"no {start} here")
    script, lock = tmp_path / "holder.py", tmp_path / "lock"
    script.write_text(HOLDER)
    command = [sys.executable, str(script), str(lock), start]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as holder:
        assert holder.stdout is not None
        worker = int(holder.stdout.readline())
        try:
            with pytest.raises(RuntimeError, match="taken"), locked(lock, TAKEN):
                pass
            holder.kill()
            holder.wait()
            os.kill(worker, 0)  # it lives
            with locked(lock, TAKEN):
                pass
        finally:
            os.kill(worker, 9)


WITHOUT_POSIX = """
import importlib, pkgutil, sys
MISSING = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
sys.modules |= dict.fromkeys(MISSING)  # importing them fails
failed = {}
for package in ("dq_space_arm_env", "experts", "agents"):
    for module in pkgutil.walk_packages([sys.argv[1] + "/" + package], package + "."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            if error.name in MISSING:
                failed[module.name] = str(error)
print(failed)
"""


@pytest.mark.slow
def test_every_module_imports_without_the_modules_of_posix() -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", WITHOUT_POSIX, str(root)]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "{}"
