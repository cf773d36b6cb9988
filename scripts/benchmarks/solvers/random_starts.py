"""Solves from random starts: how often each solver converges, succeeds, and finds the best minimum known.

The starts are drawn from the scene's spread of states; target and masses are the scene's, also where the
environment draws them. Whether the cheapest maneuver succeeds depends on the weights of the cost and the
reach of the robot; `GuidedDDP` trades a little of the cost for success.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import perf_counter

import numpy as np

from dq_space_arm_env.scene.start import draw_initial_state
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.second_order import SecondOrder
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note, select
from scripts.benchmarks.solvers.runs import GUIDED, TITLES, Search, relative_gap, uninterrupted

CLOSE = 0.01  # a cost counts as the best known one if it is higher by no more than this share
UNSOLVED = 0.01
"""Largest share of random starts that `GuidedDDP` may not solve: converged, and within the tolerances."""


def draw_starts(problem: ArmProblem, count: int, seed: int) -> list[FloatArray]:
    """Draw starts from a scene's spread; the first ones of a seed are the same however many there are."""
    rng = np.random.default_rng(seed)
    return [draw_initial_state(problem.scene, rng) for _ in range(count)]


def measure_starts(problem: ArmProblem, guided: GuidedDDP, effort: Effort) -> Iterator[Row]:
    """Solve from random starts; then a summary for each solver, and the claim."""
    rows = []
    for row in solve_starts(problem, guided, effort, draw_starts(problem, effort.starts, effort.seed)):
        rows.append(row)
        yield row
    for row in summarize_starts(rows):
        yield row
        if row["solver"] == GUIDED:
            unsolved, remark = 1.0 - row["both"], "share of random starts that are not solved"
            yield claim("random starts", f"scene {row['scene']}", GUIDED, unsolved, UNSOLVED, note=remark)
    yield note(
        f"Scene {problem.scene.name}: from {missing_share(rows):.1%} of the starts the cheapest known "
        "maneuver ends outside the tolerances, because the scene weighs error against effort. GuidedDDP then "
        "emphasizes the final pose as far as it takes."
    )


def solve_starts(
    problem: ArmProblem, guided: GuidedDDP, effort: Effort, states: Sequence[FloatArray]
) -> Iterator[Row]:
    """A row for each start and solver."""
    solvers: dict[str, BoxDDP | GuidedDDP] = {
        TITLES[variant]: BoxDDP(problem, second_order=variant, max_iterations=effort.max_iterations)
        for variant in (SecondOrder.GAUSS_NEWTON, SecondOrder.HYBRID)
    }
    solvers[GUIDED] = guided
    search = Search(problem, guided.library, effort.max_iterations)
    for index, state in enumerate(states):
        found = []
        for name, solver in solvers.items():
            started = perf_counter()
            solution = uninterrupted(solver.solve(state))
            found.append((name, solution, perf_counter() - started))
        solutions = [*(solution for _, solution, _ in found), *search.solutions(state)]
        best = min(solutions, key=lambda solution: solution.cost)
        for name, solution, seconds in found:
            attempts = solution.metadata.get("attempts", ()) or ({"iterations": solution.iterations},)
            yield {
                "table": "random starts",
                "scene": problem.scene.name,
                "start": index,
                "solver": name,
                "cost": solution.cost,
                "iterations": sum(attempt["iterations"] for attempt in attempts),
                "seconds": seconds,
                "converged": solution.converged,
                "is_success": problem.is_success(solution.states[-1]),
                "best_cost": best.cost,
                "best_is_success": problem.is_success(best.states[-1]),
            }


def summarize_starts(rows: Sequence[Row]) -> Iterator[Row]:
    """Shares, and median and 90th percentile of iterations and time, of each solver."""
    for solver in dict.fromkeys(row["solver"] for row in rows):
        own = select(rows, solver=solver)
        close = [relative_gap(row["cost"], row["best_cost"]) <= CLOSE for row in own]
        summary: Row = {
            "table": "start summaries",
            "scene": own[0]["scene"],
            "starts": len(own),
            "solver": solver,
            "converged": float(np.mean([row["converged"] for row in own])),
            "succeeded": float(np.mean([row["is_success"] for row in own])),
            "both": float(np.mean([row["converged"] and row["is_success"] for row in own])),
            "close_to_best": float(np.mean(close)),
        }
        for key in ("iterations", "seconds"):
            median, high = np.percentile([row[key] for row in own], (50, 90))
            summary |= {f"{key}_median": float(median), f"{key}_90": float(high)}
        yield summary


def missing_share(rows: Sequence[Row]) -> float:
    """Share of the starts whose best known minimum is no success."""
    return float(np.mean([not row["best_is_success"] for row in rows]))
