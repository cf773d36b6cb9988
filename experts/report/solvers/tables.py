"""The benchmark of the expert as tables on the terminal, 110 columns wide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from rich.console import Console

from experts.models import SecondOrder
from experts.report.solvers.accuracy import SolverComparison, SolverResult
from experts.report.solvers.contenders import OURS
from experts.report.solvers.iterations import IterationCosts, Pieces, VariantCost
from experts.report.solvers.ours import TITLES
from experts.report.solvers.random_starts import (
    RandomStarts,
    StartSummary,
    missing_share,
    summarize_starts,
)
from experts.report.solvers.receding import Flight
from experts.report.solvers.runs import GAPS, relative_gap, time_to_gap
from experts.report.tables import plain_table
from experts.report.throughput.formats import integrator_title, three_digits


def print_iterations(console: Console, found: Sequence[IterationCosts]) -> None:
    """Print what iterations cost.

    Args:
        console: Where to print.
        found: What is measured of a scene, with each integrator.
    """
    scene = found[0].variants[0].scene
    headings = ("itera-\ntions", "cost J", "end", "solve [s]")
    parts = ("itera-\ntion", "deriva-\ntives", "sweep", "roll-\nout", "rest")
    for costs in found:
        integrator = integrator_title(costs.variants[0].integrator)
        title = (
            f"Scene {scene}, {integrator}, from zero controls: solves, best (median); iterations, median, ms"
        )
        rows = (_variant_row(variant) for variant in costs.variants)
        console.print(plain_table(title, ("", *headings, *parts), rows, right=4))
    pieces = ("first\nderivatives", "second\nderivatives", "Gauss-\nNewton\nsweep", "exact\nsweep", "rollout")
    whole = ("Gauss-\nNewton\niteration", "exact\niteration", "ratio")
    title = f"Scene {scene}: pieces of an iteration along the best trajectory, ms"
    rows = (row for costs in found for row in _pieces_rows(costs))
    console.print(plain_table(title, ("", *pieces, *whole), rows, right=1))


def _variant_row(variant: VariantCost) -> tuple[str, ...]:
    times = (
        variant.iteration_ms,
        variant.derivatives_ms,
        variant.sweep_ms,
        variant.rollout_ms,
        variant.rest_ms,
    )
    return (
        TITLES[SecondOrder(variant.second_order)],
        str(variant.iterations),
        f"{variant.cost:.7g}",
        variant.stop_reason.replace("regularization", "damping").replace("_", " "),
        f"{three_digits(variant.best_seconds)} ({three_digits(variant.median_seconds)})",
        *(three_digits(time) for time in times),
    )


def _pieces_rows(costs: IterationCosts) -> Iterator[tuple[str, ...]]:
    integrator = integrator_title(costs.variants[0].integrator)
    yield _pieces_row(f"{integrator}, best", costs.best)
    yield _pieces_row(f"{integrator}, median", costs.median)


def _pieces_row(title: str, pieces: Pieces) -> tuple[str, ...]:
    times = (
        pieces.first_derivatives,
        pieces.second_derivatives,
        pieces.gauss_newton_sweep,
        pieces.exact_sweep,
        pieces.rollout,
        pieces.gauss_newton_iteration,
        pieces.exact_iteration,
        pieces.ratio,
    )
    return title, *("-" if time is None else three_digits(time) for time in times)


def print_comparison(console: Console, comparison: SolverComparison) -> None:
    """Print how soon solvers came how close to the best known cost.

    Args:
        console: Where to print.
        comparison: The solvers from one start.
    """
    gaps = (f"s to\n{100 * gap:g} %" for gap in GAPS)
    best = comparison.best[OURS]
    integrator = integrator_title(comparison.integrator)
    console.print(
        plain_table(
            f"Scene {comparison.scene}, {integrator}, {comparison.start}: best known J {best:.7g}",
            (
                "",
                "itera-\ntions",
                "con-\nverged",
                "cost J",
                "above\nbest",
                *gaps,
                "s to\nend",
                "ms per\niter.",
            ),
            (_result_row(result, comparison) for result in comparison.results),
            right=3,
        )
    )
    others = {name: cost for name, cost in comparison.best.items() if name != OURS}
    for name, cost in others.items():
        console.print(
            f"{name} problem is not quite ours; its times are to the gaps to its own best known cost, "
            f"{cost:.7g}.\nIts cost J above is that of its controls in our problem.\n"
        )


def _result_row(result: SolverResult, comparison: SolverComparison) -> tuple[str, ...]:
    run, best = result.run, comparison.best[result.formulation]
    times = [time_to_gap(run, best, gap) for gap in GAPS]
    above = relative_gap(run.replayed_cost, comparison.best[OURS])
    return (
        run.solver,
        str(run.iterations),
        "yes" if run.converged else "no",
        f"{run.replayed_cost:.7g}",
        f"{above:.2%}" if above >= 5e-5 else f"{above:.0e}",
        *("-" if time is None else three_digits(time) for time in times),
        three_digits(float(run.seconds[-1])),
        three_digits(1e3 * float(run.seconds[-1]) / run.iterations) if run.iterations else "-",
    )


def print_random_starts(console: Console, found: RandomStarts) -> None:
    """Print how solvers did on random starts.

    Args:
        console: Where to print.
        found: The starts; nothing is printed if there is none.
    """
    if not found.starts:
        return
    integrator = integrator_title(found.integrator)
    console.print(
        plain_table(
            f"Scene {found.scene}, {integrator}: {len(found.starts)} random starts, seed {found.seed}",
            (
                "",
                "converged",
                "success",
                "both",
                "within 1 %\nof the best",
                "iterations\nmedian, 90 %",
                "seconds\nmedian, 90 %",
            ),
            (_summary_row(summary) for summary in summarize_starts(found.starts)),
            right=1,
        ),
        f"From {missing_share(found.starts):.1%} of the starts the cheapest maneuver known ends outside of "
        "the tolerances:\nso the scene weighs error against effort. GuidedDDP then emphasizes the final pose "
        "as far as it takes.\n"
        f"The library of GuidedDDP took {found.library_seconds:.2g} s, once.\n",
    )


def _summary_row(summary: StartSummary) -> tuple[str, ...]:
    shares = (summary.converged, summary.succeeded, summary.both, summary.best)
    return (
        summary.solver,
        *(f"{share:.1%}" for share in shares),
        ", ".join(f"{count:.0f}" for count in summary.iterations),
        ", ".join(three_digits(seconds) for seconds in summary.seconds),
    )


def print_flights(console: Console, flights: Sequence[Flight]) -> None:
    """Print what the receding-horizon expert did.

    Args:
        console: Where to print.
        flights: Its flights in one scene; nothing is printed if there is none.
    """
    if not flights:
        return
    first = flights[0]
    console.print(
        plain_table(
            f"Scene {first.scene}: receding horizon, period {first.period_ms:g} ms; costs relative to the "
            f"undisturbed plan's J {first.plan_cost:.6g}",
            (
                "disturbance",
                "horizon",
                "ms,\nmedian",
                "ms,\n99 %",
                "late",
                "expert",
                "plan's\nfeedback",
                "plan's\ncontrols",
                "error\ndeg",
                "error\nm",
            ),
            _flight_rows(flights),
            right=1,
        )
    )


def _flight_rows(flights: Sequence[Flight]) -> Iterator[tuple[str, ...]]:
    for name, group in groupby(flights, key=lambda flight: flight.disturbance):
        for index, flight in enumerate(group):
            costs = (flight.costs, flight.policy_costs, flight.open_loop_costs)
            yield (
                "" if index else name,
                str(flight.horizon),
                three_digits(flight.median_ms),
                three_digits(flight.percentile_99_ms),
                f"{flight.late:.1%}",
                *(f"{1.0 + relative_gap(float(np.mean(each)), flight.plan_cost):.4f}" for each in costs),
                f"{flight.attitude_error_deg:.3g}",
                f"{flight.position_error:.3g}",
            )
