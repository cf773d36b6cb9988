"""Statistics of evaluations against numbers that were worked out by hand, and against SciPy."""

import math

import numpy as np
import pytest
from scipy.stats import binomtest, trim_mean

from agents.evaluation import bootstrap_interval, compare_runs, interquartile_mean, wilson_interval


def test_wilsons_interval_of_a_half():
    """Of 8 in 16, with z = 1.96: center 1/2, half width z sqrt(1/64 + z^2/1024) / (1 + z^2/16) = 0.2200."""
    rate, low, high = wilson_interval(8, 16)
    assert rate == 0.5
    assert low == pytest.approx(0.2800, abs=5e-5)
    assert high == pytest.approx(0.7200, abs=5e-5)


@pytest.mark.parametrize(
    ("successes", "trials"), [(0, 1), (0, 500), (3, 7), (475, 500), (499, 500), (500, 500)]
)
def test_wilsons_interval_is_scipys(successes, trials):
    expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    rate, low, high = wilson_interval(successes, trials)
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-12)
    assert low <= rate <= high


def test_the_interquartile_mean_leaves_out_a_quarter_on_either_side():
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -100.0]) == 3.5
    assert interquartile_mean([[1.0, 2.0], [4.0, 1000.0]]) == 3.0
    assert interquartile_mean([1.0, 2.0, 6.0]) == 3.0  # a quarter of three is none
    assert math.isnan(interquartile_mean([]))
    values = np.random.default_rng(0).standard_normal(103)
    assert interquartile_mean(values) == pytest.approx(trim_mean(values, 0.25), abs=1e-14)


def test_a_bootstrap_interval_of_the_mean_is_that_of_the_normal_distribution():
    values = np.random.default_rng(1).standard_normal(400)
    mean, low, high = bootstrap_interval(values, lambda sample: float(np.mean(sample)))
    assert mean == pytest.approx(values.mean())
    half = 1.96 * values.std() / 20.0
    assert (low - mean, high - mean) == pytest.approx((-half, half), rel=0.1)
    assert all(math.isnan(bound) for bound in bootstrap_interval([], np.median))


def test_runs_that_agree_have_an_interval_of_their_starts_alone():
    """Three times the same 300 successes in 400: that is no more than 400 trials."""
    success = np.arange(400) < 300
    rate, low, high = compare_runs([success] * 3, [np.zeros(400)] * 3).success_rate
    half = 1.96 * math.sqrt(0.75 * 0.25 / 400)
    assert rate == 0.75
    assert (low - rate, high - rate) == pytest.approx((-half, half), rel=0.1)


def test_runs_that_differ_widen_the_interval():
    """One of three runs fails altogether: a resample of it alone, 1 in 27, makes the rate zero."""
    always, never = np.ones(400, dtype=bool), np.zeros(400, dtype=bool)
    rate, low, high = compare_runs([always, always, never], [np.zeros(400)] * 3).success_rate
    assert rate == pytest.approx(2 / 3)
    assert (low, high) == (0.0, 1.0)


def test_gaps_of_unknown_optima_are_left_out_in_all_runs():
    gaps = [np.array([0.1, np.nan, 0.3, 0.2, 0.2]), np.array([0.1, 9.0, 0.3, 0.2, 0.2])]
    runs = compare_runs([np.ones(5)] * 4, gaps * 2)
    assert runs.cost_gap.value == pytest.approx(0.2)
    assert 0.1 <= runs.cost_gap.low <= runs.cost_gap.high <= 0.3


def test_impossible_counts_and_too_few_or_unequal_runs_are_refused():
    for successes, trials in ((-1, 5), (6, 5), (0, 0)):
        with pytest.raises(ValueError, match="successes of"):
            wilson_interval(successes, trials)
    with pytest.raises(ValueError, match=r"2 training runs .* should be at least 3"):
        compare_runs([np.ones(4)] * 2, [np.ones(4)] * 2)
    with pytest.raises(ValueError, match=r"runs have \[4, 5\] episodes"):
        compare_runs([np.ones(4), np.ones(5), np.ones(4)], [np.ones(4)] * 3)
