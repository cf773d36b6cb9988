"""Tables and picture of the expert's benchmark, from numbers made up as wide as they get."""

from dataclasses import replace
from io import StringIO
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from dq_space_arm_env import load_scene
from experts.models import SecondOrder
from experts.report.solvers.accuracy import SolverComparison, SolverResult
from experts.report.solvers.contenders import CROCODDYL, OURS
from experts.report.solvers.iterations import IterationCosts, Pieces, VariantCost
from experts.report.solvers.ours import GUIDED, PAPERS_STATES, TITLES
from experts.report.solvers.random_starts import RandomStart, RandomStarts, StartSolve
from experts.report.solvers.receding import Flight, disturbances
from experts.report.solvers.runs import SolverRun
from experts.report.solvers.tables import (
    print_comparison,
    print_flights,
    print_iterations,
    print_random_starts,
)

SCENE = "reaction-wheels"
SOLVERS = (*TITLES.values(), GUIDED, PAPERS_STATES, "Crocoddyl SolverBoxFDDP", "IPOPT")


def run(solver: str, slowness: float, lowest: float = 1422.189) -> SolverRun:
    gaps = 10.0 ** -np.arange(7.0)
    return SolverRun(
        solver=solver,
        costs=lowest * (1.0 + gaps),
        seconds=slowness * np.arange(7.0),
        iterations=300,
        converged=False,
        stop_reason="",
        controls=np.zeros((1, 1)),
        replayed_cost=1.2345 * lowest,
        parts={},
    )


@pytest.fixture
def comparison() -> SolverComparison:
    results = [
        SolverResult(run(name, 0.0123 * 3.0**i), CROCODDYL if "Crocoddyl" in name else OURS)
        for i, name in enumerate(SOLVERS)
    ]
    return SolverComparison(
        SCENE, "rk4", "random start 10", tuple(results), {OURS: 1422.189, CROCODDYL: 1422.189}
    )


@pytest.fixture
def random_starts() -> RandomStarts:
    starts = [
        RandomStart(
            i,
            tuple(StartSolve(name, 1e3 + 6.0 * i, 123, 12.3 + i, True, True) for name in SOLVERS[:3]),
            1e3,
            True,
        )
        for i in range(4)
    ]
    return RandomStarts(SCENE, "rk4", 0, 12.3, starts)


@pytest.fixture
def iterations() -> IterationCosts:
    variants = tuple(
        VariantCost(
            SCENE,
            "symplectic_euler",
            name,
            200,
            1422.189,
            False,
            "regularization_limit",
            12.3,
            12.3,
            99.9,
            99.9,
            99.9,
            99.9,
            99.9,
        )
        for name in SecondOrder
    )
    pieces = Pieces(12.3, 12.3, 12.3, None, 12.3)
    return IterationCosts(variants, pieces, pieces)


@pytest.fixture
def flights() -> list[Flight]:
    return [
        Flight(
            SCENE,
            disturbance.name,
            horizon,
            15.0,
            12.3,
            12.3,
            0.123,
            1422.189,
            (1e4,),
            (1e4,),
            (1e4,),
            123.4,
            0.123,
            3,
        )
        for disturbance in disturbances(load_scene("paper"), other_masses=True)
        for horizon in (25, 200)
    ]


def page(width: int, *printed: Any) -> list[str]:
    console = Console(width=width, file=StringIO(), highlight=False)
    for printer, value in printed:
        printer(console, value)
    assert isinstance(console.file, StringIO)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_tables_fit_a_terminal_of_110_columns(
    comparison: SolverComparison,
    random_starts: RandomStarts,
    iterations: IterationCosts,
    flights: list[Flight],
) -> None:
    printed = (
        (print_iterations, [iterations]),
        (print_comparison, comparison),
        (print_random_starts, random_starts),
        (print_flights, flights),
    )
    assert page(110, *printed) == page(200, *printed)


def test_times_that_were_not_reached_are_dashes(comparison: SolverComparison) -> None:
    creeping = replace(comparison.results[0].run, costs=np.array([9e3, 1430.0]), seconds=np.array([0.0, 2.0]))
    lines = page(110, (print_comparison, replace(comparison, results=(SolverResult(creeping, OURS),))))
    (row,) = [line for line in lines if line.lstrip().startswith("Gauss-Newton")]
    assert row.split()[-6:] == ["23.45%", "2.00", "-", "-", "2.00", "6.67"]
    assert any("Crocoddyl's problem is not quite ours" in line for line in lines)


def test_solvers_differ_in_color_and_marker_and_keep_them(
    comparison: SolverComparison, random_starts: RandomStarts
) -> None:
    pytest.importorskip("matplotlib")
    from experts.report.figures.solvers import solvers_figure
    from experts.report.figures.style import house_style

    with house_style():
        figure = solvers_figure([comparison], [random_starts])
        figure.canvas.draw()
    gaps, shares = figure.axes
    looks = {line.get_label(): (line.get_color(), line.get_marker()) for line in gaps.lines[3:]}
    assert tuple(looks) == SOLVERS
    assert len({color for color, _ in looks.values()}) == len({marker for _, marker in looks.values()}) == 7
    for line in shares.lines:
        assert looks[line.get_label()] == (line.get_color(), line.get_marker())
    assert [axes.get_xlabel() for axes in figure.axes] == ["time [s]", "time of a solve [s]"]
    assert len(figure.legends[0].get_texts()) == 7


def test_picture_shows_gaps_to_the_best_and_counts_starts(
    comparison: SolverComparison, random_starts: RandomStarts
) -> None:
    pytest.importorskip("matplotlib")
    from experts.report.figures.solvers import picture, solvers_figure
    from experts.report.figures.style import house_style

    with house_style():
        gaps, shares = solvers_figure([comparison], [random_starts]).axes
    assert [line.get_ydata()[0] for line in gaps.lines[:3]] == [1e-2, 1e-3, 1e-4]
    assert gaps.lines[3].get_ydata() == pytest.approx(10.0 ** -np.arange(1.0, 7.0))
    assert gaps.lines[3].get_xdata() == pytest.approx(0.0123 * np.arange(1.0, 7.0))
    # Two of the four ended within 1 % of the best.
    assert shares.lines[0].get_xdata() == pytest.approx([12.3, 13.3])
    assert shares.lines[0].get_ydata() == pytest.approx([0.25, 0.5])
    assert picture([comparison], []).startswith(b"\x89PNG")
    assert picture([], [random_starts]).startswith(b"\x89PNG")
