"""The expert from random starts of a scene: share of converged and successful solves, and their times."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import cast

import numpy as np

from dq_space_arm_env.common.report_page import Section
from dq_space_arm_env.common.tables import Column, Row
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.scene import Scene
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.report.effort import Announce, Effort

_QUANTILES = {"least": 0.0, "median": 0.5, "90 %": 0.9, "most": 1.0}


def measure(scene: Scene, effort: Effort, announce: Announce) -> dict[str, list[Row]]:
    """Solve the episodes of `env.reset(seed=)`."""
    # Without a spread, all starts are the scene's own.
    starts = effort.starts if any(scene.spread.model_dump().values()) else 1
    announce("the scene's own start", 0, starts + 1)
    expert = GuidedDDP(scene, max_iterations=effort.max_iterations)
    expert.prepare()  # now, so that it does not count as time of the first start
    compile_constraints(expert)
    env = DQSpaceArmEnv(scene)
    rows: list[Row] = []
    for seed in range(starts):
        announce(f"start {seed}", seed + 1, starts + 1)
        rows.append(solve_episode(expert, env, seed))
    return {"starts": rows}


def compile_constraints(expert: GuidedDDP) -> None:
    """Compile what leads a maneuver to the target: `prepare` leaves it to the first start that needs it.

    No maneuver is within no tolerance, a reserve of 1: all of it is needed.
    """
    problem = cast(ArmProblem, expert.problem)
    if problem.constraints is None:  # its tolerances become some
        for each in (problem, *map(problem.coarsened, expert.coarsening)):
            exacting, model = each.constrained(reserve=1.0), expert.second_order
            uninterrupted(BoxDDP(exacting, max_iterations=50, second_order=model).solve())


def solve_episode(expert: GuidedDDP, env: DQSpaceArmEnv, seed: int) -> Row:
    """Solve the episode that begins with a seed; KeyboardInterrupt if the user interrupts it."""
    env.reset(seed=seed)
    began = perf_counter()
    state = np.asarray(env.state, dtype=np.float64)
    solution = uninterrupted(expert.solve(state, parameters=env.parameters))
    seconds = perf_counter() - began
    problem = cast(ArmProblem, expert.problem)
    errors = problem.kernels.tip_errors(solution.states[-1], p=solution.parameters[-1])
    angle, distance = errors[:2].tolist()
    attempts = solution.metadata.get("attempts", ())
    return {
        "seed": seed,
        "converged": solution.converged,
        "success": problem.is_success(solution.states, solution.controls),
        "iterations": sum(attempt["iterations"] for attempt in attempts) or solution.iterations,
        "long_step_iterations": sum(a["iterations"] for a in solution.metadata.get("long_steps", ())),
        "seconds": seconds,
        "cost": solution.cost,
        "attitude_error_deg": angle,
        "position_error_m": distance,
        "guess": str(solution.metadata.get("guess", "")),
    }


def section(scene: Scene, found: dict[str, list[Row]]) -> Section:
    """The section of the report."""
    rows = found["starts"]
    made = Section(
        "expert",
        "The expert from random starts",
        f"GuidedDDP solves the scene from {len(rows)} starts, those of env.reset(seed=0) and the next seeds. "
        "Success: what is to be caught is caught, and the tip ends within the scene's tolerances.",
    )
    shares = {name: sum(bool(row[name]) for row in rows) / len(rows) for name in ("converged", "success")}
    made.add_rows(
        "shares",
        [{"starts": len(rows), **shares}],
        ["starts", Column("converged", format=".0%"), Column("success", format=".0%")],
        "Of all starts",
    )
    made.add_rows("quantiles", _quantiles(rows), title="Distributions")
    failed = [row for row in rows if not (row["converged"] and row["success"])]
    if failed:
        made.add_rows(
            "failed",
            failed,
            ["seed", "converged", "success", "iterations", "cost", "attitude_error_deg", "position_error_m"],
            "Starts that failed\n`dq-space-arm solve SCENE --seed N` repeats them",
        )
    if len(rows) == 1:
        made.notes.append("The scene draws no starts (its spread is empty): only its own start is solved.")

    def draw() -> bytes:
        from experts.figures.plots import Plot

        shown = [{**row, "outcome": _outcome(row)} for row in rows]
        labels = {"seconds": "time of the solve [s]", "cost": "cost J [$-$]"}
        return Plot("seconds", "cost", color="outcome", join=False, labels=labels).png(shown)

    made.add_figure("expert", "Cost over time of each solve.", draw)
    return made


def _outcome(row: Row) -> str:
    converged = "converged" if row["converged"] else "not converged"
    return f"{converged}, {'success' if row['success'] else 'no success'}"


def _quantiles(rows: Sequence[Row]) -> list[Row]:
    """Distributions of what is known: a start that diverged has no cost."""
    found: list[Row] = []
    for name in ("iterations", "long_step_iterations", "seconds", "cost"):
        known = [row[name] for row in rows if row[name] is not None]
        shares = {title: float(np.quantile(known, q)) if known else None for title, q in _QUANTILES.items()}
        found.append({"quantity": name, **shares})
    return found
