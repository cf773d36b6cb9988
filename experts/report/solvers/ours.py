"""The project's own solvers, each making a `SolverRun` from a start.

The clock runs while they solve: work arrays are allocated, and a library of maneuvers is solved, before it.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from experts.arm_problem import ArmProblem
from experts.box_ddp import BoxDDP
from experts.guesses import GuidedDDP, follow
from experts.models import SecondOrder
from experts.paper_problem import PaperProblem
from experts.problem import FloatArray
from experts.progress import Callback
from experts.report.solvers.rollouts import roll_out
from experts.report.solvers.runs import SolverRun
from experts.solution import IterationRecord, Solution, StopReason

TITLES = {
    SecondOrder.GAUSS_NEWTON: "Gauss-Newton",
    SecondOrder.EXACT: "exact",
    SecondOrder.HYBRID: "hybrid",
}
"""The variants of `BoxDDP` in tables."""
GUIDED = "GuidedDDP"
PAPERS_STATES = "paper's states"

Solve = Callable[[FloatArray | None], SolverRun]
"""A solver, ready to solve from a state of our problem, shape (n_x,); from the initial state if None."""


def box_ddp(problem: ArmProblem, second_order: SecondOrder, max_iterations: int) -> Solve:
    """Prepare a variant of `BoxDDP`, which starts from zero controls.

    Args:
        problem: The problem.
        second_order: The variant.
        max_iterations: Largest number of iterations.

    Returns:
        The solver.
    """
    solver = BoxDDP(problem, second_order=second_order, max_iterations=max_iterations)

    def solve(x0: FloatArray | None) -> SolverRun:
        return _timed_run(
            TITLES[second_order],
            problem,
            x0,
            lambda callback: solver.solve(x0, callback=callback),
            _zero_control_cost(problem, x0),
        )

    return solve


def guided_ddp(problem: ArmProblem, solver: GuidedDDP) -> Solve:
    """Prepare `GuidedDDP`; its library is solved now.

    Args:
        problem: The problem.
        solver: Made for it.

    Returns:
        The solver. It starts from the policy of a maneuver of the library.
    """
    library = solver.library

    def solve(x0: FloatArray | None) -> SolverRun:
        start = problem.initial_state if x0 is None else x0
        first_cost = min((follow(member, problem, start)[1] for member in library), default=np.inf)
        return _timed_run(
            GUIDED, problem, x0, lambda callback: solver.solve(x0, callback=callback), first_cost
        )

    return solve


def papers_states(problem: ArmProblem, max_iterations: int) -> Solve:
    """Prepare `BoxDDP` on the paper's own formulation, from zero controls; its integrator is always RK4.

    Args:
        problem: The problem in minimal coordinates, whose integrator is RK4.
        max_iterations: Largest number of iterations.

    Returns:
        The solver.
    """
    redundant = PaperProblem(problem.scene)
    solver = BoxDDP(redundant, max_iterations=max_iterations)

    def solve(x0: FloatArray | None) -> SolverRun:
        start = None if x0 is None else redundant.from_minimal(x0)
        return _timed_run(
            PAPERS_STATES,
            problem,
            x0,
            lambda callback: solver.solve(start, callback=callback),
            _zero_control_cost(problem, x0),
        )

    return solve


def uninterrupted(solution: Solution) -> Solution:
    """Pass a solution on.

    Args:
        solution: What a solver returned.

    Returns:
        The same.

    Raises:
        KeyboardInterrupt: If the user interrupted the solve.
    """
    if solution.stop_reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    return solution


def _timed_run(
    name: str,
    problem: ArmProblem,
    x0: FloatArray | None,
    solve: Callable[[Callback], Solution],
    first_cost: float,
) -> SolverRun:
    """Solve with a clock; where several guesses are solved, the costs are the lowest so far."""
    costs, stamps, records = [first_cost], [0.0], []
    started = perf_counter()

    def look_at_clock(record: IterationRecord) -> None:
        stamps.append(perf_counter() - started)
        costs.append(min(costs[-1], record.cost))
        records.append(record)

    solution = uninterrupted(solve(look_at_clock))
    fields = {
        "derivatives": "derivative_seconds",
        "sweep": "sweep_seconds",
        "rollout": "rollout_seconds",
    }
    parts = {part: _median_ms([getattr(record, name) for record in records]) for part, name in fields.items()}
    return SolverRun(
        solver=name,
        costs=np.array(costs),
        seconds=np.array(stamps),
        iterations=len(records),
        converged=solution.converged,
        stop_reason=solution.stop_reason.value,
        controls=solution.controls,
        replayed_cost=_cost(problem, solution.controls, x0),
        parts=parts if records else {},
    )


def _median_ms(seconds: list[float]) -> float:
    return 1e3 * float(np.median(seconds)) if seconds else 0.0


def _zero_control_cost(problem: ArmProblem, x0: FloatArray | None) -> float:
    return _cost(problem, np.zeros((problem.horizon, problem.n_controls)), x0)


def _cost(problem: ArmProblem, controls: FloatArray, x0: FloatArray | None) -> float:
    return roll_out(problem, problem.initial_state if x0 is None else x0, controls).cost
