"""Whether the expert is as good as declared: the regressions that its benchmark looks for."""

from __future__ import annotations

from collections.abc import Iterator

from experts.report.solvers.accuracy import NOMINAL_START, SolverComparison
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.ours import GUIDED, TITLES
from experts.report.solvers.random_starts import RandomStarts, summarize_starts
from experts.report.solvers.receding import UNDISTURBED, Flight

GAP = 1e-4
"""Largest gap to the best cost known that each variant of the solver may leave from the nominal start."""
SOLVED = 0.99
"""Smallest share of random starts that `GuidedDDP` solves: converged, and within the tolerances."""
HORIZON_LOSS = 0.05
"""What looking ahead for a part of the maneuver may cost, relative to the plan, undisturbed."""


def shortcomings(found: ExpertBenchmark) -> list[str]:
    """What is worse than declared for scene `paper`; times are not judged.

    Args:
        found: What was measured.

    Returns:
        A sentence for each; none if all is well.
    """
    sentences = [sentence for comparison in found.comparisons for sentence in _gaps(comparison)]
    sentences += [sentence for starts in found.random_starts for sentence in _unsolved(starts)]
    return sentences + [sentence for flight in found.flights for sentence in _losses(flight)]


def _gaps(comparison: SolverComparison) -> Iterator[str]:
    """Variants that stay above the best cost known; from random starts they may end in other minima."""
    if comparison.start != NOMINAL_START:
        return
    for result in comparison.results:
        gap = result.run.replayed_cost / comparison.best[result.formulation] - 1.0
        if result.run.solver in TITLES.values() and not gap <= GAP:
            yield (
                f"{result.run.solver}, {comparison.integrator}: the cost is {gap:.1e} above the best known; "
                f"it should be within {GAP:g}."
            )


def _unsolved(starts: RandomStarts) -> Iterator[str]:
    for summary in summarize_starts(starts.starts):
        if summary.solver == GUIDED and not summary.both >= SOLVED:
            yield (
                f"{GUIDED}: {summary.both:.1%} of the random starts are solved; it should be {SOLVED:.0%}."
            )


def _losses(flight: Flight) -> Iterator[str]:
    if flight.disturbance != UNDISTURBED:
        return
    loss = max(flight.costs) / flight.plan_cost - 1.0
    if not loss <= HORIZON_LOSS:
        yield (
            f"receding horizon of {flight.horizon} stages: the cost is {loss:.1%} above that of the plan; it "
            f"should be within {HORIZON_LOSS:.0%}."
        )
