"""The solves of a maneuver from several guesses, and the best of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from experts.ddp.solution import Solution, StopReason
from experts.problems.shooting_problem import ShootingProblem

SAME_MINIMUM = 1e-6
"""Minima whose costs differ by a smaller share are the same."""


class Attempt(NamedTuple):
    """A solve."""

    guess: str
    solution: Solution

    def summary(self) -> dict[str, Any]:
        """Describe it for the metadata, as JSON values."""
        solution = self.solution
        return {
            "guess": self.guess,
            "constrained": solution.constraints is not None,
            "cost": solution.cost,
            "iterations": solution.iterations,
            "stop_reason": solution.stop_reason.value,
        }


def is_known(solution: Solution, attempts: Sequence[Attempt]) -> bool:
    """Whether one of the attempts found the same minimum."""
    costs = [attempt.solution.cost for attempt in attempts]
    return bool(np.isclose(costs, solution.cost, rtol=SAME_MINIMUM, atol=0.0).any())


def best_solution(
    attempts: Sequence[Attempt], problem: ShootingProblem, is_good: Callable[[Solution], bool]
) -> Solution:
    """Return the cheapest solution, a good one if there is any; its metadata tell of all attempts.

    Constraints of the target, which `problem` does not have, are dropped where they did not help.
    """
    good = [attempt for attempt in attempts if is_good(attempt.solution)]
    own = [attempt for attempt in attempts if attempt.solution.problem is problem]
    best = min(good or own or attempts, key=lambda attempt: attempt.solution.cost)
    solution, stop = best.solution, StopReason.INFEASIBLE
    missed = [each.solution.message for each in attempts if each.solution.stop_reason is stop]
    if missed and not good and solution.stop_reason is not stop:
        solution = replace(solution, message=f"{solution.message}; but {missed[-1]}")
    solution.metadata["guess"] = best.guess
    solution.metadata["attempts"] = [attempt.summary() for attempt in attempts]
    return solution
