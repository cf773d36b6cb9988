"""What counts as a regression of the expert, on results made up: good ones, and each kind of bad one."""

import numpy as np
import pytest

from experts.models import SecondOrder
from experts.report.solvers.accuracy import NOMINAL_START, SolverComparison, SolverResult
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.contenders import OURS
from experts.report.solvers.effort import QUICK
from experts.report.solvers.judgement import GAP, HORIZON_LOSS, shortcomings
from experts.report.solvers.ours import GUIDED, TITLES
from experts.report.solvers.random_starts import RandomStart, RandomStarts, StartSolve
from experts.report.solvers.receding import UNDISTURBED, Flight
from experts.report.solvers.runs import SolverRun

BEST = 1422.0
HYBRID = TITLES[SecondOrder.HYBRID]


def comparison(gap: float, solver: str = HYBRID, start: str = NOMINAL_START) -> SolverComparison:
    cost = BEST * (1.0 + gap)
    run = SolverRun(
        solver, np.array([cost]), np.array([0.0]), 0, True, "converged", np.zeros((1, 1)), cost, {}
    )
    return SolverComparison("paper", "rk4", start, (SolverResult(run, OURS),), {OURS: BEST})


def random_starts(solved: int, missed: int, solver: str = GUIDED) -> RandomStarts:
    outcomes = [True] * solved + [False] * missed
    starts = [
        RandomStart(i, (StartSolve(solver, BEST, 10, 0.1, converged, True),), BEST, True)
        for i, converged in enumerate(outcomes)
    ]
    return RandomStarts("paper", "rk4", 0, 1.0, starts)


def flight(loss: float, disturbance: str = UNDISTURBED) -> Flight:
    costs = (BEST * (1.0 + loss),)
    return Flight("paper", disturbance, 100, 15.0, 1.0, 2.0, 0.0, BEST, costs, costs, costs, 0.1, 0.01, 0)


def found(
    comparisons: list[SolverComparison] | None = None,
    starts: list[RandomStarts] | None = None,
    flights: list[Flight] | None = None,
) -> ExpertBenchmark:
    return ExpertBenchmark(
        QUICK, 0, comparisons=comparisons or [], random_starts=starts or [], flights=flights or []
    )


def test_nothing_is_said_of_a_good_expert() -> None:
    good = found([comparison(0.5 * GAP)], [random_starts(100, 1)], [flight(0.5 * HORIZON_LOSS)])
    assert shortcomings(good) == []
    assert shortcomings(found()) == []


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        (found([comparison(2.0 * GAP)]), "hybrid, rk4"),
        (found([comparison(float("nan"))]), "hybrid, rk4"),
        (found(starts=[random_starts(98, 2)]), "98.0%"),
        (found(flights=[flight(2.0 * HORIZON_LOSS)]), "100 stages"),
        (found(flights=[flight(float("inf"))]), "100 stages"),
    ],
)
def test_each_regression_has_its_sentence(bad: ExpertBenchmark, named: str) -> None:
    (sentence,) = shortcomings(bad)
    assert named in sentence


def test_what_is_not_claimed_is_not_judged() -> None:
    others = [comparison(1.0, solver="IPOPT"), comparison(1.0, start="random start 0")]
    unguided = random_starts(0, 2, solver=HYBRID)
    assert shortcomings(found(others, [unguided], [flight(1.0, "pushes")])) == []
