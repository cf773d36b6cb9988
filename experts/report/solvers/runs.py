"""What one solve of a maneuver took and what it reached, in the same terms for every solver.

Solvers are compared by the time they need until their cost is close to the best one known. Where a solver
minimizes a cost that is not quite ours, this is the best known of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from experts.problem import FloatArray

GAPS = (1e-2, 1e-3, 1e-4)
"""Gaps to the best known cost, relative to it, whose times are reported."""

_SMALLEST_COST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class SolverRun:
    """One solve of a maneuver by any solver.

    Attributes:
        solver: Label for tables.
        costs: Total cost after 0, 1, .. iterations of the trajectory that each ended with, of our problem,
            shape (n + 1,).
        seconds: Wall-clock time since the solve began at which these costs were reached, 0 first, shape (n +
            1,), s.
        iterations: Number n of iterations.
        converged: Whether the solver says so.
        stop_reason: Why it ended, in its own words.
        controls: Final controls within the limits, shape (N, n_u), units of the scene.
        replayed_cost: Total cost of `controls` rolled out in our problem, whatever the solver believes.
        parts: Median time that an iteration spends in "derivatives", "sweep" and "rollout", ms; empty if
            unknown.
        own_costs: Costs that the solver minimizes, shape (n + 1,), if its problem is not quite ours; None if
            they are `costs`.
    """

    solver: str
    costs: FloatArray
    seconds: FloatArray
    iterations: int
    converged: bool
    stop_reason: str
    controls: FloatArray
    replayed_cost: float
    parts: Mapping[str, float]
    own_costs: FloatArray | None = None

    @property
    def minimized(self) -> FloatArray:
        """Costs that the solver minimizes, shape (n + 1,)."""
        return self.costs if self.own_costs is None else self.own_costs


def relative_gap(cost: float, best: float) -> float:
    """Gap between a cost and the best one.

    Args:
        cost: The cost.
        best: Best known cost.

    Returns:
        The gap, relative to the best cost.
    """
    return (cost - best) / max(abs(best), _SMALLEST_COST)


def relative_gaps(run: SolverRun, best: float) -> FloatArray:
    """Gap between the lowest cost so far and the best one.

    Args:
        run: The solve.
        best: Best known of the costs that it minimizes.

    Returns:
        Gap after each iteration relative to the best cost, shape (n + 1,).
    """
    return np.array([relative_gap(float(cost), best) for cost in np.minimum.accumulate(run.minimized)])


def time_to_gap(run: SolverRun, best: float, gap: float) -> float | None:
    """Time until a solve has come close to the best known cost.

    Args:
        run: The solve.
        best: Best known of the costs that it minimizes.
        gap: Gap that is close enough, relative to the best cost.

    Returns:
        Time since the solve began, s; None if it never came so close.
    """
    reached = np.flatnonzero(relative_gaps(run, best) <= gap)
    return float(run.seconds[reached[0]]) if len(reached) else None


def median_run(runs: Sequence[SolverRun]) -> SolverRun:
    """Combine repetitions of the same solve.

    Args:
        runs: Solves that do not differ but in their times; at least one.

    Returns:
        The last one with the median of the times at which each cost was reached, and of each part.
    """
    last = runs[-1]
    same = [run for run in runs if len(run.seconds) == len(last.seconds)]
    parts = {name: float(np.median([run.parts[name] for run in same])) for name in last.parts}
    return replace(last, seconds=np.median([run.seconds for run in same], axis=0), parts=parts)
