"""Every case of the report is a test: it must be handled, refused or not claimed, never failed."""

import pytest

pytest.importorskip("mpmath")

from dq_space_arm_env.scene import INTEGRATORS
from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.harness import Status
from scripts.benchmarks.stability import all_cases
from scripts.benchmarks.stability.cases import Case

FAST_INTEGRATORS = ("rk4", "momentum_rosenbrock")


def is_slow(case: Case) -> bool:
    """Fast tests do with two integrators and double precision: the others' machine code takes minutes."""
    others = [name for name in INTEGRATORS if name not in FAST_INTEGRATORS]
    return any(name in case.subject for name in ("float32", *others))


CASES = [
    pytest.param(case, id=f"{case.group}: {case.title}", marks=[pytest.mark.slow] if is_slow(case) else [])
    for case in all_cases()
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    row, *_ = case.rows(QUICK)
    assert row["status"] != Status.FAILED, row["note"]
    if row["status"] == Status.HANDLED:
        assert row["error"] <= case.bound
    else:
        assert row["note"]
