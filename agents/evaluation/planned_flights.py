"""Flights of the expert's controllers from the evaluation starts.

Plans are made in groups, as demonstrations are. A group's gains take tens of megabytes: each group flies as
soon as it is planned, and only the outcomes are cached.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.configuration.schema import RESERVED_SEED
from agents.evaluation.conditions import as_known, disturbance_under, scene_under
from agents.evaluation.evaluating import Advance, fly_under
from agents.evaluation.expert_costs import (
    EVALUATION_SEEDS,
    GROUP,
    cost_files,
    cost_rows,
    evaluation_settings,
    group_seeds,
)
from agents.evaluation.kept_results import CachedGroups, Row
from agents.evaluation.plan_followers import FEEDBACK, RECEDING, RecedingHorizon, follower, plans_of
from agents.policies.flying import Flights, FloatArray
from dq_space_arm_env import Scene
from experts.demonstrations import DemonstrationsError
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.shard import Task, draw_starts
from experts.executors import Executor

PLAN_SOURCES = (
    *(f"evaluation/{name}.py" for name in ("conditions", "evaluating", "expert_costs", "plan_followers")),
    *("evaluation/planned_flights.py", "evaluation/plans.py", "policies"),
)


class PlannedFlights(NamedTuple):
    """Flights of a controller."""

    flights: Flights
    planning_seconds: float  # median time to plan one, s

    @classmethod
    def of(cls, rows: list[Row]) -> PlannedFlights:
        """Flights from cached rows."""
        columns: dict[str, list[Any]] = {name: [row[name] for row in rows] for name in Flights._fields}
        seconds = float(np.median([row["planning_seconds"] for row in rows]))
        return cls(Flights.from_columns(columns), seconds)


def fly_plans(
    scene: Scene,
    controllers: Sequence[str],
    conditions: Sequence[str],
    n: int,
    executor: Executor,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> dict[tuple[str, str], PlannedFlights]:
    """Fly plans from the first n evaluation starts, open loop or with gains, by controller and condition.

    Conditions that share the scene to plan in share the plans.
    """
    sharing: dict[str, list[str]] = {}
    for condition in conditions:
        sharing.setdefault(as_known(scene, condition).content_hash(), []).append(condition)
    found: dict[tuple[str, str], PlannedFlights] = {}
    for alike in sharing.values():
        settings = evaluation_settings(as_known(scene, alike[0]))
        seeds = group_seeds(settings, n)
        files = {
            (controller, condition): _files(controller, settings.scene, scene, condition, seeds)
            for condition in alike
            for controller in controllers
        }
        _fly_missing(settings, scene, files, executor, progress)
        found |= {key: PlannedFlights.of(cached.rows[:n]) for key, cached in files.items()}
    return found


def _fly_missing(
    settings: Settings,
    scene: Scene,
    files: dict[tuple[str, str], CachedGroups],
    executor: Executor,
    progress: Callable[[Advance], None],
) -> None:
    """Plan groups that some controller has not flown, and fly them."""
    missing = sorted({group for cached in files.values() for group in cached.missing})
    total = max(len(cached.groups) + len(cached.missing) for cached in files.values())
    stage, done = f"plans in {settings.scene.name}", total - len(missing)
    progress(Advance(stage, done, total))
    with closing(executor.run(Task(settings, group) for group in missing)) as results:
        for result in results:
            cost_files(settings).add(result.shard, cost_rows(result))
            plans, seconds = plans_of(settings, result)
            for (controller, condition), cached in files.items():
                if result.shard in cached.missing:
                    flying = follower(settings.scene, plans, feedback=controller == FEEDBACK)
                    seeds = cached.seeds(result.shard)
                    flights = fly_under(condition, flying, scene, seeds)
                    cached.add(result.shard, _rows(seeds, flights, seconds))
            done += 1
            progress(Advance(stage, done, total))


def fly_receding(
    scene: Scene,
    condition: str,
    n: int,
    executor: Executor,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> PlannedFlights:
    """Fly the receding-horizon expert from the first n evaluation starts."""
    settings = evaluation_settings(as_known(scene, condition))
    files = _files(RECEDING, settings.scene, scene, condition, group_seeds(settings, n, 1))
    stage, done, total = f"receding horizon, {condition}", len(files.rows), n
    progress(Advance(stage, done, total))
    flights = (RecedingFlight(settings.scene, scene, condition, files.seeds(i)[0]) for i in files.missing)
    numbers = {files.seeds(i)[0]: i for i in files.missing}
    with closing(executor.run(flights)) as results:
        for row in results:
            files.add(numbers[row["seed"]], [row])
            done += 1
            progress(Advance(stage, done, total))
    return PlannedFlights.of(files.rows[:n])


class RecedingFlight(NamedTuple):
    """A flight of the receding-horizon expert: all that a worker has to know."""

    known: Scene  # that it plans in
    scene: Scene
    condition: str
    seed: int

    @property
    def label(self) -> str:
        return f"the flight with seed {self.seed}"

    def prepare(self) -> None:
        """Compile the expert."""
        _receding_horizon(self.known)

    def run(self) -> Row:
        """Fly."""
        controller = _receding_horizon(self.known)
        told = draw_starts(self.known, [self.seed]).parameters
        flights = fly_under(self.condition, controller.policy(told), self.scene, [self.seed])
        return _rows([self.seed], flights, np.array([controller.planning_seconds]))[0]

    def lost(self, sentence: str) -> Row:
        """End the run; finished flights remain."""
        raise DemonstrationsError(sentence)

    @staticmethod
    def software() -> dict[str, Any]:
        """Identify the code that its row follows from."""
        return {**software(), "agents": agents_source()}


@lru_cache(maxsize=1)
def _receding_horizon(scene: Scene) -> RecedingHorizon:
    """The controller of this process, ready to fly."""
    return RecedingHorizon(scene)


def _rows(seeds: Sequence[int], flights: Flights, seconds: FloatArray) -> list[Row]:
    columns = {"seed": list(seeds), "planning_seconds": seconds.tolist(), **flights.columns()}
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _files(
    controller: str, planned_in: Scene, scene: Scene, condition: str, seeds: Sequence[int]
) -> CachedGroups:
    size = 1 if controller == RECEDING else GROUP  # seconds a flight
    content = {
        "controller": controller,
        "planned in": planned_in.content_hash(),
        "flown in": scene_under(scene, condition).content_hash(),
        "disturbed by": disturbance_under(condition)._asdict(),
        "problems": EVALUATION_SEEDS,
        "seed": RESERVED_SEED,
        "group": size,
        "agents": agents_source(),
        **software(),
    }
    columns = ("seed", "planning_seconds", *Flights._fields)
    return CachedGroups("planned-flights", content, columns, seeds, size)


@cache
def agents_source(names: tuple[str, ...] = PLAN_SOURCES) -> str:
    """SHA-256 of the files and folders of this package that flights follow from."""
    folder, digest = Path(__file__).parents[1], hashlib.sha256()
    for name in names:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.hexdigest()
