"""The expert from random starts: how often it converges and succeeds, how soon, and how good its minima are.

The starts are the episodes of `env.reset(seed=)`, with the targets and masses that they draw. The minima are
compared with the best from `FURTHER_GUESSES` others: policies of maneuvers from other starts, the tip's screw
motion where they stray, zero controls.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.scene.start import draw_initial_state
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from experts.report.expert_trials import compile_constraints, solve_episode
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim
from scripts.benchmarks.solvers.runs import GUIDED, relative_gap

FURTHER_GUESSES = 12
JUDGES_SEED = 1_000_000
"""First seed of the maneuvers whose policies the judge follows."""
CLOSE = 1e-4
"""A cost counts as the best known one if it is higher by no more than this share."""
UNSOLVED, MISSED = 0.01, 0.1
"""Largest shares of starts that `GuidedDDP` may not solve (converged, and within the tolerances), and from
which it may miss the best known minimum."""
MANY_MINIMA = {"six-joint": (0.05, 0.6)}
"""The same for scenes with many minima."""


def draw_starts(problem: ArmProblem, count: int, seed: int) -> list[FloatArray]:
    """Draw states from a scene's spread; the first ones of a seed are the same however many there are."""
    rng = np.random.default_rng(seed)
    return [draw_initial_state(problem.scene, rng) for _ in range(count)]


def measure_starts(
    problem: ArmProblem, guided: GuidedDDP, preparation: float, effort: Effort
) -> Iterator[Row]:
    """Solve episodes; then a summary of the scene, and the claims. The preparation took so many seconds."""
    scene = problem.scene.name
    compile_constraints(guided)
    env, judge = DQSpaceArmEnv(problem.scene), _judge(problem, guided, effort)
    rows: list[Row] = []
    for seed in range(effort.seed, effort.seed + effort.starts):
        ours, best = (solve_episode(solver, env, seed) for solver in (guided, judge))
        rows.append({"table": "random starts", "scene": scene, "solver": GUIDED, **judged(ours, best)})
        yield rows[-1]
    facts = {"coarsening": ", ".join(map(str, guided.coarsening)), "preparation_s": preparation}
    summary = {"table": "start summaries", "scene": scene, **facts, **summarized(rows)}
    yield summary
    unsolved, missed = MANY_MINIMA.get(scene, (UNSOLVED, MISSED))
    for remark, share, bound in (
        ("share of random starts that are not solved", summary["unsolved"], unsolved),
        ("share of random starts whose minimum is not the best known", summary["missed"], missed),
    ):
        yield claim("random starts", f"scene {scene}", GUIDED, share, bound, note=remark)


def judged(ours: Mapping[str, Any], best: Mapping[str, Any]) -> Row:
    """Our row with the cost above the lower of both; a solve that fails is worse than one that does not."""
    good, bests = (row["converged"] and row["success"] for row in (ours, best))
    gap = relative_gap(ours["cost"], min(ours["cost"], best["cost"]))
    if good != bests:
        gap = 0.0 if good else np.inf
    return {**ours, "best_cost": best["cost"], "best_is_good": bests, "gap": gap}


def summarized(rows: Sequence[Row]) -> Row:
    """Shares, and median and 90th percentile of iterations and time."""
    solved, close = (
        [row["converged"] and row["success"] for row in rows],
        [row["gap"] <= CLOSE for row in rows],
    )
    summary: Row = {
        "starts": len(rows),
        "converged": float(np.mean([row["converged"] for row in rows])),
        "succeeded": float(np.mean([row["success"] for row in rows])),
        "both": float(np.mean(solved)),
        "close": float(np.mean(close)),
        # Not 1 less the others: 1 - 0.99 is more than 0.01.
        "unsolved": float(np.mean(np.logical_not(solved))),
        "missed": float(np.mean(np.logical_not(close))),
    }
    for key in ("iterations", "long_step_iterations", "seconds"):
        median, high = np.percentile([row[key] for row in rows], (50, 90))
        summary |= {f"{key}_median": float(median), f"{key}_90": float(high)}
    return summary


def _judge(problem: ArmProblem, guided: GuidedDDP, effort: Effort) -> GuidedDDP:
    """A solver like ours with other guesses."""
    env, library = DQSpaceArmEnv(problem.scene), []
    for seed in range(JUDGES_SEED, JUDGES_SEED + FURTHER_GUESSES):
        env.reset(seed=seed)
        state = np.asarray(env.state, dtype=np.float64)
        library.append(uninterrupted(guided.solve(state, parameters=env.parameters)))
    return GuidedDDP(
        problem,
        library=library,
        attempts=FURTHER_GUESSES,
        compare=not guided.coarsening,  # in long steps they are compared there
        max_iterations=effort.max_iterations,
    )
