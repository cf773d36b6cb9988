"""Constrained maneuvers from random starts: the expert, IPOPT, fatrop and Crocoddyl, all from zero controls.

`GuidedDDP` also has its own guesses. Crocoddyl has penalties, see `crocoddyl_penalties`. Steps are long:
CasADi interprets the derivatives of a thousand short ones for minutes. A maneuver is solved where the solver
says so and its controls, rolled out in our problem, keep to all rows and reach the target.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from dq_space_arm_env import load_scene
from experts.ddp.second_order import SecondOrder
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note
from scripts.benchmarks.peers import crocoddyl_kernels, crocoddyl_penalties, interior_point_peer
from scripts.benchmarks.peers.transcription import not_given
from scripts.benchmarks.solvers.random_starts import draw_starts
from scripts.benchmarks.solvers.runs import (
    GUIDED,
    INTERIOR_POINT,
    Solve,
    SolverRun,
    box_ddp,
    guided_ddp,
    relative_gap,
    roll_out,
)

SCENES = (
    "joint-limits",
    "keep-out",
    "pointing",
    "line-of-sight",
    "approach-corridor",
    "wheel-saturation",
)
STEPS, MOST_STARTS, MOST_ITERATIONS, TOLERANCE = 50, 20, 150, 1e-6
"""Stages, random starts, and iterations and tolerance of the interior-point methods."""
FEASIBLE = 1e-5
"""Largest violation of a row, in its unit, by controls that are rolled out."""
UNSOLVED = 0.1
"""Largest share of starts that `GuidedDDP` may not solve."""
SAME, EQUAL = 1e-3, 1e-6
"""Gap of costs below which two minima are the same, and the largest that is claimed there."""


def measure_constrained(effort: Effort) -> Iterator[Row]:
    """Solve random starts of scenes with constraints with each solver."""
    if not (effort.peers and effort.slow_peers):
        sentence = "they take minutes; --set slow_peers=true or --full have them"
        yield note(f"Constrained maneuvers beside IPOPT and fatrop are left out: {sentence}.")
        return
    missing = crocoddyl_kernels.obstacle()
    if missing is not None:
        yield note(missing)
    for name in effort.scenes or SCENES:
        scene = load_scene(name)
        if not scene.constraints:
            continue
        duration = scene.simulation.dt * scene.simulation.steps
        problem = ArmProblem(scene.replace(simulation={"steps": STEPS, "dt": duration / STEPS}))
        solvers: dict[str, Solve] = {
            GUIDED: guided_ddp(problem, GuidedDDP(problem, max_iterations=effort.max_iterations)),
            "BoxDDP": box_ddp(problem, SecondOrder.HYBRID, effort.max_iterations),
        }
        if more := not_given(scene):
            yield note(f"IPOPT and fatrop are left out of scene {name}: they are not given {more}.")
        for each in () if more else filter(interior_point_peer.is_available, INTERIOR_POINT):
            solvers[each] = interior_point_peer.InteriorPoint(
                problem, each, max_iterations=MOST_ITERATIONS, tolerance=TOLERANCE
            ).solve
        if missing is None:
            solve = partial(crocoddyl_penalties.solve_with_penalties, problem)
            solvers[crocoddyl_penalties.CROCODDYL] = partial(solve, max_iterations=effort.max_iterations)
        rows: list[Row] = []
        for number, x0 in enumerate(draw_starts(problem, min(effort.starts, MOST_STARTS), effort.seed)):
            runs = {each: solve(x0) for each, solve in solvers.items()}
            rows += compared(problem, number, x0, runs)
            yield from rows[-len(runs) :]
        for each in solvers:
            yield from summarized(name, each, [row for row in rows if row["solver"] == each])
        yield from claims(name, rows)


def claims(scene: str, rows: Sequence[Row]) -> Iterator[Row]:
    """That the expert solves the starts, and finds what others find in the same minimum."""
    ours = [row["solved"] for row in rows if row["solver"] == GUIDED]
    remark = "share of random starts that are not solved"
    yield claim("constrained", scene, GUIDED, ours.count(False) / len(ours), UNSOLVED, note=remark)
    largest = max((row["above_same"] for row in rows if row["above_same"] is not None), default=None)
    if largest is not None:
        yield claim("constrained", scene, "expert", largest, EQUAL, note="J above theirs in the same minimum")


def compared(problem: ArmProblem, start: int, x0: FloatArray, runs: Mapping[str, SolverRun]) -> Iterator[Row]:
    """A row for each solver; costs above the best that is solved, and ours above theirs."""
    violations = {each: violation(problem, x0, run) for each, run in runs.items()}
    solved = [each for each, run in runs.items() if run.converged and violations[each] <= FEASIBLE]
    best = min((runs[each].replayed_cost for each in solved), default=np.inf)
    peers = (*INTERIOR_POINT, crocoddyl_penalties.CROCODDYL)
    theirs = [runs[each].replayed_cost for each in peers if each in solved]
    for each, run in runs.items():
        gaps = [relative_gap(run.replayed_cost, cost) for cost in theirs]
        same = [gap for gap in gaps if each in solved and each not in peers and abs(gap) <= SAME]
        yield {
            "table": "constrained",
            "scene": problem.scene.name,
            "start": start,
            "solver": each,
            "solved": each in solved,
            "converged": run.converged,
            "violation": violations[each],
            "cost": run.replayed_cost,
            "above_best": relative_gap(run.replayed_cost, best) if each in solved else None,
            "above_same": max(same, default=None),
            "iterations": run.iterations,
            "seconds": float(run.seconds[-1]),
            "sweep_ms": run.parts.get("sweep"),
            "stop_reason": run.stop_reason,
        }


def violation(problem: ArmProblem, x0: FloatArray, run: SolverRun) -> float:
    """Largest violation of a row by controls that are rolled out."""
    states = roll_out(problem, x0, run.controls).states
    rows = problem.constraints
    assert rows is not None  # or the scene is left out
    residuals = rows.find(states, run.controls)
    return float(np.where(rows.equalities, np.abs(residuals), residuals).max())


def summarized(scene: str, solver: str, rows: Sequence[Row]) -> Iterator[Row]:
    """The share of solved starts, medians over these, and the share over time."""
    solved = sorted((row for row in rows if row["solved"]), key=lambda row: row["seconds"])
    summary: Row = {"table": "constrained summaries", "scene": scene, "solver": solver, "starts": len(rows)}
    summary["solved"] = len(solved) / len(rows)
    summary["best"] = sum(row["above_best"] <= SAME for row in solved) / len(rows)
    for key in ("iterations", "seconds", "sweep_ms"):
        known = [row[key] for row in solved if row[key] is not None]
        summary[key] = float(np.median(known)) if known else None
    yield summary
    for count, row in enumerate(solved, 1):
        share = {"seconds": row["seconds"], "share": count / len(rows)}
        yield {"table": "solved shares", "scene": scene, "solver": solver, **share}
