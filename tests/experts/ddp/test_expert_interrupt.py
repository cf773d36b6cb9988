"""Ctrl-C during a solve: the process survives and returns the best trajectory so far."""

import os
import signal
import subprocess
import sys
import time

import pytest

SOLVE = """
import signal
from experts import BoxDDP
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job inherits that it is ignored
solver = BoxDDP("six-joint", max_iterations=1_000_000, tolerance=0.0, plateau_decrease=0.0)
started = []
def announce(record):
    if not started:
        print("solving", flush=True)
        started.append(record)
solution = solver.solve(callback=announce)
print(solution.stop_reason.value, solution.iterations > 0, solution.cost > 0.0)
"""


@pytest.mark.sampled
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("delay", [0.02, 0.05, 0.11, 0.17])
def test_a_real_interrupt_ends_the_solve_with_its_best_trajectory(delay):
    process = subprocess.Popen([sys.executable, "-c", SOLVE], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "solving\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert output == "interrupted True True\n"
