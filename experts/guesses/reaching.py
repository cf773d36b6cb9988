"""Reach the target: maneuvers that end within a task's tolerances, at the least cost.

A quadratic cost trades final errors for effort: where thrust is expensive and the base drifts, the cheapest
maneuver may end slightly outside the tolerances. Multiplying the weights of the final pose makes it a
success, without loss: a minimum of J + lambda g, with g the cost of the final pose, is the cheapest of all
maneuvers with so small a g (Everett, Operations Research 11, 1963), so the smallest sufficient emphasis gives
the least J that reaches the target.

The error is modeled as 1 / (1 + (emphasis - 1) / r), exact for a linear-quadratic problem with one direction;
r is updated from solve to solve.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

from experts.ddp.solution import Solution
from experts.problems.shooting_problem import FloatArray

MOST_SOLVES = 6
"""Solves after which the target counts as out of reach."""
LARGEST_EMPHASIS = 1e4
"""Largest emphasis to try: beyond it effort would hardly count."""
FIRST_RESPONSE = 50.0
"""First r. Any value works: a wrong one costs one more solve, started near its solution."""
SMALLEST_RISE = 1.5
"""Smallest factor between consecutive emphases."""
AIM = 0.95
"""Error to aim for, relative to the tolerance."""


class HasTolerances(Protocol):
    """A problem with a target, tolerances, and a terminal cost whose pose can be emphasized."""

    def misses(self, state: FloatArray) -> float:
        """Final error relative to its tolerance."""

    def emphasized(self, emphasis: float) -> AbstractContextManager[None]:
        """Multiply the weights of the final pose inside a `with` block."""

    def end_cost(self, state: FloatArray) -> float:
        """Terminal cost, with the current emphasis."""


class Reached(NamedTuple):
    """A solve with an emphasis."""

    emphasis: float  # factor of the final pose's weights
    solution: Solution  # with the problem's own cost, without the emphasis


def solve_emphasized(problem: HasTolerances, emphasis: float, solve: Callable[[], Solution]) -> Reached:
    """Minimize a problem with an emphasis; `solve` does so in its current form."""
    with problem.emphasized(emphasis):
        solution = solve()
        excess = problem.end_cost(solution.states[-1])
    excess -= problem.end_cost(solution.states[-1])
    note = f"{solution.message}; the final pose has {emphasis:.3g} times its weight"
    return Reached(emphasis, replace(solution, cost=solution.cost - excess, message=note))


def reach(
    problem: HasTolerances, begun: Reached, solve: Callable[[FloatArray], Solution]
) -> Iterator[Reached]:
    """Raise the emphasis until a maneuver ends within the tolerances; yield every solve.

    `solve` minimizes the problem in its current form from given controls, shape (N, n_u). The last solve
    succeeds, does not converge, or reaches a limit.
    """
    (first, solution), response, rise = begun, FIRST_RESPONSE, 1.0
    emphasis, first_error = first, problem.misses(solution.states[-1])
    for _ in range(MOST_SOLVES):
        needed = 1.0 - response + (first - 1.0 + response) * first_error / AIM
        emphasis = min(max(needed, rise * emphasis), LARGEST_EMPHASIS)
        reached = solve_emphasized(problem, emphasis, partial(solve, solution.controls))
        yield reached
        solution, rise = reached.solution, SMALLEST_RISE
        error = problem.misses(solution.states[-1])
        if error <= 1.0 or not solution.converged or emphasis == LARGEST_EMPHASIS:
            return
        if error < first_error:
            ratio = first_error / error
            response = (emphasis - 1.0 - ratio * (first - 1.0)) / (ratio - 1.0)
