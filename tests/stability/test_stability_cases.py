"""Every case of the report is a test: it must be handled, refused or not claimed, never failed."""

import pytest

pytest.importorskip("mpmath")

from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.harness import Status
from scripts.benchmarks.stability import all_cases
from scripts.benchmarks.stability.cases import Case

pytestmark = pytest.mark.slow  # their machine code takes minutes

CASES = [pytest.param(case, id=f"{case.group}: {case.title}") for case in all_cases()]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    row, *_ = case.rows(QUICK)
    assert row["status"] != Status.FAILED, row["note"]
    if row["status"] == Status.HANDLED:
        assert row["error"] <= case.bound
    else:
        assert row["note"]
