"""Work shared among threads: every row once, the same bits, and no wait for a helper that never ran."""

import os
import sys
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.kernels import threads


@settings(derandomize=True, max_examples=60, deadline=None)
@given(rows=st.integers(0, 6000), count=st.integers(1, 5))
def test_every_row_is_worked_on_once(rows, count):
    done = []
    threads.run_shared(lambda begin, end, buffers: done.append((begin, end, buffers)), rows, 7, count)
    covered = sorted(row for begin, end, _ in done for row in range(begin, end))
    assert covered == list(range(rows))
    assert {buffers for *_, buffers in done} <= {7}


def test_results_are_those_of_one_thread(draw):
    kernels, states, inputs = draw("paper", 3100)
    shared = compile_scene("paper", threads=3)
    assert shared is not kernels
    np.testing.assert_array_equal(shared.step(states, inputs), kernels.step(states, inputs))


def test_a_helper_that_has_not_begun_is_not_waited_for():
    release = threading.Event()
    blocked = threads._helpers(2).submit(release.wait)
    try:
        done = []
        arguments = (lambda *block: done.append(block), 3000, 0, 2)
        worker = threading.Thread(target=threads.run_shared, args=arguments)
        worker.start()
        worker.join(timeout=30)
        assert not worker.is_alive()
        assert sum(end - begin for begin, end, _ in done) == 3000
    finally:
        release.set()
        blocked.result()


def test_a_small_batch_stays_on_one_thread():
    seen = set()
    threads.run_shared(lambda *block: seen.add(threading.current_thread()), 2047, 0, 2)
    assert seen == {threading.current_thread()}


def test_an_error_of_a_helper_is_raised():
    main = threading.current_thread()
    came = threading.Event()

    def function(begin, end, buffers):
        if threading.current_thread() is not main:
            came.set()
            raise MemoryError("in the helper")
        came.wait(timeout=30)  # whichever of the two takes a block first

    with pytest.raises(MemoryError, match="in the helper"):
        threads.run_shared(function, 2048, 0, 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
def test_a_forked_process_starts_helpers_that_run():
    threads.run_shared(lambda *block: None, 3000, 0, 2)
    process = os.fork()
    if process == 0:
        done = []
        threads.run_shared(lambda *block: done.append(block), 3000, 0, 2)
        whole = sum(end - begin for begin, end, _ in done) == 3000
        # Work that nobody takes would pile up, step by step.
        os._exit(0 if whole and threads._helpers(2).submit(lambda: 7).result(timeout=30) == 7 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0


def test_work_is_done_where_no_more_threads_can_be_started(monkeypatch):
    threads._helpers.cache_clear()
    start, started = threading.Thread.start, []

    def start_one(thread):
        if started:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_one)
    for _ in range(2):
        done = []
        threads.run_shared(lambda *block, done=done: done.append(block), 4096, 0, 4)
        assert sorted(block[0] for block in done) == list(range(0, 4096, 256))
        assert not started[0].is_alive()  # nobody works on arrays that the caller may drop


def test_no_thread_at_all_is_refused():
    with pytest.raises(ValueError, match="threads: 0, should be a whole number of at least 1"):
        Kernels(load_scene("paper"), threads=0)
    assert compile_scene("paper", np.int64(1)) is compile_scene("paper")
    for number in (1.0, True):
        with pytest.raises(ValueError, match=f"threads: {number}, should be a whole number of at least 1"):
            compile_scene("paper", threads=number)


def test_threads_that_share_the_kernels_get_their_own_results(draw):
    kernels, states, inputs = draw("paper", 4)
    expected = [kernels.step(x, u) for x, u in zip(states, inputs, strict=True)]
    start, wrong = threading.Barrier(len(states), timeout=30), []

    def work(x, u, result):
        start.wait()
        for _ in range(3000):
            if not np.array_equal(kernels.step(x, u), result):
                wrong.append(x)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # s: between any two instructions of the interpreter
    try:
        workers = [
            threading.Thread(target=work, args=case) for case in zip(states, inputs, expected, strict=True)
        ]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    finally:
        sys.setswitchinterval(interval)
    assert not wrong
