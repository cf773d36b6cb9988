"""Time to accuracy: how soon each solver comes how close to the best known cost, from the same start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experts.arm_problem import ArmProblem
from experts.problem import FloatArray
from experts.report.solvers.best_known import Search
from experts.report.solvers.contenders import OURS, Contender
from experts.report.solvers.effort import Effort
from experts.report.solvers.runs import SolverRun, median_run

NOMINAL_START = "nominal start"
"""What the scene's own initial state is called."""


@dataclass(frozen=True)
class SolverResult:
    """What a solver did.

    Attributes:
        run: Its solve.
        formulation: Whose problem it minimizes.
    """

    run: SolverRun
    formulation: str


@dataclass(frozen=True)
class SolverComparison:
    """Solvers on the same maneuver from the same start.

    Attributes:
        scene: Name of the scene.
        integrator: Name of the integrator.
        start: Which start.
        results: What the solvers did.
        best: Best known cost of each problem that is minimized, by its name.
    """

    scene: str
    integrator: str
    start: str
    results: tuple[SolverResult, ...]
    best: dict[str, float]


def compare_solvers(
    problem: ArmProblem,
    contenders: Sequence[Contender],
    search: Search,
    start: str,
    x0: FloatArray | None,
    effort: Effort,
) -> SolverComparison:
    """Have solvers solve a maneuver from a start.

    Args:
        problem: The maneuver.
        contenders: The solvers.
        search: Looks for better costs than theirs.
        start: Name of the start.
        x0: The start, shape (n_x,), units of the state; None for the nominal one.
        effort: How much to measure.

    Returns:
        What they did, and the best known costs.

    Raises:
        KeyboardInterrupt: If the user interrupts.
    """
    results = [
        SolverResult(_solve(contender, x0, effort.repeats), contender.formulation)
        for contender in contenders
        if x0 is not None or not contender.knows_nominal_start
    ]
    candidates = [(solution.cost, solution.controls) for solution in search.solutions(x0)]
    candidates += [(result.run.replayed_cost, result.run.controls) for result in results]
    _, controls = min(candidates, key=lambda candidate: candidate[0])
    references = [
        SolverResult(contender.solve_from(x0, controls), contender.formulation)
        for contender in contenders
        if contender.solve_from is not None
    ]
    best = best_costs([*results, *references], min(cost for cost, _ in candidates))
    simulation = problem.scene.simulation
    return SolverComparison(problem.scene.name, simulation.integrator, start, tuple(results), best)


def _solve(contender: Contender, x0: FloatArray | None, repeats: int) -> SolverRun:
    """Solve once if that takes long; else once for warming up, then as often as asked for."""
    first = contender.solve(x0)
    return first if contender.is_slow else median_run([contender.solve(x0) for _ in range(repeats)])


def best_costs(results: Sequence[SolverResult], known: float) -> dict[str, float]:
    """Find the lowest cost of every problem that is minimized.

    Args:
        results: Solves from the same start.
        known: Cost that is known to be possible in our own problem, dimensionless.

    Returns:
        The lowest cost by the problem's name.
    """
    best = {OURS: known}
    for result in results:
        lowest = float(np.min(result.run.minimized))
        best[result.formulation] = min(best.get(result.formulation, np.inf), lowest)
    return best
