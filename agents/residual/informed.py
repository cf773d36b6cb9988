"""Optimal costs of an expert that knows the true masses, and meets neither noise nor pushes.

Solved in groups of starts, in one scene for all masses, and cached: an interrupted computation resumes.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from agents.evaluation.expert_costs import OptimalCosts
from agents.evaluation.kept_results import CachedGroups, Row
from agents.evaluation.plan_followers import follower
from agents.evaluation.planned_flights import agents_source
from agents.evaluation.plans import FloatArray, Plans
from dq_space_arm_env import Scene
from dq_space_arm_env.environment.disturbances import with_loads
from dq_space_arm_env.environment.rollouts import rollout
from experts import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.demonstrations import Demonstrations
from experts.problems.arm_problem import ArmProblem

SOURCES = (
    *("evaluation/conditions.py", "evaluation/plan_followers.py", "evaluation/plans.py", "policies"),
    *(f"residual/{name}.py" for name in ("corrections", "informed", "mismatch", "mismatch_comparison")),
)
"""Files and folders of this package that flights under mismatch follow from."""
_GROUP = 16


def informed_costs(
    scene: Scene,
    demonstrations: Demonstrations,
    plans: Plans,
    mass_factor: float,
    progress: Callable[[int, int], None] = lambda done, starts: None,
) -> OptimalCosts:
    """Look up the informed expert's costs from where demonstrations begin; solve those that are missing.

    With nominal masses they are the costs of the demonstrations. Else the solver starts from a flight of the
    plan with gains in the changed scene.
    """
    seeds = demonstrations.column("seed")
    if mass_factor == 1.0:
        costs, count = demonstrations.column("cost").astype(np.float64), len(seeds)
        return OptimalCosts(seeds, costs, np.ones(count, dtype=np.bool_), np.full(count, np.nan))
    changed, parameters = with_loads(scene, np.full(len(plans), mass_factor), plans.known)
    follows_from = {
        "plans": dict(demonstrations.settings),
        "seeds": seeds.tolist(),
        "solved in": scene.content_hash(),
        "mass factor": mass_factor,
        "agents": agents_source(SOURCES),
    }
    columns = ("seed", "cost", "is_success", "seconds")
    files = CachedGroups("informed-costs", follows_from, columns, seeds.tolist(), _GROUP)
    progress(len(files.rows), len(seeds))
    problem = ArmProblem(changed)
    solver = BoxDDP(problem) if files.missing else None
    for group in files.missing:
        assert solver is not None
        rows = slice(group * _GROUP, (group + 1) * _GROUP)
        few = plans.choose(plans.chosen[rows])
        following = follower(scene, few, feedback=True)
        flown = rollout(following, changed, starts=few.starts, parameters=parameters[rows], record=True)
        assert flown.controls is not None
        starts = zip(files.seeds(group), few.starts, flown.controls, flown.parameters, strict=True)
        files.add(group, [_solved(problem, solver, *start) for start in starts])
        progress(len(files.rows), len(seeds))
    return OptimalCosts.of(files.rows)


def _solved(
    problem: ArmProblem,
    solver: BoxDDP,
    seed: int,
    start: FloatArray,
    guess: FloatArray,
    parameters: FloatArray,
) -> Row:
    began = perf_counter()
    solution = uninterrupted(solver.solve(x0=start, u_init=guess, parameters=parameters))
    return {
        "seed": seed,
        "cost": solution.cost if solution.converged else None,
        "is_success": problem.is_success(solution.states, solution.controls),
        "seconds": perf_counter() - began,
    }
