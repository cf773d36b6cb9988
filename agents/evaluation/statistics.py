"""Statistics of evaluations: intervals for rates and medians, and aggregates over training runs.

All runs fly from the same starts, so a mean over runs and starts has two sources of error: the runs drawn and
the starts drawn. Both variances are estimated as in a two-way analysis of variance, and Student's t accounts
for the small number of runs. A bootstrap over runs does not: its intervals cover too little. On the need for
intervals see Agarwal et al. (NeurIPS 2021, arXiv:2108.13264), on their coverage with few runs Jordan et al.
(ICML 2024, arXiv:2406.16241).

Policies must be evaluated without SciPy, a hundred megabytes for a few formulas; the tests compare with it.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
RESAMPLES = 2000
"""Resamples of a bootstrap: enough for bounds within a few per cent of the interval's width."""
FEWEST_RUNS = 3
"""Training runs below which a result describes a seed rather than an algorithm."""

TIE = 1e-6
"""Relative difference of costs below which neither is lower."""

_NORMAL_QUANTILE = 1.959963984540054  # of CONFIDENCE, two-sided


class Interval(NamedTuple):
    """An estimate and its 95 % confidence interval; its bounds are NaN where too few values tell none."""

    value: float
    low: float
    high: float


class Runs(NamedTuple):
    """Aggregates over training runs of one agent with different seeds."""

    success_rate: Interval  # mean over runs and episodes
    cost_gap: Interval  # interquartile mean over runs and episodes


def wilson_interval(successes: int, trials: int) -> Interval:
    """Wilson's score interval of a rate, which holds near 0 and 1 too (Wilson, JASA 1927)."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials: should be 0 <= successes <= trials > 0")
    return _score_interval(successes / trials, trials, _NORMAL_QUANTILE)


def _score_interval(rate: float, n: float, z: float) -> Interval:
    """Wilson's interval for a quantile z."""
    center = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At rates of 0 and 1 one bound equals the rate; guard against rounding.
    return Interval(rate, min(rate, max(0.0, center - half)), max(rate, min(1.0, center + half)))


def bootstrap_interval(
    values: ArrayLike, statistic: Callable[[FloatArray], float], *, share: float = 0.5, seed: int = 0
) -> Interval:
    """Percentile bootstrap of a statistic of independent values; NaN without values.

    The statistic has a share of the distribution below it. No bootstrap leaves the range of the values, which
    holds it in 95 % of all samples from `fewest_values` on; bounds are NaN before.
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.size < fewest_values(share):
        return Interval(statistic(sample) if sample.size else math.nan, math.nan, math.nan)
    rng = np.random.default_rng(seed)
    resamples = [statistic(sample[rng.integers(len(sample), size=len(sample))]) for _ in range(RESAMPLES)]
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = percentiles(resamples, [tail, 100.0 - tail])
    return Interval(statistic(sample), float(low), float(high))


def percentiles(values: ArrayLike, shares: ArrayLike) -> FloatArray:
    """Percentiles of values, some of which may be infinite, by their shares [%]; NaN where one is NaN."""
    sample, asked = (np.asarray(each, dtype=np.float64) for each in (values, shares))
    with np.errstate(invalid="ignore"):  # of interpolations from or to an infinite value
        found = np.asarray(np.percentile(sample, asked))
    if np.isnan(found).any():
        found = np.where(np.isnan(found), np.percentile(sample, asked, method="higher"), found)
    return found


def fewest_values(share: float) -> int:
    """Number of values whose range holds a quantile in 95 % of all samples: 6 for the median."""
    # It does not where all values lie below the quantile, or all above it.
    return next(n for n in count(1) if share**n + (1.0 - share) ** n <= 1.0 - CONFIDENCE)


def interquartile_mean(values: ArrayLike) -> float:
    """Mean without the lowest and highest quarter: robust as the median, and statistically more efficient.

    NaN without values, and where one is NaN.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    if ordered.size == 0 or np.isnan(ordered[-1]):  # the last one if any, which would count as the largest
        return math.nan
    cut = ordered.size // 4
    return float(np.mean(ordered[cut : ordered.size - cut]))


def rate_over_runs(scores: ArrayLike) -> Interval:
    """Mean of scores over runs and starts, with an interval in [0, 1] for other runs from other starts.

    It is Wilson's with the number of independent trials that would have the variance found (the effective
    sample size of Korn and Graubard, Survey Methodology 1998). Where that is zero, all runs count as one.

    Args:
        scores: Successes or shares in [0, 1], shape (runs, starts), or (runs, runs of another, starts).

    Raises:
        ValueError: If there is no score, or one is not in [0, 1].
    """
    values = np.asarray(scores, dtype=np.float64)
    if values.size == 0 or values.ndim == 0:
        raise ValueError(f"scores have shape {values.shape}: should be at least one run and one start")
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise ValueError(f"scores from {values.min()} to {values.max()}: should be in [0, 1]")
    rate, variance, quantile = _crossed(values)
    n = float(values.shape[-1]) if variance == 0.0 else min(values.size, rate * (1.0 - rate) / variance)
    return _score_interval(rate, n, quantile)


def compare_runs(successes: Sequence[ArrayLike], gaps: Sequence[ArrayLike]) -> Runs:
    """Aggregate training runs that differ in their seeds.

    Args:
        successes: Success of each episode: for each run, shape (n,), the same starts in all runs.
        gaps: Cost gaps likewise; NaN where the optimal cost is unknown.

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
    return Runs(rate_over_runs(np.array(successes)), gap_over_runs(gaps))


def gap_over_runs(gaps: Sequence[ArrayLike]) -> Interval:
    """Interquartile mean of cost gaps over runs and starts, with an interval for other runs and starts.

    Where it is infinite, the bounds are NaN.

    Args:
        gaps: Cost gaps of each run, shape (n,), the same starts in all runs; NaN where unknown.

    Raises:
        ValueError: If they have another shape.
    """
    gap = _known(gaps)
    if gap.size == 0:
        return Interval(math.nan, math.nan, math.nan)
    # The variance of a trimmed mean is that of its winsorized values (Tukey and McLaughlin, Sankhya 1963).
    middle = interquartile_mean(gap)
    if gap.size == 1 or not math.isfinite(middle):
        return Interval(middle, math.nan, math.nan)
    if np.isfinite(gap).all():
        low, high = np.quantile(gap, [0.25, 0.75])
    else:  # those between an infinite gap and another are infinite
        ordered, cut = np.sort(gap, axis=None), gap.size // 4
        low, high = ordered[cut], ordered[gap.size - 1 - cut]
    _, variance, quantile = _crossed(2.0 * np.clip(gap, low, high))
    half = quantile * math.sqrt(variance)
    return Interval(middle, middle - half, middle + half)


def probability_of_improvement(costs: ArrayLike, others: ArrayLike) -> Interval:
    """Probability that a flight costs less than one of another agent from the same start (Agarwal et al.).

    All runs of one meet all runs of the other, start by start; equal costs count half.

    Args:
        costs: J of the flights, shape (runs, n), dimensionless; NaN counts as infinite.
        others: J of the other agent from the same starts, shape (its runs, n), dimensionless.

    Raises:
        ValueError: If a shape is another, or the numbers of starts differ or are zero.
    """
    found = (_by_run(each, "costs") for each in (costs, others))
    mine, theirs = (np.where(np.isnan(each), np.inf, each) for each in found)
    if mine.shape[-1] != theirs.shape[-1]:
        raise ValueError(f"flights from {mine.shape[-1]} and {theirs.shape[-1]} starts: should be the same")
    mine, theirs = mine[:, None], theirs[None]
    return rate_over_runs(np.where(np.isclose(mine, theirs, rtol=TIE, atol=0.0), 0.5, mine < theirs))


def performance_profile(gaps: Sequence[ArrayLike], thresholds: ArrayLike) -> list[Interval]:
    """Share of flights whose cost gap is at most each threshold (Agarwal et al.); none if no gap is known.

    Args:
        gaps: Cost gaps of each run, shape (n,), the same starts in all runs; NaN where unknown.
        thresholds: Cost gaps, shape (k,), dimensionless.

    Raises:
        ValueError: If the gaps have another shape.
    """
    known = _known(gaps)
    return [rate_over_runs(known <= threshold) for threshold in np.asarray(thresholds)] if known.size else []


@cache
def student_quantile(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t with a number of degrees of freedom, at least 1."""
    # With t = sqrt(freedom) tan(angle) the density is proportional to a power of the cosine.
    angle = np.linspace(0.0, min(0.5 * math.pi, 12.0 / math.sqrt(freedom)), 4001)
    density = np.cos(angle) ** (freedom - 1)
    below = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return math.sqrt(freedom) * math.tan(float(np.interp(CONFIDENCE * below[-1], below, angle)))


def _known(gaps: Sequence[ArrayLike]) -> FloatArray:
    """Gaps (runs, starts) from the starts whose gap is known in all runs."""
    values = _by_run(gaps, "gaps")
    return values[:, ~np.isnan(values).any(axis=0)]


def _by_run(values: ArrayLike | Sequence[ArrayLike], name: str) -> FloatArray:
    """Numbers of shape (runs, starts); ValueError for another shape."""
    found = np.array(values, dtype=np.float64)
    if found.ndim != 2:
        raise ValueError(f"{name}: shape {found.shape}, should be (runs, starts): put one run into a list")
    return found


def _crossed(scores: FloatArray) -> tuple[float, float, float]:
    """Mean of scores, its variance where every axis is a random draw, and the quantile for its interval.

    Each axis adds the variance of its means, with its own Student's t, so that the interval never covers too
    little (Banerjee, Sankhya 1960). The residual is in all of them and is counted once; an axis of one adds
    nothing.
    """
    mean, axes = float(np.mean(scores)), [axis for axis, size in enumerate(scores.shape) if size > 1]
    residual, variances, squares = scores - mean, [], []
    for axis in axes:
        others = tuple(other for other in range(scores.ndim) if other != axis)
        effect, freedom = np.mean(scores, axis=others, keepdims=True) - mean, scores.shape[axis] - 1
        residual = residual - effect
        variances.append(float(np.sum(effect**2)) / (freedom * (freedom + 1)))
        squares.append(student_quantile(freedom) ** 2 * variances[-1])
    left = scores.size - 1 - sum(scores.shape[axis] - 1 for axis in axes)
    noise = float(np.sum(residual**2)) / (left * scores.size) if left > 0 else 0.0
    twice = (len(axes) - 1) * noise
    variance = max(sum(variances) - twice, *variances, 0.0)
    if variance == 0.0:
        return mean, 0.0, _NORMAL_QUANTILE
    square = max(sum(squares) - _NORMAL_QUANTILE**2 * twice, *squares)
    return mean, variance, math.sqrt(square / variance)
