"""Problems of one's own beside Crocoddyl: iterations, milliseconds, optimum.

Both solvers call the same compiled kernels, see `crocoddyl_kernels`: step, costs and first derivatives agree
to the last bit, and so do the costs of the same controls. What is compared are the solvers. Ours runs its
iterations from Python, some 0.1 ms each; Crocoddyl is C++ throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from time import perf_counter

import numpy as np

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.second_order import SecondOrder
from experts.ddp.solution import uninterrupted
from experts.problems.casadi_problem import CasadiProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note
from scripts.benchmarks.peers import crocoddyl_kernels
from scripts.benchmarks.solvers.runs import TITLES
from scripts.examples.cart_pole import cart_pole
from scripts.examples.planar_quadrotor import HOVER, planar_quadrotor

GAP = 1e-5  # largest gap to the best cost that the default variant may leave
_PROBLEMS: dict[str, tuple[Callable[[], CasadiProblem], float]] = {
    "cart-pole": (cart_pole, 0.0),
    "planar quadrotor": (planar_quadrotor, HOVER),
}
"""Problems, and the constant controls from which they are solved."""

Solve = Callable[[], tuple[float, float, int, bool]]
"""A solve; returns cost of the controls in our problem, seconds, iterations, and whether it converged."""


def measure_own_problems(effort: Effort) -> Iterator[Row]:
    """Solve each problem with each solver."""
    missing = crocoddyl_kernels.obstacle() if effort.peers else "Other solvers are left out."
    if missing is not None:
        yield note(missing)
    for name, (make, first) in _PROBLEMS.items():
        problem = make()
        controls = np.full((problem.horizon, problem.n_controls), first)
        solves = {
            f"BoxDDP, {TITLES[variant]}": _ours(problem, controls, variant, effort) for variant in SecondOrder
        }
        if missing is None:
            for method in crocoddyl_kernels.METHODS:
                solves[f"Crocoddyl {method}"] = _crocoddyl(problem, controls, method, effort)
        rows = list(_rows(name, solves, effort.repeats))
        best = min(row["cost"] for row in rows)
        for row in rows:
            yield {**row, "above_best": row["cost"] / best - 1.0}
        default = next(row for row in rows if row["solver"] == f"BoxDDP, {TITLES[SecondOrder.HYBRID]}")
        gap = default["cost"] / best - 1.0
        yield claim("own problems", name, default["solver"], gap, GAP, note="above the best cost, relative")


def _rows(name: str, solves: Mapping[str, Solve], repeats: int) -> Iterator[Row]:
    """Solve once for warming up, then in turns with a clock."""
    runs = [{solver: solve() for solver, solve in solves.items()} for _ in range(repeats + 1)][1:]
    for solver, (cost, _, iterations, converged) in runs[-1].items():
        milliseconds = [1e3 * run[solver][1] for run in runs]
        row = {"table": "own problems", "name": name, "solver": solver, "iterations": iterations}
        row |= {"converged": converged, "cost": cost, "median_ms": float(np.median(milliseconds))}
        yield row | {"best_ms": min(milliseconds), "ms_per_iteration": min(milliseconds) / max(iterations, 1)}


def _ours(problem: CasadiProblem, controls: FloatArray, variant: SecondOrder, effort: Effort) -> Solve:
    solver = BoxDDP(problem, second_order=variant, max_iterations=effort.max_iterations)

    def solve() -> tuple[float, float, int, bool]:
        started = perf_counter()
        solution = uninterrupted(solver.solve(u_init=controls))
        return solution.cost, perf_counter() - started, solution.iterations, solution.converged

    return solve


def _crocoddyl(problem: CasadiProblem, controls: FloatArray, method: str, effort: Effort) -> Solve:
    replay = BoxDDP(problem, max_iterations=0)

    def solve() -> tuple[float, float, int, bool]:
        found, seconds, _, converged = crocoddyl_kernels.solve_with_crocoddyl(
            problem, controls, method=method, max_iterations=effort.max_iterations
        )
        cost = uninterrupted(replay.solve(u_init=found)).cost
        return cost, float(seconds[-1]), len(seconds), converged

    return solve
