"""Every case of the report is a test: it must be handled, refused or not claimed, never failed."""

import math
from dataclasses import replace

import pytest

pytest.importorskip("mpmath")

from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.harness import Status
from scripts.benchmarks.stability import all_cases, long_motions, reached
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed


def is_recorded(case: Case) -> bool:
    return reached.largest(QUICK, case.group, case.name, case.subject) < math.inf


LONG = ("energy", "base to arm mass 1e-12 to 1e12", "damper of 1e+06")
"""Cases that take CI longest, of motions that others show too, begin so."""
ALIKE = ("rodas5p", "rk6")
"""They share all but numbers with rodas4 and rk8."""


def marks(case: Case) -> tuple[pytest.MarkDecorator, ...]:
    """A motion of a million steps of which nothing is claimed fails only if it cannot be had at all."""
    is_idle = case.group == long_motions.GROUP and not is_recorded(case)
    is_late = is_idle or case.title.startswith(LONG) or case.subject.startswith(ALIKE)
    return (pytest.mark.endurance,) if is_late else ()


CASES = [pytest.param(case, id=f"{case.group}: {case.title}", marks=marks(case)) for case in all_cases()]


@pytest.mark.slow  # their machine code takes minutes
@pytest.mark.sampled
@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    row, *_ = case.rows(QUICK)
    assert row["status"] != Status.FAILED, row["note"]
    if row["status"] == Status.HANDLED:
        assert row["error"] <= case.bound
        left_out = case.scene and case.scene not in QUICK.shipped(QUICK.cost_scenes)  # by a quick report
        assert is_recorded(case) or left_out, "record what it reached"
    else:
        assert row["note"]


def test_a_case_that_loses_a_digit_fails() -> None:
    """Ten times the recorded error bounds a case; a workload that no table knows has its claim alone.

    What was handled once cannot be declared beyond the claim.
    """
    case = all_cases(["masses"])[0]
    key = case.group, case.name, case.subject
    limit = reached.largest(QUICK, *key)
    assert limit < 0.1 * case.bound
    assert reached.largest(replace(QUICK, only=("masses",)), *key) == limit
    assert reached.largest(replace(QUICK, samples=5), *key) == math.inf
    for error, status in ((0.9 * limit, Status.HANDLED), (1.1 * limit, Status.FAILED)):
        row = next(replace(case, run=lambda effort, error=error: Handled(error)).rows(QUICK))
        assert row["status"] == status
    given_up = replace(case, run=lambda effort: NotClaimed("beyond it"))
    assert next(given_up.rows(QUICK))["status"] == Status.FAILED
    assert next(given_up.rows(replace(QUICK, samples=5)))["status"] == Status.NOT_CLAIMED


def test_each_record_has_its_case() -> None:
    """A case that is renamed or gone leaves no line behind."""
    cases = {(case.group, case.name, case.subject) for case in all_cases()}
    assert set(reached.table()) <= cases
