"""Every case of the report is a test: it must be handled, refused or not claimed, never failed."""

import math

import pytest

pytest.importorskip("mpmath")

from dq_space_arm_env.integrators import INTEGRATORS
from experts.report.stability import GROUPS, QUICK, Case, Status, all_cases, run_case

FAST_INTEGRATORS = ("rk4", "momentum_rosenbrock")


def is_slow(case: Case) -> bool:
    """Fast tests do with two integrators and double precision: the others' machine code takes minutes."""
    others = [name for name in INTEGRATORS if name not in FAST_INTEGRATORS]
    return case.slow or any(name in case.subject for name in ("float32", *others))


CASES = [
    pytest.param(case, id=f"{case.group}: {case.title}", marks=[pytest.mark.slow] if is_slow(case) else [])
    for case in all_cases()
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    row = run_case(case, QUICK)
    assert row.status is not Status.FAILED, row.sentence
    if row.status is Status.HANDLED:
        assert row.error is not None
        assert math.isfinite(row.error)
        assert row.error <= case.bound
    else:
        assert row.sentence


def test_cases_have_names_of_their_own() -> None:
    titles = [(case.group, case.title) for case in all_cases()]
    assert len(set(titles)) == len(titles)
    assert {group for group, _ in titles} == set(GROUPS)


def test_an_unknown_group_is_refused() -> None:
    with pytest.raises(ValueError, match=r"group: 'mass' is unknown; there are masses, motions"):
        all_cases(["mass"])
