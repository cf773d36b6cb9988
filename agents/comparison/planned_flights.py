"""Flights of controllers that follow a plan, from the evaluation starts.

The plans are made in groups, as demonstrations are, by processes; each group is flown when it is there and
forgotten, for its gains take tens of megabytes. What became of the flights is kept in the cache folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import agents
from agents.comparison.controllers import FEEDBACK, RECEDING, PlanFollower, RecedingHorizon, plans_of
from agents.evaluation.cached_groups import CachedGroups, Row, known_groups
from agents.evaluation.conditions import as_known, scene_under
from agents.evaluation.evaluating import Advance
from agents.evaluation.expert_costs import (
    EVALUATION_SEEDS,
    GROUP,
    SEED_OF_SEEDS,
    evaluation_settings,
    group_seeds,
    keep_costs,
)
from agents.evaluation.flights import Flights, fly
from agents.evaluation.records import flights_columns, flights_of
from dq_space_arm_env import Scene
from experts.demonstrations.executors import Executor
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.shard import Task
from experts.problem import FloatArray

_SOURCES = (
    "comparison/controllers.py",
    "comparison/planned_flights.py",
    "evaluation",
    "plans.py",
    "policies",
)
_FEW = 5
"""Flights of a group of the receding-horizon expert, a second or so each."""
_COLUMNS = ("seed", "planning_seconds", *Flights._fields)


class PlannedFlights(NamedTuple):
    """What became of the flights of a controller.

    Attributes:
        flights: The flights, B of them.
        planning_seconds: Median time of planning one, s.
    """

    flights: Flights
    planning_seconds: float


class _Plane(NamedTuple):
    """What is to be flown: a controller, under a condition.

    Attributes:
        controller: Its name.
        condition: The condition.
        flown: The scene that it flies in.
        files: Where its flights are kept.
    """

    controller: str
    condition: str
    flown: Scene
    files: CachedGroups


def fly_plans(
    scene: Scene,
    controllers: Sequence[str],
    conditions: Sequence[str],
    n: int,
    executor: Executor,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> dict[tuple[str, str], PlannedFlights]:
    """Fly plans from the first n evaluation starts, open loop and with their gains.

    Args:
        scene: The scene that the conditions change.
        controllers: `OPEN_LOOP`, `FEEDBACK` or both.
        conditions: Names of conditions.
        n: Number of starts.
        executor: Who plans.
        progress: Called after each group of each scene to plan in.

    Returns:
        The flights by controller and condition.

    Raises:
        ValueError: If the scene is not one for demonstrations, see `generate_demonstrations`.
        DemonstrationsError: If processes are killed again and again. What was flown remains.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    known = {condition: as_known(scene, condition) for condition in conditions}
    found: dict[tuple[str, str], PlannedFlights] = {}
    for planned_in in {
        known[condition].content_hash(): known[condition] for condition in conditions
    }.values():
        planes = [
            _Plane(controller, condition, flown, _files(controller, planned_in, flown))
            for condition in conditions
            if known[condition].content_hash() == planned_in.content_hash()
            for flown in [scene_under(scene, condition)]
            for controller in controllers
        ]
        rows = _planned(planned_in, planes, n, executor, progress)
        found |= {(plane.controller, plane.condition): _joined(rows[i], n) for i, plane in enumerate(planes)}
    return found


def _planned(
    planned_in: Scene,
    planes: Sequence[_Plane],
    n: int,
    executor: Executor,
    progress: Callable[[Advance], None],
) -> list[dict[int, list[Row]]]:
    """Fly what has to be planned in one scene; rows of each group of each plane."""
    settings = evaluation_settings(planned_in)
    groups = range(-(-n // GROUP))
    known = [
        known_groups(plane.files, groups, lambda group: group_seeds(settings, group)) for plane in planes
    ]
    rows = [found for found, _ in known]
    missing = sorted({group for _, absent in known for group in absent})
    stage = f"plans in {planned_in.name}"
    progress(Advance(stage, len(groups) - len(missing), len(groups)))
    tasks = (Task(settings, group) for group in missing)
    with closing(executor.run(tasks)) as results:
        for done, result in enumerate(results, 1 + len(groups) - len(missing)):
            keep_costs(settings, result)
            (plans, seconds), seeds = plans_of(settings, result), group_seeds(settings, result.shard)
            for plane, (_, absent), found in zip(planes, known, rows, strict=True):
                if result.shard in absent:
                    follower = PlanFollower(settings.scene, plans, feedback=plane.controller == FEEDBACK)
                    flights = fly(follower, plane.flown, seeds)
                    found[result.shard] = _rows(seeds, flights, seconds)
                    plane.files.write(result.shard, found[result.shard])
            progress(Advance(stage, done, len(groups)))
    return rows


def fly_receding(
    scene: Scene,
    condition: str,
    n: int,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> PlannedFlights:
    """Fly the receding-horizon expert from the first n evaluation starts.

    Args:
        scene: The scene that the condition changes.
        condition: Name of the condition.
        n: Number of starts.
        progress: Called after each flight.

    Returns:
        The flights.

    Raises:
        ValueError: If the scene is not one for demonstrations, see `generate_demonstrations`.
        KeyboardInterrupt: If the user interrupts it; what was flown remains, but for part of a group.
    """
    planned_in, flown = as_known(scene, condition), scene_under(scene, condition)
    settings = evaluation_settings(planned_in)
    files = _files(RECEDING, planned_in, flown)
    groups = range(-(-n // _FEW))
    rows, missing = known_groups(files, groups, lambda group: _few_seeds(settings, group))
    controller = RecedingHorizon(planned_in) if missing else None
    done = sum(map(len, rows.values()))
    stage, total = f"receding horizon, {condition}", len(groups) * _FEW
    progress(Advance(stage, done, total))
    for group in missing:
        assert controller is not None
        rows[group] = []
        for seed in _few_seeds(settings, group):
            flights = fly(controller, flown, [seed])
            rows[group] += _rows([seed], flights, np.array([controller.planning_seconds]))
            done += 1
            progress(Advance(stage, done, total))
        files.write(group, rows[group])
    return _joined(rows, n)


def _joined(rows: dict[int, list[Row]], n: int) -> PlannedFlights:
    """The first n flights of all groups."""
    all_rows = [row for group in sorted(rows) for row in rows[group]][:n]
    columns: dict[str, list[Any]] = {name: [row[name] for row in all_rows] for name in Flights._fields}
    seconds = float(np.median([row["planning_seconds"] for row in all_rows]))
    return PlannedFlights(flights_of(columns), seconds)


def _rows(seeds: Sequence[int], flights: Flights, seconds: FloatArray) -> list[Row]:
    columns = flights_columns(flights)
    return [
        {
            "seed": seed,
            "planning_seconds": float(seconds[i]),
            **{name: values[i] for name, values in columns.items()},
        }
        for i, seed in enumerate(seeds)
    ]


def _few_seeds(settings: Settings, group: int) -> list[int]:
    return [settings.problem_seed(problem) for problem in range(group * _FEW, (group + 1) * _FEW)]


def _files(controller: str, planned_in: Scene, flown: Scene) -> CachedGroups:
    content = {
        "controller": controller,
        "planned in": planned_in.content_hash(),
        "flown in": flown.content_hash(),
        "problems": EVALUATION_SEEDS,
        "seed": SEED_OF_SEEDS,
        "group": _FEW if controller == RECEDING else GROUP,
        "agents": agents_source(),
        **software(),
    }
    return CachedGroups("planned-flights", content, _COLUMNS)


@cache
def agents_source(names: tuple[str, ...] = _SOURCES) -> str:
    """Hash of the code that flights follow from, besides the expert's and the environment's.

    Args:
        names: Files and folders of the package `agents`.

    Returns:
        SHA-256, 64 hexadecimal digits.
    """
    folder, digest = Path(str(agents.__file__)).parent, hashlib.sha256()
    for name in names:
        path = folder / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.hexdigest()
