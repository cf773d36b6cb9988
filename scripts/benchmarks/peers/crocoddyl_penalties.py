"""Crocoddyl on a maneuver with constraints: quadratic penalties on the expert's rows, in rounds.

The actions of `crocoddyl_kernels` call the scene's own kernels for rows and slopes too.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.crocoddyl_kernels import CONSTRAINTS, KERNELS, MANIFOLD, problem_of, solve
from scripts.benchmarks.solvers.runs import SolverRun, costs_of, roll_out

CROCODDYL = "Crocoddyl"
"""Its name in tables of constrained maneuvers."""
FIRST_WEIGHT, WEIGHT_FACTOR, ROUNDS = 1e2, 10.0, 8
"""Penalty of constraints in the first of several solves, and its growth from one to the next."""
ALLOWED = 1e-6
"""Violation of a row, in its unit, after which no further round follows."""


def solve_with_penalties(problem: ArmProblem, x0: FloatArray | None, max_iterations: int) -> SolverRun:
    """Solve a maneuver with constraints from zero controls: `SolverBoxFDDP` with quadratic penalties.

    Each round begins with the controls of the one before, and with a larger weight. They end where no row is
    violated by more than `ALLOWED`, or iterations are used up. It has converged if the last round has.
    """
    start = problem.initial_state if x0 is None else x0
    problem.parameters.set(None)
    rows = problem.constraints
    assert rows is not None  # or there is nothing to penalize
    names = {name: name for name in (*KERNELS, *MANIFOLD, *CONSTRAINTS)}
    names["terminal_cost"] = "emphasized_terminal_cost"
    kernel = partial(problem.kernels.kernel, integrator=problem.integrator, lanes=1)
    kernels = {key: kernel(name) for key, name in names.items()}
    given, kept = problem_of(problem, start, np.ascontiguousarray(problem.parameters.rows), kernels)
    controls = first = np.zeros((problem.horizon, problem.n_controls))
    seconds, iterations, converged, violation = 0.0, 0, False, np.inf
    for number in range(ROUNDS):
        given.weight = FIRST_WEIGHT * WEIGHT_FACTOR**number
        controls, times, _, converged = solve(given, controls, 1, max_iterations - iterations)
        seconds, iterations = seconds + float(times[-1]), iterations + len(times)
        found = rows.find(roll_out(problem, start, controls).states, controls)
        violation = float(np.where(rows.equalities, np.abs(found), found).max())
        if violation <= ALLOWED or iterations >= max_iterations:
            break
    del kept
    costs = costs_of(problem, start, [first, controls])
    return SolverRun(
        solver=CROCODDYL,
        costs=costs,
        seconds=np.array([0.0, seconds]),
        iterations=iterations,
        converged=converged,
        stop_reason=f"violation {violation:.0e} with weight {given.weight:.0e}",
        controls=controls,
        replayed_cost=float(costs[-1]),
        parts={},
    )
