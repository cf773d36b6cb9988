"""The lowest cost that many guesses lead to: what a solver's result is compared with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from experts.arm_problem import ArmProblem
from experts.box_ddp import BoxDDP
from experts.guesses import POLICY_REGULARIZATION, follow
from experts.models import SecondOrder
from experts.problem import FloatArray
from experts.report.solvers.ours import uninterrupted
from experts.solution import Solution

FIRST_DAMPINGS = (1e2, 1e4, 1e5)
"""First dampings of solves from zero controls, besides the default; they lead to different minima."""


class Search:
    """Looks for low costs from a start with guesses and dampings that the compared solvers do not use."""

    def __init__(self, problem: ArmProblem, library: Sequence[Solution], max_iterations: int) -> None:
        """Prepare the solvers.

        Args:
            problem: The problem.
            library: Solved maneuvers of it, whose policies are guesses.
            max_iterations: Largest number of iterations from one guess.
        """
        self._problem, self._library = problem, tuple(library)
        self._hybrid = BoxDDP(problem, max_iterations=max_iterations)
        self._gauss_newton = BoxDDP(
            problem,
            max_iterations=max_iterations,
            second_order=SecondOrder.GAUSS_NEWTON,
            initial_regularization=POLICY_REGULARIZATION,
        )

    def solutions(self, x0: FloatArray | None) -> Iterable[Solution]:
        """Solve from a start again and again.

        Args:
            x0: State at stage 0, shape (n_x,), units of the state; the problem's initial state if None.

        Yields:
            Solutions; the controls of the first library member's policy are a guess, zero controls are
            another.

        Raises:
            KeyboardInterrupt: If the user interrupts.
        """
        for damping in FIRST_DAMPINGS:
            self._hybrid.initial_regularization = damping
            yield uninterrupted(self._hybrid.solve(x0))
        start = self._problem.initial_state if x0 is None else x0
        for member in self._library[:1]:
            controls, _ = follow(member, self._problem, start)
            yield uninterrupted(self._gauss_newton.solve(x0, controls))
