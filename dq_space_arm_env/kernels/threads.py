"""Rows of a batch shared among threads, such that a slow thread never delays a fast one.

The calling thread works too and takes blocks of rows until none is left; helpers take blocks when the
operating system schedules them. A helper that has not started by then is cancelled instead of awaited, and
the wait for a block in progress is passive: with one core taken by another process, two threads cost little
more than one.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from itertools import count

# Rows that a thread takes at a time, a multiple of every vector width: some tens of microseconds of work,
# beside which taking a block is small.
_BLOCK = 256
# Blocks for each thread too few to be worth waking a thread.
_BLOCKS_PER_THREAD = 4

KernelFunction = Callable[[int, int, int], None]


@cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="dq-space-arm")


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork: the child's work would pile up in a queue that nobody empties.
    os.register_at_fork(after_in_child=_helpers.cache_clear)


def run_shared(function: KernelFunction, rows: int, buffers: int, threads: int = 1) -> None:
    """Run a kernel, which releases the interpreter, on rows 0 .. rows - 1 of `buffers`."""
    if threads == 1 or rows < 2 * _BLOCKS_PER_THREAD * _BLOCK:
        function(0, rows, buffers)
    else:
        share_rows(lambda begin, end: function(begin, end, buffers), rows, threads)


def share_rows(work_on: Callable[[int, int], None], rows: int, threads: int, block: int = _BLOCK) -> None:
    """Share rows 0 .. rows - 1 among at most `threads` threads, this one included, in blocks.

    `work_on(begin, end)` releases the interpreter; a block should take some tens of microseconds.
    """
    threads = min(threads, rows // (_BLOCKS_PER_THREAD * block))
    if threads <= 1:
        work_on(0, rows)
        return
    blocks = math.ceil(rows / block)
    tickets = count()

    def work() -> None:
        # `next` on a counter is atomic.
        while (ticket := next(tickets)) < blocks:
            work_on(ticket * block, min(rows, (ticket + 1) * block))

    helpers = _begin(work, threads)
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()


def _begin(work: Callable[[], None], threads: int) -> list[Future[None]]:
    """Hand work to helpers, to fewer where the system starts no more threads or the interpreter is ending."""
    pool, begun = _helpers(threads), []
    try:
        for _ in range(threads - 1):
            begun.append(pool.submit(work))
    except RuntimeError:
        # The refused work is in the queue all the same: let nobody begin it after the arrays are gone.
        pool.shutdown(cancel_futures=True)
        _helpers.cache_clear()
    return [helper for helper in begun if not helper.cancelled()]
