"""The comparison: controllers and agents from the same starts, under the same conditions."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from agents.comparison.controllers import (
    CONTROLLERS,
    FEEDBACK,
    RECEDING,
    RecedingHorizon,
    SingleFollower,
)
from agents.comparison.kept_rows import KeptRows
from agents.comparison.planned_flights import PlannedFlights, agents_source, fly_plans, fly_receding
from agents.evaluation.conditions import CONDITIONS, as_known, scene_under
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS, evaluation_seeds, optimal_costs
from agents.evaluation.flights import time_per_action
from agents.evaluation.policies import as_policy, check_fit, policy_path
from agents.evaluation.records import evaluation_of, evaluation_record
from agents.evaluation.runs import (
    CurvePoint,
    Group,
    evaluation_command,
    groups,
    learning_curve,
    training_command,
)
from agents.zoo.shelf import file_hash
from dq_space_arm_env import Scene, load_scene
from experts.demonstrations.executors import Executor, local_executor
from experts.demonstrations.settings import software

RECEDING_STARTS = 100
"""Starts of the receding-horizon expert by default: it takes a second for each flight."""


@dataclass(frozen=True, eq=False)
class Row:
    """A controller or an agent under a condition.

    Attributes:
        evaluation: How it does; its `policy` is the name.
        is_agent: Whether it was trained; else it follows plans of the expert.
        planning_seconds: Time of planning before a flight, s; 0 for agents.
        training: The command that trains the agent again; None if it cannot be told, or there is nothing to
            train.
        again: The command that flies it again, but for the conditions, which are to be added at its end.
        curve: The learning curve of its training; empty if there is none.
    """

    evaluation: Evaluation
    is_agent: bool
    planning_seconds: float
    training: str | None
    again: str
    curve: tuple[CurvePoint, ...] = ()

    @property
    def solves(self) -> str:
        """Number of problems that the expert solved for it, in words."""
        if not self.is_agent:
            windows = ",\n1 window a step" if self.evaluation.policy == RECEDING else ""
            return f"1 a flight{windows}"
        count = self.evaluation.summary()["expert_solves"]
        return "-" if count is None else f"{count:,}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers and agents side by side.

    Attributes:
        scene: Name of the scene.
        rows: In the order of conditions, then of controllers and agents as they were asked for.
        groups: Agents of which there are several runs.
    """

    scene: str
    rows: tuple[Row, ...]
    groups: tuple[Group, ...]

    @property
    def conditions(self) -> tuple[str, ...]:
        """The conditions that there are rows for."""
        return tuple(dict.fromkeys(row.evaluation.condition for row in self.rows))

    def under(self, condition: str) -> tuple[Row, ...]:
        """Rows of a condition.

        Args:
            condition: Its name.

        Returns:
            The rows.
        """
        return tuple(row for row in self.rows if row.evaluation.condition == condition)


def compare(
    policies: Sequence[str | Path] = (),
    scene: Scene | str | Path = "paper",
    n: int = EVALUATION_SEEDS,
    *,
    controllers: Sequence[str] = tuple(CONTROLLERS),
    conditions: Sequence[str] = ("training",),
    receding_starts: int = RECEDING_STARTS,
    out: Path | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Comparison:
    """Compare agents with the expert's controllers, from the fixed evaluation starts of a scene.

    Where a condition changes more than the starts, plans are made in the unchanged scene: a controller
    measures where it is, and does not know what the payload weighs. The cost that all are compared with is
    the optimum of the scene that they fly in.

    Args:
        policies: Names of policies of the zoo, or paths, as for `evaluate`.
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        n: Number of starts, the first ones of the 500.
        controllers: Which of `CONTROLLERS`.
        conditions: Which of `CONDITIONS`.
        receding_starts: Number of starts of the receding-horizon expert, n at most.
        out: Folder that keeps finished rows, in its folder `rows`; what is there is not done again. None
            keeps nothing but plans' flights and optimal costs, in the cache.
        workers: Number of processes of the expert; one for each processor by default.
        executor: Who solves, in place of processes.
        progress: Called now and then.

    Returns:
        The comparison.

    Raises:
        SceneError: If the scene cannot be loaded.
        PolicyError, PolicyFileError: If a policy is none, does not fit the scene, or cannot be read.
        ValueError: If an argument is out of range or unknown, or the scene is not one for demonstrations.
        DemonstrationsError: If processes are killed again and again. What was finished remains.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    _check("controllers", controllers, tuple(CONTROLLERS))
    _check("conditions", conditions, CONDITIONS)
    given = load_scene(scene)
    evaluation_seeds(given, n)
    if receding_starts < 1:
        raise ValueError(f"receding_starts: {receding_starts}, should be at least 1")
    if not policies and not controllers:
        raise ValueError("there is nothing to compare: name a policy or a controller")
    work = _Work(
        given,
        given.name if isinstance(scene, Scene) else str(scene),
        n,
        min(receding_starts, n),
        KeptRows(out),
        executor or local_executor(workers),
        progress,
    )
    files = [policy_path(policy) for policy in policies]
    for file in files:
        check_fit(as_policy(file), given)  # what cannot be used is refused before hours of work
    names = distinct_names(files)
    rows: list[Row] = []
    for condition in conditions:
        rows += [work.controller(short, condition, conditions, controllers) for short in controllers]
        rows += [work.agent(file, name, condition) for file, name in zip(files, names, strict=True)]
    agents = [row.evaluation for row in rows if row.is_agent]
    return Comparison(given.name, tuple(rows), tuple(groups(agents)))


@dataclass(frozen=True)
class _Work:
    """What all rows have in common."""

    scene: Scene
    scene_name: str
    n: int
    receding_starts: int
    kept: KeptRows
    executor: Executor
    progress: Callable[[Advance], None]

    def agent(self, file: Path, name: str, condition: str) -> Row:
        """Evaluate an agent, or take up what is there."""
        content = {"policy": file_hash(file) if file.is_file() else None, **self._common(condition, self.n)}
        evaluation, _ = self._kept(name, condition, content) or (None, 0.0)
        if evaluation is None:
            evaluation = evaluate(
                file,
                self.scene,
                self.n,
                condition=condition,
                executor=self.executor,
                label=name,
                progress=self._announced(name, condition),
            )
            self._keep(content, evaluation, 0.0)
        return Row(
            evaluation,
            True,
            0.0,
            training_command(evaluation.metadata, file),
            evaluation_command(file, self.scene_name, self.n),
            tuple(learning_curve(file)),
        )

    def controller(
        self, short: str, condition: str, conditions: Sequence[str], controllers: Sequence[str]
    ) -> Row:
        """Fly a controller, or take up what is there."""
        name = CONTROLLERS[short]
        n = self.receding_starts if name == RECEDING else self.n
        content = {"controller": name, **self._common(condition, n)}
        evaluation, planning_seconds = self._kept(name, condition, content) or (None, 0.0)
        if evaluation is None:
            started = perf_counter()
            if name == RECEDING:
                planned = fly_receding(self.scene, condition, n, self.progress)
            else:
                planned = self._plans(name, condition, conditions, controllers)
            wall_seconds = perf_counter() - started
            evaluation = self._evaluation(name, condition, n, planned, wall_seconds)
            planning_seconds = planned.planning_seconds
            self._keep(content, evaluation, planning_seconds)
        options = ["--scene", self.scene_name, "-n", str(self.n), "--controller", short]
        if name == RECEDING:
            options += ["--receding-starts", str(n)]
        command = shlex.join(["dq-space-arm", "compare", "agents", *options, "--condition"])
        return Row(evaluation, False, planning_seconds, None, command)

    def _plans(
        self, name: str, condition: str, conditions: Sequence[str], controllers: Sequence[str]
    ) -> PlannedFlights:
        """Flights of a plan; those of the other rows that follow the same plans are flown along, and kept."""
        shared = as_known(self.scene, condition)
        others = [other for other in conditions if as_known(self.scene, other) == shared]
        followers = [CONTROLLERS[other] for other in controllers if CONTROLLERS[other] != RECEDING]
        flown = fly_plans(self.scene, followers, others, self.n, self.executor, self.progress)
        return flown[name, condition]

    def _evaluation(
        self, name: str, condition: str, n: int, planned: PlannedFlights, wall_seconds: float
    ) -> Evaluation:
        flown = scene_under(self.scene, condition)
        announced = self._announced(name, condition)
        optimal = optimal_costs(
            flown,
            n,
            executor=self.executor,
            progress=lambda done, total: announced(Advance("optimal costs", done, total)),
        )
        known = as_known(self.scene, condition)
        if name == RECEDING:
            seconds = time_per_action(RecedingHorizon(known), flown)
        else:
            follower = SingleFollower(known, feedback=name == FEEDBACK)
            seconds = time_per_action(follower, flown, batched=False)
        return Evaluation(
            policy=name,
            scene=flown.name,
            condition=condition,
            seeds=np.array(evaluation_seeds(flown, n), dtype=np.int64),
            flights=planned.flights,
            optimal=optimal,
            action_seconds=seconds,
            wall_seconds=wall_seconds,
            metadata={},
        )

    def _announced(self, name: str, condition: str) -> Callable[[Advance], None]:
        def announce(advance: Advance) -> None:
            self.progress(advance._replace(stage=f"{name}, {condition}: {advance.stage}"))

        return announce

    def _common(self, condition: str, n: int) -> dict[str, Any]:
        return {
            "scene": self.scene.content_hash(),
            "condition": condition,
            "starts": n,
            "agents": agents_source(),
            **software(),
        }

    def _kept(self, name: str, condition: str, content: dict[str, Any]) -> tuple[Evaluation, float] | None:
        """A row that is there and follows from the same things."""
        record = self.kept.read(f"{name}-{condition}", content)
        try:
            return None if record is None else (evaluation_of(record), float(record["planning_seconds"]))
        except (ValueError, KeyError, TypeError):
            return None

    def _keep(self, content: dict[str, Any], evaluation: Evaluation, planning_seconds: float) -> None:
        record = {"planning_seconds": planning_seconds, **evaluation_record(evaluation)}
        self.kept.write(f"{evaluation.policy}-{evaluation.condition}", content, record)


def distinct_names(files: Sequence[Path]) -> list[str]:
    """Name policies by their files: a run's folder, or the file's own where that is no `policy`.

    Args:
        files: The files.

    Returns:
        A name for each, no two alike.
    """
    names = [file.resolve().parent.name if file.stem == "policy" else file.stem for file in files]
    return [
        name if names.count(name) == 1 else f"{name} ({names[: i + 1].count(name)})"
        for i, name in enumerate(names)
    ]


def _check(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    unknown = [one for one in given if one not in known]
    if unknown:
        raise ValueError(f"{name}: {unknown[0]!r} is unknown; there are {', '.join(known)}")
