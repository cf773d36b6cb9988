"""A worker whose parent has been killed ends by itself, though its standard input stays open."""

import os
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
