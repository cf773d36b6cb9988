"""Timing: wall-clock time per state, the best and the median of several samples.

The samples of all cases take turns, so that a disturbance of the machine does not fall on one of them alone.
On a shared machine the best says what the code can do, and a median far above it that the machine was busy.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

OURS = "dq-space-arm"
DYNAMICS, STEP, ENVIRONMENT = "forward dynamics", "step", "environment step"
FLOAT64, FLOAT32 = "float64", "float32"


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is timed.

    Attributes:
        what: DYNAMICS, STEP or ENVIRONMENT.
        engine: Who computes it.
        way: How it is called.
        integrator: Name of the integrator; empty for dynamics.
        batch: States that a call handles; a call of several steps handles a state once per step.
        precision: Name of the floating-point type.
        threads: Number of threads.
        operations: Arithmetic operations per state, a multiply-add counting as two; None if not known.
    """

    what: str
    engine: str
    way: str
    integrator: str = ""
    batch: int = 1
    precision: str = FLOAT64
    threads: int = 1
    operations: int | None = None


@dataclass(frozen=True)
class Case:
    """Something to time.

    Attributes:
        subject: What it is.
        run: Does it.
        period: Calls after which the work repeats; a sample is a multiple of it.
    """

    subject: Subject
    run: Callable[[], object]
    period: int = 1


@dataclass(frozen=True, kw_only=True)
class Timing(Subject):
    """Time of a case, per state.

    Attributes:
        best_ns: Shortest sample, ns per state.
        median_ns: Median of the samples, ns per state.
    """

    best_ns: float
    median_ns: float

    @property
    def states_per_second(self) -> float:
        """States per second in the shortest sample."""
        return 1e9 / self.best_ns

    @property
    def operations_per_ns(self) -> float | None:
        """Arithmetic operations per ns in the shortest sample; None if their number is not known."""
        return None if self.operations is None else self.operations / self.best_ns


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        batch_sizes: States per call.
        repeats: Samples of each case.
        sample_seconds: Shortest duration of a sample, s.
    """

    batch_sizes: tuple[int, ...] = (1, 8, 64, 256, 1024, 4096, 16384)
    repeats: int = 9
    sample_seconds: float = 0.02


QUICK = Effort((1, 64, 1024), repeats=3, sample_seconds=0.002)


def time_cases(cases: Sequence[Case], effort: Effort) -> list[Timing]:
    """Time cases, each warmed up, in turns.

    Args:
        cases: What to time.
        effort: How much to measure.

    Returns:
        Their times, in the same order.
    """
    calls = []
    for case in cases:
        case.run()
        once = max(_seconds(case.run, 1), 1e-9)
        calls.append(case.period * math.ceil(effort.sample_seconds / once / case.period))
    samples: list[list[float]] = [[] for _ in cases]
    for _ in range(effort.repeats):
        for case, count, times in zip(cases, calls, samples, strict=True):
            case.run()  # the cases before have filled the processor's caches
            times.append(1e9 * _seconds(case.run, count) / (count * case.subject.batch))
    return [
        Timing(**vars(case.subject), best_ns=min(times), median_ns=float(np.median(times)))
        for case, times in zip(cases, samples, strict=True)
    ]


def _seconds(run: Callable[[], object], calls: int) -> float:
    """Duration of some calls without the garbage collector, as `timeit` does it."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        start = time.perf_counter()
        for _ in range(calls):
            run()
        return time.perf_counter() - start
    finally:
        if collecting:
            gc.enable()


def select(timings: Iterable[Timing], **wanted: object) -> list[Timing]:
    """Pick timings.

    Args:
        timings: Times.
        **wanted: Attributes of `Subject` and their values.

    Returns:
        Those that have all these values.
    """
    return [
        timing for timing in timings if all(getattr(timing, name) == value for name, value in wanted.items())
    ]


def fastest(timings: Iterable[Timing], **wanted: object) -> Timing | None:
    """Pick a timing.

    Args:
        timings: Times.
        **wanted: Attributes of `Subject` and their values.

    Returns:
        The fastest of those that have all these values; None if there is none.
    """
    return min(select(timings, **wanted), key=lambda timing: timing.best_ns, default=None)
