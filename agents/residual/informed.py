"""What the expert pays who knows the masses, and meets neither noise nor pushes.

It is solved in groups of starts, once for each mass, and kept in the cache folder: what is interrupted goes
on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.comparison.planned_flights import agents_source
from agents.evaluation.cached_groups import CachedGroups, known_groups
from agents.plans import FloatArray, Plans
from agents.residual.controllers import Controller, GainScheduled
from agents.residual.flights import Adversity, fly
from dq_space_arm_env import Scene, compile_scene
from experts import BoxDDP
from experts.demonstrations import Demonstrations
from experts.report.solvers.receding import with_masses

SOURCES = (
    "plans.py",
    "policies",
    "residual/controllers.py",
    "residual/evaluation.py",
    "residual/flights.py",
    "residual/informed.py",
    "residual/worlds.py",
)
"""Code of this package that flights under mismatch follow from."""
_GROUP = 16


def informed_costs(
    scene: Scene,
    demonstrations: Demonstrations,
    plans: Plans,
    mass_factor: float,
    progress: Callable[[int, int], None] = lambda done, starts: None,
) -> FloatArray:
    """Look up what the expert pays who knows the masses; solve what is not there yet.

    Args:
        scene: The scene that was planned in.
        demonstrations: From where they begin; with nominal masses, what they cost.
        plans: The same as plans, whose feedback in the changed scene is where the solver begins.
        mass_factor: Of mass and inertia of the payload, or of the last link without one.
        progress: Called with the number of starts that are done, and of all.

    Returns:
        Costs, shape (B,), dimensionless; NaN where it found no optimum.

    Raises:
        ValueError: If the scene has no masses that could be others.
        KeyboardInterrupt: If the user interrupts it. What is solved remains.
    """
    if mass_factor == 1.0:
        return demonstrations.column("cost").astype(np.float64)
    seeds, changed = demonstrations.column("seed").tolist(), with_masses(scene, mass_factor)
    follows_from = {
        "plans": dict(demonstrations.settings),
        "seeds": seeds,
        "solved in": changed.content_hash(),
        "agents": agents_source(SOURCES),
    }
    files = CachedGroups("informed-costs", follows_from, ("seed", "cost"))
    groups = range(-(-len(seeds) // _GROUP))
    rows, missing = known_groups(files, groups, lambda group: _members(seeds, group))
    progress(sum(map(len, rows.values())), len(seeds))
    solver = BoxDDP(changed) if missing else None
    for group in missing:
        assert solver is not None
        few = plans.choose(_members(plans.chosen.tolist(), group))
        recorder = _Recorder(GainScheduled(scene))
        fly(recorder, scene, few, Adversity(mass_factor, 0.0, 0.0, 0.0, seed=0))
        guesses = np.stack(recorder.actions, axis=1) * compile_scene(scene).layout.control_limit
        costs = [_cost(solver, start, guess) for start, guess in zip(few.starts, guesses, strict=True)]
        rows[group] = [
            {"seed": seed, "cost": cost} for seed, cost in zip(_members(seeds, group), costs, strict=True)
        ]
        files.write(group, rows[group])
        progress(sum(map(len, rows.values())), len(seeds))
    found = [row["cost"] for group in sorted(rows) for row in rows[group]]
    return np.array([np.nan if cost is None else cost for cost in found], dtype=np.float64)


class _Recorder:
    """A controller that remembers its actions."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.actions: list[NDArray[Any]] = []

    def begin(self, plans: Plans) -> None:
        self._controller.begin(plans)

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        self.actions.append(self._controller(stage, measured))
        return self.actions[-1]


def _members(values: Sequence[int], group: int) -> Sequence[int]:
    return values[group * _GROUP : (group + 1) * _GROUP]


def _cost(solver: BoxDDP, start: FloatArray, guess: FloatArray) -> float | None:
    solution = solver.solve(x0=start, u_init=guess)
    return solution.cost if solution.converged else None
