"""Statistics of evaluations against numbers that were worked out by hand, and against SciPy."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import binomtest, lognorm, norm, t, trim_mean

from agents.evaluation import (
    bootstrap_interval,
    compare_runs,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    rate_over_runs,
    wilson_interval,
)
from agents.evaluation.statistics import fewest_values, gap_over_runs, percentiles, student_quantile


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
    assert math.isnan(interquartile_mean([1.0, math.nan, 2.0, 3.0]))
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


def test_runs_that_differ_are_few():
    """Each run is of one piece: 1, 1 and 0, of variance 1/3, are two trials, with Student's t."""
    always, never = np.ones(400, dtype=bool), np.zeros(400, dtype=bool)
    rate, low, high = compare_runs([always, always, never], [np.zeros(400)] * 3).success_rate
    assert rate == pytest.approx(2 / 3)
    n, z = (2 / 9) / (1 / 9), t.ppf(0.975, 2)
    center, half = rate + z * z / (2 * n), z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    bounds = [(center - half) / (1 + z * z / n), (center + half) / (1 + z * z / n)]
    assert [low, high] == pytest.approx(bounds, abs=1e-6)


def test_a_single_run_has_the_interval_of_its_starts():
    success = np.arange(500) < 430
    assert rate_over_runs([success]) == pytest.approx(wilson_interval(430, 500), abs=5e-4)
    assert rate_over_runs(np.ones((4, 500))) == wilson_interval(500, 500)


@pytest.mark.parametrize("freedom", [1, 2, 3, 9, 499, 1_000_000])
def test_students_quantile_is_scipys(freedom):
    assert student_quantile(freedom) == pytest.approx(t.ppf(0.975, freedom), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "least"), [(3, 0.94), (5, 0.93), (10, 0.93)])
@pytest.mark.parametrize(("spread", "difficulty"), [(0.3, 1.0), (0.5, 1.0)])
def test_intervals_over_runs_cover(runs, least, spread, difficulty):
    """Drawn runs and starts, 1000 times: success on a latent scale, gaps log-normal.

    Success rates of 93 % differ by 3 to 5 points between runs, gaps by a factor of 1.3 to 1.6.
    """
    rng, times, starts = np.random.default_rng(0), 1000, 500
    scale = math.hypot(1.0, spread, difficulty)
    rate, median = 0.93, 0.02
    quarter = lognorm.ppf([0.25, 0.75], scale, scale=median)
    expected = 2.0 * quad(lambda gap: gap * lognorm.pdf(gap, scale, scale=median), *quarter)[0]
    covered = np.zeros(2)
    for _ in range(times):
        run, start = spread * rng.standard_normal((runs, 1)), difficulty * rng.standard_normal(starts)
        latent = run + start + rng.standard_normal((runs, starts))
        found = compare_runs(latent > -scale * norm.ppf(rate), median * np.exp(-latent))
        covered += [
            found.success_rate.low <= rate <= found.success_rate.high,
            found.cost_gap.low <= expected <= found.cost_gap.high,
        ]
    print(runs, spread, covered / times)
    assert (covered / times > least).all()
    assert (covered / times < 0.99).all()


def test_improvement_is_counted_start_by_start():
    """Of 2 x 1 x 4 meetings the first wins three, and one is even."""
    costs, others = [[1.0, 5.0, 5.0, np.nan], [1.0, 2.0, 5.0, 9.0]], [[2.0, 2.0, 3.0, 4.0]]
    value, low, high = probability_of_improvement(costs, others)
    assert value == (1 + 1 + 0.5) / 8
    assert 0.0 <= low < value < high <= 1.0
    back = probability_of_improvement(others, costs)
    assert back == pytest.approx((1 - value, 1 - high, 1 - low))
    even = probability_of_improvement(np.ones((3, 500)), np.full((3, 500), 1.0 + 1e-9))
    assert even.value == 0.5
    assert probability_of_improvement([[np.inf]], [[np.nan]]).value == 0.5
    with pytest.raises(ValueError, match="flights from 4 and 3 starts"):
        probability_of_improvement(costs, [[1.0, 2.0, 3.0]])


def test_a_single_run_that_is_no_list_of_runs_is_refused():
    """Its flights would meet those from all other starts."""
    costs, single = [[1.0, 2.0, 3.0]], [2.0, 3.0, 4.0]
    for call in (
        lambda: probability_of_improvement(single, costs),
        lambda: probability_of_improvement(costs, single),
        lambda: performance_profile(single, [0.1]),
    ):
        with pytest.raises(ValueError, match=r"shape \(3,\), should be \(runs, starts\)"):
            call()


def test_improvement_over_a_twin_is_as_likely_as_not():
    """Runs of one agent, dealt out as two: the interval holds 1/2, more often than the flights alone say."""
    rng, held = np.random.default_rng(2), 0
    for _ in range(200):
        run, start = 0.3 * rng.standard_normal((10, 1)), rng.standard_normal(100)
        costs = np.exp(run + start + rng.standard_normal((10, 100)))
        _, low, high = probability_of_improvement(costs[:5], costs[5:])
        held += low <= 0.5 <= high
    assert 0.92 <= held / 200 <= 0.99


def test_the_profile_counts_flights_within_a_gap():
    gaps = [[0.0, 0.1, np.nan, 0.3], [0.05, 0.1, 0.2, 2.0]]
    shares = [each.value for each in performance_profile(gaps, [-1.0, 0.05, 0.1, 1.0, 3.0])]
    assert shares == pytest.approx([0.0, 2 / 6, 4 / 6, 5 / 6, 1.0])
    assert performance_profile([[np.nan]], [0.1]) == []


def test_gaps_of_unknown_optima_are_left_out_in_all_runs():
    gaps = [np.array([0.1, np.nan, 0.3, 0.2, 0.2]), np.array([0.1, 9.0, 0.3, 0.2, 0.2])]
    runs = compare_runs([np.ones(5)] * 4, gaps * 2)
    assert runs.cost_gap.value == pytest.approx(0.2)
    assert 0.0 < runs.cost_gap.low < 0.2 < runs.cost_gap.high < 0.4


def test_a_single_value_tells_no_interval():
    """Its interval had no width, as that of a result that is known exactly."""
    unknown = pytest.approx((0.2, math.nan, math.nan), nan_ok=True)
    for found in (bootstrap_interval([0.2], np.median), *map(gap_over_runs, ([[0.2]], [[math.nan, 0.2]]))):
        assert found == unknown
    assert gap_over_runs([[0.2], [0.3]]).low < 0.2


@pytest.mark.filterwarnings("error")
def test_infinite_gaps_have_no_interval_that_is_no_number():
    """As of flights that diverge; two of eight are beyond the middle half."""
    few, many = np.array([0.1, 0.2, 0.3, 0.4, 0.2, 0.3, np.inf, np.inf]), np.full(8, np.inf)
    found = gap_over_runs([few])
    assert found.value == pytest.approx(0.3)
    assert 0.1 < found.low < 0.3 < found.high < 0.5
    assert gap_over_runs([few, many]) == pytest.approx((math.inf, math.nan, math.nan), nan_ok=True)
    median = bootstrap_interval(few, lambda sample: float(np.median(sample)))
    assert (median.value, median.high) == (pytest.approx(0.3), math.inf)
    assert 0.1 <= median.low <= 0.3
    tail = bootstrap_interval(np.repeat(few, 8), lambda each: float(percentiles(each, 95.0)), share=0.95)
    assert tail == (math.inf, math.inf, math.inf)
    np.testing.assert_array_equal(percentiles([0.0, 1.0, 2.0, np.inf, np.inf], [50, 75]), [2.0, np.inf])
    assert math.isnan(percentiles([0.0, math.nan], 50.0))


def test_values_whose_range_holds_a_quantile_too_rarely_tell_no_interval():
    """The range of 5 values holds the median in 1 - 2 / 2^5 = 94 %, of 58 the 95th percentile in 94.9 %."""
    assert (fewest_values(0.5), fewest_values(0.95)) == (6, 59)
    for share, fewest in ((0.5, 6), (0.95, 59)):
        few, enough = (
            bootstrap_interval(np.arange(n), lambda each, q=share: float(np.quantile(each, q)), share=share)
            for n in (fewest - 1, fewest)
        )
        assert math.isnan(few.low)
        assert math.isnan(few.high)
        assert 0.0 <= enough.low < enough.value < enough.high <= fewest - 1


def test_impossible_counts_and_too_few_or_unequal_runs_are_refused():
    for successes, trials in ((-1, 5), (6, 5), (0, 0)):
        with pytest.raises(ValueError, match="successes of"):
            wilson_interval(successes, trials)
    with pytest.raises(ValueError, match=r"2 training runs .* should be at least 3"):
        compare_runs([np.ones(4)] * 2, [np.ones(4)] * 2)
    with pytest.raises(ValueError, match=r"runs have \[4, 5\] episodes"):
        compare_runs([np.ones(4), np.ones(5), np.ones(4)], [np.ones(4)] * 3)
    with pytest.raises(ValueError, match=r"shape \(3, 0\): should be at least one run and one start"):
        rate_over_runs(np.ones((3, 0)))
    for scores in ([[1.0, np.nan]], [[1.0, 2.0]], [[0.5, -0.1]]):
        with pytest.raises(ValueError, match=r"should be in \[0, 1\]"):
            rate_over_runs(scores)
