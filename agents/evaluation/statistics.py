"""Statistics of evaluations: intervals for rates and medians, and aggregates over training runs.

Policies must be evaluated without SciPy, a hundred megabytes for three formulas; the tests compare with it.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
RESAMPLES = 2000
"""Resamples of a bootstrap: enough for bounds within a few per cent of the interval's width."""
FEWEST_RUNS = 3
"""Training runs below which a result describes a seed rather than an algorithm."""

_NORMAL_QUANTILE = 1.959963984540054  # of CONFIDENCE, two-sided


class Interval(NamedTuple):
    """An estimate and its 95 % confidence interval."""

    value: float
    low: float
    high: float


class Runs(NamedTuple):
    """Aggregates over training runs of one agent with different seeds."""

    success_rate: Interval  # of all episodes of all runs
    cost_gap: Interval  # interquartile mean over runs and episodes


def wilson_interval(successes: int, trials: int) -> Interval:
    """Wilson's score interval of a rate, which holds near 0 and 1 too (Wilson, JASA 1927)."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials: should be 0 <= successes <= trials > 0")
    z, n, rate = _NORMAL_QUANTILE, trials, successes / trials
    center = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At rates of 0 and 1 one bound equals the rate; guard against rounding.
    return Interval(rate, min(rate, max(0.0, center - half)), max(rate, min(1.0, center + half)))


def bootstrap_interval(
    values: ArrayLike, statistic: Callable[[FloatArray], float], *, seed: int = 0
) -> Interval:
    """Percentile bootstrap of a statistic of independent values; NaN without values."""
    sample = np.asarray(values, dtype=np.float64)
    if sample.size == 0:
        return Interval(math.nan, math.nan, math.nan)
    rng = np.random.default_rng(seed)
    resamples = [statistic(sample[rng.integers(len(sample), size=len(sample))]) for _ in range(RESAMPLES)]
    return _percentiles(statistic(sample), resamples)


def interquartile_mean(values: ArrayLike) -> float:
    """Mean without the lowest and highest quarter: robust as the median, and statistically more efficient."""
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    if ordered.size == 0:
        return math.nan
    cut = ordered.size // 4
    return float(np.mean(ordered[cut : ordered.size - cut]))


def compare_runs(successes: Sequence[ArrayLike], gaps: Sequence[ArrayLike], *, seed: int = 0) -> Runs:
    """Aggregate training runs that differ in their seeds (after Agarwal et al., NeurIPS 2021).

    Each resample draws whole runs and starts. Episodes of a run share its policy: drawing a run for each
    start anew, as if they were independent, would make three runs look like hundreds.

    Args:
        successes: Success of each episode: for each run, shape (n,), the same starts in all runs.
        gaps: Cost gaps likewise; NaN where the optimal cost is unknown.
        seed: Seed of the resamples.

    Raises:
        ValueError: If there are fewer than 3 runs, or their numbers of episodes differ.
    """
    if len(successes) < FEWEST_RUNS or len(gaps) != len(successes):
        raise ValueError(
            f"{len(successes)} training runs with {len(gaps)} sets of gaps: should be at least "
            f"{FEWEST_RUNS}, with seeds of their own, each with its gaps"
        )
    lengths = {len(np.asarray(run)) for run in (*successes, *gaps)}
    if len(lengths) != 1:
        raise ValueError(f"runs have {sorted(lengths)} episodes: evaluate all of them on the same starts")
    succeeded, gap = (np.array(runs, dtype=np.float64) for runs in (successes, gaps))
    known = ~np.isnan(gap).any(axis=0)
    return Runs(
        _over_runs(succeeded, lambda scores: float(np.mean(scores)), seed),
        _over_runs(gap[:, known], interquartile_mean, seed),
    )


def _over_runs(scores: FloatArray, statistic: Callable[[FloatArray], float], seed: int) -> Interval:
    rng, (runs, starts) = np.random.default_rng(seed), scores.shape
    if starts == 0:
        return Interval(math.nan, math.nan, math.nan)
    resamples = [
        statistic(scores[rng.integers(runs, size=runs)][:, rng.integers(starts, size=starts)])
        for _ in range(RESAMPLES)
    ]
    return _percentiles(statistic(scores), resamples)


def _percentiles(value: float, resamples: Sequence[float]) -> Interval:
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(resamples, [tail, 100.0 - tail])
    return Interval(value, float(low), float(high))
