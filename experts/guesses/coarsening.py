"""How long a step may be: a maneuver is solved in few, long ones first.

They are short enough if the policy found in them is near a minimum in the problem's own steps. Where fast
motions bend a narrow valley it is not, though it leads there: then a solve in half the long steps comes
between. Nothing is compiled for either: the length of a step is an input of the kernels.
"""

from collections.abc import Sequence
from typing import Protocol, Self, TypeVar

import numpy as np

from experts.ddp.second_order import SecondOrder
from experts.ddp.solution import Solution
from experts.guesses.initial_guesses import STRAYED
from experts.guesses.policies import follow, refined
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import ShootingProblem

LARGEST_COARSENING = 8
"""Most steps in a long one."""
CREEPING = 30
"""Iterations in long steps beyond which Gauss-Newton's model creeps, and the mirrored one is tried."""
CHEAPER = 0.999
"""The mirrored model is taken if the cost of its minimum is below this share of Gauss-Newton's."""


class LongStepSolver(Protocol):
    """What the search asks of a solver, `GuidedDDP`."""

    problem: ShootingProblem
    chooses_model: bool  # whether the mirrored model may be taken

    @property
    def library(self) -> tuple[Solution, ...]: ...

    def in_long_steps(
        self, coarsening: Sequence[int], *, second_order: str | None = None, after: Self | None = None
    ) -> Self: ...

    def leads_to_minimum(self, coarse: Self) -> bool: ...

    def take_model(self, second_order: str) -> None: ...


S = TypeVar("S", bound=LongStepSolver)


def find_coarsening(solver: S) -> tuple[tuple[int, ...], S | None]:
    """Find the longest steps whose policy leads to the minimum in the problem's own, and their solver."""
    problem = solver.problem
    assert isinstance(problem, ArmProblem)  # others have no long steps
    for factor in range(LARGEST_COARSENING, 1, -1):
        if problem.horizon % factor == 0 and problem.can_coarsen(factor):
            coarse = _with_best_model(solver, factor)
            if solver.leads_to_minimum(coarse):
                return (factor,), coarse
            halved = _in_halved_steps(solver, coarse)
            if halved is not None and solver.leads_to_minimum(halved):
                return (factor, factor // 2), halved
    return (), None


def checked_factors(given: int | Sequence[int], problem: ShootingProblem) -> tuple[int, ...]:
    """Return the factors that are more than 1; raise ValueError if one is no multiple of the next."""
    factors = tuple(given) if isinstance(given, Sequence) else (given,)
    for factor, next_one in zip(factors, [*factors, 1][1:], strict=True):
        if not isinstance(factor, int | np.integer) or factor < 1 or factor % next_one:
            raise ValueError(
                f"coarsening is {factors}; it must be whole numbers of steps, each a multiple of the next"
            )
    found = tuple(int(factor) for factor in factors if factor > 1)
    if found and not isinstance(problem, ArmProblem):
        raise ValueError(f"coarsening is {factors}; only the maneuver of a scene has long steps")
    return found


def _with_best_model(solver: S, factor: int) -> S:
    """Make the solver in long steps, with the mirrored model from now on if that pays."""
    coarse = solver.in_long_steps((factor,))
    if solver.chooses_model and coarse.library and coarse.library[0].iterations > CREEPING:
        model = SecondOrder.MIRRORED.value
        mirrored = solver.in_long_steps((factor,), second_order=model)
        if mirrored.library and mirrored.library[0].cost < CHEAPER * coarse.library[0].cost:
            solver.take_model(model)
            return mirrored
    return coarse


def _in_halved_steps(solver: S, coarse: S) -> S | None:
    """Make the solver in half the long steps, which begins where the long ones end; None if it is no use.

    Where fast motions bend a narrow valley, most iterations lead along it: they are cheaper there. It is
    no use where long steps are so inaccurate that their policy strays in the problem's own, nor where
    half of them are those, or no whole number of them.
    """
    problem = solver.problem
    factor = problem.horizon // coarse.problem.horizon
    if factor % 2 or factor == 2 or not coarse.library:
        return None
    policy = refined(coarse.library[0], problem)
    if follow(policy, problem, problem.initial_state).cost > STRAYED * policy.cost:
        return None
    return solver.in_long_steps((factor, factor // 2), after=coarse)
