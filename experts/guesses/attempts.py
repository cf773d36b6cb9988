"""The solves of a maneuver from several guesses, and the best of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import (
    Callback,
    IterationRecord,
    Solution,
    StopReason,
    as_interrupted,
    uninterrupted,
)
from experts.guesses.initial_guesses import NEAR_REGULARIZATION, Guess, zero_controls
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray, ShootingProblem
from experts.problems.window_problem import WindowProblem

SAME_MINIMUM = 1e-6
"""Minima whose costs differ by a smaller share are the same."""
START_REGULARIZATIONS = (1e2, 1e3, 1e4, 1e5)
"""First regularizations of solves of the initial state from zero controls; the cheapest solution is kept."""
NEAR_ITERATIONS = 10
"""A guess is near a minimum if that is within so many iterations."""
NEAR_ITERATIONS_CONSTRAINED = 40
"""The same where there are constraints, whose multipliers follow."""


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


class GuessSolver:
    """Box-DDP from one guess at a time, whose minimum is led to the target where it misses that.

    The tolerances become constraints then (`ArmProblem.constrained`), for which nothing is compiled before.
    """

    def __init__(self, scene_or_problem: Any, *, reach_target: bool, reserve: float, **settings: Any) -> None:
        """Prepare it: `reach_target` and `reserve` as in `GuidedDDP`, the settings are those of `BoxDDP`."""
        self._solver = BoxDDP(scene_or_problem, **settings)
        self.problem: ShootingProblem = self._solver.problem
        self.reach_target, self._reserve, self._box_settings = reach_target, reserve, settings
        self.has_constraints = getattr(self.problem, "constraints", None) is not None
        self._constrained_solver: BoxDDP | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """All that it was given, but for the problem."""
        return {**self._box_settings, "reach_target": self.reach_target, "reserve": self._reserve}

    @property
    def second_order(self) -> str:
        """Second derivatives that it uses, see `BoxDDP`."""
        return self._solver.second_order.value

    def with_model(self, second_order: str) -> "GuessSolver":
        """The same solver with other second derivatives."""
        return GuessSolver(self.problem, **{**self.settings, "second_order": second_order})

    def attempts(
        self, guess: Guess, start: FloatArray, callback: Callback | None, before: Sequence[Attempt]
    ) -> list[Attempt]:
        """Solve from a guess, and lead a minimum that ends outside the tolerances to the target.

        A minimum that one of the attempts before found was led from there.
        """
        solution = self.solve(guess, start, callback)
        attempts = [Attempt(guess.name, solution)]
        misses = solution.converged and not self.is_good(solution)
        can_be_led = isinstance(self.problem, ArmProblem | WindowProblem) and solution.constraints is None
        wanted = self.reach_target and not guess.interrupted
        if wanted and misses and can_be_led and not is_known(solution, before):
            attempts.append(Attempt(guess.name, self._led(solution, start, callback)))
        return attempts

    def _led(self, solution: Solution, start: FloatArray, callback: Callback | None) -> Solution:
        """Lead a solution to the target; where the user interrupts the compilation for that, it stays."""
        rows = self.problem.parameters.rows
        try:
            solver = self._constrained
            solver.initial_regularization = NEAR_REGULARIZATION
            return solver.solve(start, solution.controls, callback, parameters=rows)
        except KeyboardInterrupt:
            return as_interrupted(solution)

    def solve(self, guess: Guess, start: FloatArray, callback: Callback | None = None) -> Solution:
        """Solve, with the tolerances as constraints if the guess has multipliers of theirs."""
        solver = self._solver_for(guess)
        solver.initial_regularization = guess.regularization
        return solver.solve(
            start,
            guess.controls,
            _interrupt if guess.interrupted else callback,
            parameters=self.problem.parameters.rows,
            multipliers=guess.multipliers,
        )

    def best(self, attempts: Sequence[Attempt]) -> Solution:
        """Return the cheapest solution, a good one if there is any; its metadata tell of all attempts.

        Constraints of the target, which the problem does not have, are dropped where they did not help.
        """
        good = [attempt for attempt in attempts if self.is_good(attempt.solution)]
        own = [attempt for attempt in attempts if attempt.solution.problem is self.problem]
        best = min(good or own or attempts, key=lambda attempt: attempt.solution.cost)
        solution, stop = best.solution, StopReason.INFEASIBLE
        missed = [each.solution.message for each in attempts if each.solution.stop_reason is stop]
        if missed and not good and solution.stop_reason is not stop:
            solution = replace(solution, message=f"{solution.message}; but {missed[-1]}")
        solution.metadata["guess"] = best.guess
        solution.metadata["attempts"] = [attempt.summary() for attempt in attempts]
        return solution

    def solve_initial_state(self, callback: Callback | None = None) -> list[Solution]:
        """Solve the problem's own initial state from zero controls; no solution if every rollout diverges."""
        start = np.asarray(self.problem.initial_state, dtype=np.float64)
        self.problem.parameters.set(None)
        solutions: list[Solution] = []
        for regularization in START_REGULARIZATIONS:
            guess = zero_controls(regularization)
            solutions.append(uninterrupted(self.solve(guess, start, callback)))
        best = min(solutions, key=lambda solution: solution.cost)
        return [best] if np.isfinite(best.cost) else []

    def is_near_minimum(self, guess: Guess, start: FloatArray, callback: Callback | None = None) -> bool:
        """Whether a minimum is few iterations away from a guess."""
        solver = self._solver_for(guess)
        most = solver.max_iterations
        constrained = guess.multipliers is not None
        solver.max_iterations = NEAR_ITERATIONS_CONSTRAINED if constrained else NEAR_ITERATIONS
        try:
            return uninterrupted(self.solve(guess, start, callback)).converged
        finally:
            solver.max_iterations = most

    def is_good(self, solution: Solution) -> bool:
        """Whether a solution has converged, and is a success if the problem knows of any."""
        succeeds: Callable[[FloatArray, FloatArray], bool] | None = getattr(self.problem, "is_success", None)
        return solution.converged and (succeeds is None or succeeds(solution.states, solution.controls))

    def _solver_for(self, guess: Guess) -> BoxDDP:
        """The solver of a guess; its multipliers may be those of tolerances."""
        return self._solver if self.has_constraints or guess.multipliers is None else self._constrained

    @property
    def _constrained(self) -> BoxDDP:
        """The solver of the same problem with its tolerances as constraints."""
        if self._constrained_solver is None:
            problem = cast(ArmProblem | WindowProblem, self.problem).constrained(self._reserve)
            self._constrained_solver = BoxDDP(problem, **self._box_settings)
        return self._constrained_solver


def is_known(solution: Solution, attempts: Sequence[Attempt]) -> bool:
    """Whether one of the attempts found the same minimum."""
    costs = [attempt.solution.cost for attempt in attempts]
    return bool(np.isclose(costs, solution.cost, rtol=SAME_MINIMUM, atol=0.0).any())


def _interrupt(record: IterationRecord) -> None:
    """End a solve as the user ended the one before."""
    raise KeyboardInterrupt
