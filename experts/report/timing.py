"""Wall-clock times: the best and the median of several samples.

Runs take turns, which spreads disturbances over all of them. On a shared machine the best sample shows what
the code can do; a median far above it shows that the machine was busy.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from dq_space_arm_env.common.first_use import collector_paused


class Sample(NamedTuple):
    """Time per call."""

    best_ns: float
    median_ns: float


def time_in_turns(
    runs: Sequence[Callable[[], object]],
    repeats: int,
    sample_seconds: float,
    periods: Sequence[int] | None = None,
) -> list[Sample]:
    """Time runs, each warmed up; a sample holds whole periods of calls, 1 by default."""
    counts = []
    for run, period in zip(runs, periods or [1] * len(runs), strict=True):
        run()
        once = max(_seconds(run, 1), 1e-9)
        counts.append(period * math.ceil(sample_seconds / once / period))
    samples: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, count, times in zip(runs, counts, samples, strict=True):
            run()  # the runs before have filled the processor's caches
            times.append(1e9 * _seconds(run, count) / count)
    return [Sample(min(times), float(np.median(times))) for times in samples]


def _seconds(run: Callable[[], object], calls: int) -> float:
    """Duration of calls without the garbage collector, as in `timeit`."""
    with collector_paused():
        start = time.perf_counter()
        for _ in range(calls):
            run()
        return time.perf_counter() - start


def three_digits(value: float) -> str:
    """Write a time with three digits, or all of them before the point."""
    return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:#.3g}".rstrip(".")
