"""Rows of a batch shared among threads, such that a slow thread never holds up a fast one.

The calling thread works too, and takes blocks of rows until none is left; helpers take blocks when the
operating system lets them run. A helper that has not begun by then is called off instead of waited for, and
the wait for a block under way is passive: with one core taken by another process, two threads cost little
more than one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from itertools import count

# Rows that a thread takes at a time, a multiple of every vector width: some tens of microseconds of work,
# beside which taking a block is small.
_BLOCK = 256
# Rows for each thread below which waking it costs more than it can do.
_ROWS_PER_THREAD = 1024

KernelFunction = Callable[[int, int, int], None]


@cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="dq-space-arm")


def run_shared(function: KernelFunction, rows: int, buffers: int, threads: int = 1) -> None:
    """Run a kernel on rows 0 .. rows - 1.

    Args:
        function: Kernel; releases the interpreter while it runs.
        rows: Number of rows.
        buffers: Address of the addresses of the kernel's arrays.
        threads: Most threads to use, this one included; small batches use fewer.
    """
    if threads == 1 or rows < 2 * _ROWS_PER_THREAD:
        function(0, rows, buffers)
        return
    threads = min(threads, rows // _ROWS_PER_THREAD)
    blocks = math.ceil(rows / _BLOCK)
    tickets = count()

    def work() -> None:
        # `next` on a counter is atomic.
        while (block := next(tickets)) < blocks:
            function(block * _BLOCK, min(rows, (block + 1) * _BLOCK), buffers)

    helpers: list[Future[None]] = [_helpers(threads).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()
