"""The measured peak: the machine code computes what it is timed for; never how fast it is."""

import math

import numpy as np
import pytest

from dq_space_arm_env.common.host_machine import host_machine
from scripts.benchmarks.throughput.peak import ACCUMULATORS, PRECISIONS, MultiplyAdd, measure_peak


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("accumulators", ACCUMULATORS)
@pytest.mark.parametrize("count", [1, 2, 9])
def test_every_sum_is_multiplied_and_added_as_often_as_asked(
    precision: str, accumulators: int, count: int
) -> None:
    kernel = MultiplyAdd(precision, accumulators)
    sums = np.arange(accumulators * kernel.lanes, dtype=precision).reshape(accumulators, kernel.lanes)
    expected = sums.copy()
    for _ in range(count):
        expected = 0.5 * expected + 1.0  # exact: few binary digits
    kernel.run(sums, 0.5, 1.0, count)
    assert np.array_equal(sums, expected)


def test_multiply_add_is_rounded_once_where_the_processor_fuses_it() -> None:
    kernel = MultiplyAdd("float64", ACCUMULATORS[0])
    sums = np.full((kernel.accumulators, kernel.lanes), 1.0 + 2.0**-30)
    kernel.run(sums, 1.0 + 2.0**-30, -1.0 - 2.0**-29, 1)
    assert np.all(sums == (2.0**-60 if host_machine().fused else 0.0))


def test_peak_tells_how_it_was_reached() -> None:
    double, single = measure_peak(1)
    assert (double["precision"], single["precision"]) == PRECISIONS
    assert single["lanes"] == 2 * double["lanes"] == 2 * host_machine().lanes
    for peak in (double, single):
        assert peak["accumulators"] in ACCUMULATORS
        assert 0.0 < peak["operations_per_ns"] < math.inf
