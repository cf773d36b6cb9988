"""Maneuvers that end within a task's tolerances, at the least cost that takes.

A quadratic cost trades final errors for effort: where thrusters are dear and the base drifts, its cheapest
maneuver may end outside the tolerances, by little and for little. The remedy is to multiply the weights of
the final pose until the maneuver is a success. Nothing is lost by that: a minimum of J + lambda g is the
cheapest of all maneuvers whose g is as small (Everett, Operations Research 11, 1963), with g the cost of the
final pose; so the smallest emphasis that suffices gives the least J that reaches the target.

The error is taken to fall like 1 / (1 + (emphasis - 1) / r), as it does for a linear-quadratic problem with
one direction; r is learnt from solve to solve.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

from experts.problem import FloatArray
from experts.solution import Solution

MOST_SOLVES = 6
"""After as many solves the target counts as out of reach."""
LARGEST_EMPHASIS = 1e4
"""Where this emphasis does not reach the target, none is tried beyond: effort would count for nothing."""
FIRST_RESPONSE = 50.0
"""First r. Any will do: a wrong one costs a solve, started near its end."""
SMALLEST_RISE = 1.5
"""Factor by which the emphasis rises at least."""
AIM = 0.95
"""Error to aim at, relative to the tolerance."""


@runtime_checkable
class HasTolerances(Protocol):
    """A problem with a target, tolerances, and a terminal cost whose pose can be emphasized."""

    def misses(self, state: FloatArray) -> float:
        """Final error relative to its tolerance."""

    def emphasized(self, emphasis: float) -> AbstractContextManager[None]:
        """Multiply the weights of the final pose inside a `with` block."""

    def end_cost(self, state: FloatArray) -> float:
        """Terminal cost, with the emphasis of the moment."""


class Reached(NamedTuple):
    """A solve with an emphasis.

    Attributes:
        emphasis: The factor of the final pose's weights.
        solution: The minimum there; its cost is the problem's own, without the emphasis.
    """

    emphasis: float
    solution: Solution


def reach(
    problem: HasTolerances, solution: Solution, solve: Callable[[FloatArray], Solution]
) -> Iterator[Reached]:
    """Raise the emphasis until a maneuver ends within the tolerances.

    Args:
        problem: The problem.
        solution: Its minimum, which ends outside.
        solve: Solves the problem, as it is at the moment, from given controls, shape (N, n_u).

    Yields:
        Every solve; the last one is a success, or has not converged, or reached a limit.
    """
    first = problem.misses(solution.states[-1])
    emphasis, response = 1.0, FIRST_RESPONSE
    for _ in range(MOST_SOLVES):
        needed = 1.0 + response * (first / AIM - 1.0)
        emphasis = min(max(needed, SMALLEST_RISE * emphasis), LARGEST_EMPHASIS)
        with problem.emphasized(emphasis):
            solution = solve(solution.controls)
            excess = problem.end_cost(solution.states[-1])
        excess -= problem.end_cost(solution.states[-1])
        note = f"{solution.message}; the final pose has {emphasis:.3g} times its weight"
        yield Reached(emphasis, replace(solution, cost=solution.cost - excess, message=note))
        error = problem.misses(solution.states[-1])
        if error <= 1.0 or not solution.converged or emphasis == LARGEST_EMPHASIS:
            return
        if error < first:
            response = (emphasis - 1.0) / (first / error - 1.0)
