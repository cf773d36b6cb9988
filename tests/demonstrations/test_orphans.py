"""A worker whose parent has been killed ends by itself, though its standard input stays open."""

import os
import pickle
import subprocess
import sys

import pytest

from dq_space_arm_env.common.worker_process import BEGIN


@pytest.mark.skipif(os.name == "nt", reason="POSIX processes")
def test_an_orphan_ends() -> None:
    nobody = os.getpid() + 1  # any process but the worker's parent
    worker = subprocess.Popen(
        [sys.executable, "-c", BEGIN, str(nobody), *sys.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert worker.wait(timeout=30.0) == 1
    finally:
        worker.kill()
        worker.communicate()


def test_an_answer_that_nobody_takes_leaves_no_traceback() -> None:
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    worker = subprocess.Popen([sys.executable, "-c", BEGIN, str(os.getpid()), *sys.path], **pipes)
    worker.stdout.close()
    _, errors = worker.communicate(pickle.dumps((abs, (-1,))), timeout=30.0)
    assert (worker.returncode, errors) == (0, b"")
