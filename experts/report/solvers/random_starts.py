"""Solves from random starts: how often each solver converges, succeeds, and finds the best minimum known.

The starts are drawn from the scene's spread of states; target and masses are the scene's, also where the
environment draws them. Whether the cheapest maneuver is a success is up to the weights of the cost and the
reach of the robot; `GuidedDDP` gives up a little of the cost where it is not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from dq_space_arm_env.scene.start import draw_initial_state
from experts.arm_problem import ArmProblem
from experts.box_ddp import BoxDDP
from experts.guesses import GuidedDDP
from experts.models import SecondOrder
from experts.problem import FloatArray
from experts.report.solvers.best_known import Search
from experts.report.solvers.effort import Effort
from experts.report.solvers.ours import GUIDED, TITLES, uninterrupted
from experts.report.solvers.runs import relative_gap
from experts.solution import Solution

CLOSE = 0.01
"""A cost counts as the best known one if it is higher by no more than this share."""


@dataclass(frozen=True)
class StartSolve:
    """A solve from a random start.

    Attributes:
        solver: Label of the solver.
        cost: Final cost J.
        iterations: Number of iterations, from all guesses that it tried.
        seconds: Wall-clock time, s.
        converged: Whether it converged.
        is_success: Whether the tip's errors at the end are within the scene's tolerances.
    """

    solver: str
    cost: float
    iterations: int
    seconds: float
    converged: bool
    is_success: bool


@dataclass(frozen=True)
class RandomStart:
    """What became of a random start.

    Attributes:
        index: Counts the starts of a seed, from 0.
        solves: One by each solver.
        best_cost: Lowest cost that any guess led to.
        best_is_success: Whether the tip's errors at the end of that solution are within the tolerances.
    """

    index: int
    solves: tuple[StartSolve, ...]
    best_cost: float
    best_is_success: bool


@dataclass(frozen=True)
class RandomStarts:
    """Random starts of a scene.

    Attributes:
        scene: Name of the scene.
        integrator: Name of the integrator.
        seed: Seed of the draws.
        library_seconds: Time in which the library of `GuidedDDP` was solved, once, s.
        starts: What became of each start; grows while they are solved.
    """

    scene: str
    integrator: str
    seed: int
    library_seconds: float
    starts: list[RandomStart] = field(default_factory=list)


@dataclass(frozen=True)
class StartSummary:
    """How a solver did on random starts; shares are between 0 and 1.

    Attributes:
        solver: Label of the solver.
        converged: Share that converged.
        succeeded: Share that ended within the scene's tolerances.
        both: Share that did both.
        best: Share whose cost is within 1 % of the best known.
        iterations: Median and 90th percentile of the iterations.
        seconds: Median and 90th percentile of the time, s.
    """

    solver: str
    converged: float
    succeeded: float
    both: float
    best: float
    iterations: tuple[float, float]
    seconds: tuple[float, float]


def draw_starts(problem: ArmProblem, count: int, seed: int) -> list[FloatArray]:
    """Draw starts from a scene's spread; the first ones of a seed are the same however many there are.

    Args:
        problem: The maneuver.
        count: Number of starts.
        seed: Seed of the draws.

    Returns:
        States, each of shape (n_x,), units of the state.
    """
    rng = np.random.default_rng(seed)
    return [draw_initial_state(problem.scene, rng) for _ in range(count)]


def solve_random_starts(
    problem: ArmProblem, guided: GuidedDDP, effort: Effort, states: Sequence[FloatArray]
) -> Iterator[RandomStart]:
    """Solve a maneuver from random starts.

    Args:
        problem: The maneuver.
        guided: `GuidedDDP` for it.
        effort: How much to measure.
        states: The starts.

    Yields:
        What became of each.

    Raises:
        KeyboardInterrupt: If the user interrupts.
    """
    solvers: dict[str, BoxDDP | GuidedDDP] = {
        TITLES[variant]: BoxDDP(problem, second_order=variant, max_iterations=effort.max_iterations)
        for variant in (SecondOrder.GAUSS_NEWTON, SecondOrder.HYBRID)
    }
    solvers[GUIDED] = guided
    search = Search(problem, guided.library, effort.max_iterations)
    for index, state in enumerate(states):
        solves, solutions = [], []
        for name, solver in solvers.items():
            started = perf_counter()
            solution = uninterrupted(solver.solve(state))
            solves.append(_summary(name, problem, solution, perf_counter() - started))
            solutions.append(solution)
        best = min([*solutions, *search.solutions(state)], key=lambda solution: solution.cost)
        yield RandomStart(index, tuple(solves), best.cost, problem.is_success(best.states[-1]))


def _summary(name: str, problem: ArmProblem, solution: Solution, seconds: float) -> StartSolve:
    attempts = solution.metadata.get("attempts", ())
    return StartSolve(
        solver=name,
        cost=solution.cost,
        iterations=sum(attempt["iterations"] for attempt in attempts) if attempts else solution.iterations,
        seconds=seconds,
        converged=solution.converged,
        is_success=problem.is_success(solution.states[-1]),
    )


def summarize_starts(starts: Sequence[RandomStart]) -> list[StartSummary]:
    """Summarize how each solver did.

    Args:
        starts: What became of each start.

    Returns:
        A summary for each solver; none if there is no start.
    """
    if not starts:
        return []
    return [_solver_summary(starts, solve.solver) for solve in starts[0].solves]


def _solver_summary(starts: Sequence[RandomStart], solver: str) -> StartSummary:
    pairs = [(start, solve) for start in starts for solve in start.solves if solve.solver == solver]
    solves = [solve for _, solve in pairs]
    return StartSummary(
        solver=solver,
        converged=_share(solve.converged for solve in solves),
        succeeded=_share(solve.is_success for solve in solves),
        both=_share(solve.converged and solve.is_success for solve in solves),
        best=_share(is_best(start, solve) for start, solve in pairs),
        iterations=_spread([solve.iterations for solve in solves]),
        seconds=_spread([solve.seconds for solve in solves]),
    )


def is_best(start: RandomStart, solve: StartSolve) -> bool:
    """Tell whether a solve found the best minimum known, or one that is as good.

    Args:
        start: The start.
        solve: A solve from it.

    Returns:
        Whether its cost is within 1 % of the best known.
    """
    return relative_gap(solve.cost, start.best_cost) <= CLOSE


def missing_share(starts: Sequence[RandomStart]) -> float:
    """Share of the starts whose best minimum known is no success.

    Args:
        starts: What became of each start; at least one.

    Returns:
        The share, 0 to 1.
    """
    return _share(not start.best_is_success for start in starts)


def _share(facts: Iterable[bool]) -> float:
    return float(np.mean(list(facts)))


def _spread(values: Sequence[float]) -> tuple[float, float]:
    median, high = np.percentile(values, (50, 90))
    return float(median), float(high)
