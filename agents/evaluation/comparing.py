"""The comparison: controllers and agents from the same starts, under the same conditions."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from agents.evaluation.conditions import CONDITIONS, as_known, scene_under
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.expert_costs import (
    EVALUATION_SEEDS,
    STAGE,
    evaluation_seeds,
    optimal_costs,
    validation_costs,
)
from agents.evaluation.kept_results import KeptRows
from agents.evaluation.plan_followers import (
    CONTROLLERS,
    FEEDBACK,
    RECEDING,
    RecedingHorizon,
    onboard_follower,
)
from agents.evaluation.planned_flights import (
    PLAN_SOURCES,
    PlannedFlights,
    agents_source,
    fly_plans,
    fly_receding,
)
from agents.evaluation.training_runs import (
    Group,
    evaluation_command,
    groups,
    learning_curve,
    training_command,
    validation_episodes,
)
from agents.policies.flying import time_per_action
from agents.zoo.finding import ActingPolicy, as_policy, check_fit, policy_path
from agents.zoo.onnx_model import tensor_files
from agents.zoo.shelf import file_hash
from dq_space_arm_env import Scene, load_scene
from experts.demonstrations.settings import software
from experts.executors import Executor, local_executor

RECEDING_STARTS = 100
"""Default number of starts of the receding-horizon expert, which takes a second per flight."""


@dataclass(frozen=True, eq=False)
class Row:
    """A controller or an agent under a condition.

    Attributes:
        evaluation: Its evaluation; `policy` is the name.
        facts: JSON values beside the evaluation's summary: `is_agent`, `planning_seconds` (before a flight,
            s), `solves` (problems the expert solved for it), `training_command`, `evaluation_command`,
            `learning_curve`, `validation_optimum` (median optimal cost from the starts of that curve); under
            model mismatch `saving` and the condition's parameters.
    """

    evaluation: Evaluation
    facts: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the controller or agent."""
        return self.evaluation.policy

    def record(self) -> dict[str, Any]:
        """The row as JSON values."""
        return {**self.evaluation.summary(), **self.facts}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers and agents side by side.

    Attributes:
        scene: Name of the scene.
        rows: In the order of conditions, then of controllers and agents as asked for.
        groups: Agents with several training runs.
        notes: Sentences that explain the tables.
        commands: Commands that reproduce the rows.
    """

    scene: str
    rows: tuple[Row, ...]
    groups: tuple[Group, ...] = ()
    notes: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()

    @property
    def conditions(self) -> tuple[str, ...]:
        """The conditions that rows exist for."""
        return tuple(dict.fromkeys(row.evaluation.condition for row in self.rows))

    def under(self, condition: str) -> tuple[Row, ...]:
        """Rows of a condition."""
        return tuple(row for row in self.rows if row.evaluation.condition == condition)

    def entrants(self, condition: str) -> list[tuple[str, tuple[Row, ...]]]:
        """Rows of a condition with a name: the training runs of an agent together, all others alone."""
        group_of = {each: group for group in self.groups for each in group.evaluations}
        found: dict[object, list[Row]] = {}
        for row in self.under(condition):
            found.setdefault(group_of.get(row.evaluation, row), []).append(row)
        return [
            (key.label if isinstance(key, Group) else rows[0].name, tuple(rows))
            for key, rows in found.items()
        ]


def compare(
    policies: Sequence[str | Path | ActingPolicy] = (),
    scene: Scene | str | Path = "paper",
    n: int = EVALUATION_SEEDS,
    *,
    controllers: Sequence[str] = tuple(CONTROLLERS),
    conditions: Sequence[str] = ("training",),
    receding_starts: int = RECEDING_STARTS,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    trust: bool = False,
    normalize: Mapping[str, str | Path] = MappingProxyType({}),
    learning_curves: bool = True,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Comparison:
    """Compare agents with the expert's controllers, from the fixed evaluation starts of a scene.

    Where a condition changes more than the starts, plans are made in the unchanged scene: a controller
    measures its state, and does not know the payload's mass. All costs are compared with the optimum of the
    scene that is flown in.

    Args:
        policies: Names of policies of the zoo, or paths, as for `evaluate`; or policies in memory, whose rows
            are not kept.
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        n: Number of starts, the first ones of the 500.
        controllers: Some of `CONTROLLERS`.
        conditions: Some of `CONDITIONS`.
        receding_starts: Number of starts of the receding-horizon expert, at most n.
        out: Folder whose folder `rows` keeps finished rows; rows found there are not computed again. None
            keeps only flights of plans and optimal costs, in the cache.
        workers: Number of processes of the expert; one per processor by default.
        executor: Used instead of local processes.
        trust: Whether to execute the code in a model's file (.zip) where its tensors do not suffice.
        normalize: Files of the `VecNormalize` that models (.zip) were trained in, as for `evaluate`, by the
            models' paths, as they are among the policies.
        learning_curves: Whether to read them, and to find the optima that they are drawn against.
        progress: Called now and then.

    Returns:
        The comparison.

    Raises:
        SceneError: If the scene cannot be loaded.
        PolicyError, PolicyFileError: If a policy is of no known kind, does not fit the scene, or cannot be
            read.
        TypeError: If a text is given where a sequence should be.
        ValueError: If an argument is out of range or unknown, the scene does not suit demonstrations, or a
            condition does not suit the scene.
        DemonstrationsError: If processes are killed again and again; finished rows remain.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    check_sequences(policies=policies, controllers=controllers, conditions=conditions)
    _check("controllers", controllers, tuple(CONTROLLERS))
    _check("conditions", conditions, CONDITIONS)
    controllers, conditions = tuple(dict.fromkeys(controllers)), tuple(dict.fromkeys(conditions))
    given = load_scene(scene)
    for condition in conditions:
        scene_under(given, condition)  # refuses one that the scene cannot have, before hours of work
    evaluation_seeds(given, n)  # refuses a wrong n
    if not isinstance(receding_starts, int | np.integer) or receding_starts < 1:
        raise ValueError(f"receding_starts: {receding_starts!r}, should be a whole number of at least 1")
    if not policies and not controllers:
        raise ValueError("there is nothing to compare: name a policy or a controller")
    work = _Work(
        given,
        given.name if isinstance(scene, Scene) else str(scene),
        n,
        min(receding_starts, n),
        KeptRows(None if out is None else Path(out)),
        executor or local_executor(workers),
        trust,
        learning_curves,
        progress,
    )
    files = [policy if isinstance(policy, ActingPolicy) else policy_path(policy) for policy in policies]
    if unknown := set(normalize) - {str(policy) for policy in policies}:
        raise ValueError(f"normalize: {min(unknown)} is not among the policies")
    statistics = [normalize.get(str(policy)) for policy in policies]
    for file, its in zip(files, statistics, strict=True):  # refuse unusable policies before hours of work
        check_fit(as_policy(file, trust=trust, normalize=its), given)
    agents = list(zip(files, distinct_names(files), statistics, strict=True))
    rows: list[Row] = []
    for condition in conditions:
        rows += [work.controller(short, condition, conditions, controllers) for short in controllers]
        rows += [work.agent(*agent, condition) for agent in agents]
    trained = [row.evaluation for row in rows if row.facts["is_agent"]]
    notes = tuple(_notes(controllers, conditions))
    return Comparison(given.name, tuple(rows), tuple(groups(trained)), notes, tuple(_commands(rows)))


@dataclass(frozen=True)
class _Work:
    """Settings common to all rows."""

    scene: Scene
    scene_name: str
    n: int
    receding_starts: int
    kept: KeptRows
    executor: Executor
    trust: bool
    learning_curves: bool
    progress: Callable[[Advance], None]

    def agent(
        self, file: Path | ActingPolicy, name: str, normalize: str | Path | None, condition: str
    ) -> Row:
        """Evaluate an agent, or read its finished row."""

        def fly() -> tuple[Evaluation, float]:
            evaluation = evaluate(
                file,
                self.scene,
                self.n,
                condition=condition,
                executor=self.executor,
                label=name,
                trust=self.trust,
                normalize=normalize,
                progress=self._announced(name, condition),
            )
            return evaluation, 0.0

        path = file if isinstance(file, Path) else None
        content: dict[str, Any] = {"policy": file_hash(path) if path and path.is_file() else None}
        if path and path.suffix == ".onnx":
            content["tensors"] = [file_hash(file) for file in tensor_files(path)]
        content |= self._common(condition, self.n)
        content["agents"] = agents_source((*PLAN_SOURCES, "zoo"))  # how a file becomes a policy
        if normalize is not None:
            content["normalize"] = file_hash(Path(normalize))
        kept = self.kept if path else KeptRows(None)
        evaluation, _ = finished(kept, f"{name}-{condition}", content, fly)
        solves = evaluation.summary()["expert_solves"]
        command = None
        if path:
            command = evaluation_command(path, self.scene_name, self.n, normalize, trust=self.trust)
        facts = {
            "is_agent": True,
            "planning_seconds": 0.0,
            "solves": "-" if solves is None else f"{solves:,}",
            "training_command": training_command(evaluation.metadata, path),
            "evaluation_command": f"{command} {condition}" if command else None,
            "learning_curve": learning_curve(path) if path and self.learning_curves else [],
            "validation_optimum": None,
        }
        if facts["learning_curve"] and evaluation.same_scene is not False:
            facts["validation_optimum"] = self._validation_optimum(evaluation, name)
        return Row(evaluation, facts)

    def _validation_optimum(self, evaluation: Evaluation, name: str) -> float | None:
        """Median of the optimal costs from the starts of a learning curve; None if they are unknown."""
        episodes = validation_episodes(evaluation.metadata)
        announced = self._announced(name, "learning curve")
        if episodes is None:
            return None
        found = validation_costs(
            self.scene,
            episodes,
            self.executor,
            lambda done, total: announced(Advance(STAGE, done, total)),
        )
        return None if np.isnan(found.cost).all() else float(np.nanmedian(found.cost))

    def controller(
        self, short: str, condition: str, conditions: Sequence[str], controllers: Sequence[str]
    ) -> Row:
        """Fly a controller, or read its finished row."""
        name = CONTROLLERS[short]
        n = self.receding_starts if name == RECEDING else self.n

        def fly() -> tuple[Evaluation, float]:
            started = perf_counter()
            if name == RECEDING:
                planned = fly_receding(self.scene, condition, n, self.executor, self.progress)
            else:
                planned = self._plans(name, condition, conditions, controllers)
            wall_seconds = perf_counter() - started
            return self._evaluation(name, condition, n, planned, wall_seconds), planned.planning_seconds

        content = {"controller": name, **self._common(condition, n)}
        evaluation, planning_seconds = finished(self.kept, f"{name}-{condition}", content, fly)
        options = ["--scene", self.scene_name, "-n", str(self.n), "--controller", short]
        if name == RECEDING:
            options += ["--receding-starts", str(n)]
        command = shlex.join(["dq-space-arm", "compare", "agents", *options, "--condition", condition])
        facts: dict[str, Any] = {
            "is_agent": False,
            "planning_seconds": planning_seconds,
            "solves": "1 a flight, 1 window a step" if name == RECEDING else "1 a flight",
            "training_command": None,
            "evaluation_command": command,
            "learning_curve": [],
            "validation_optimum": None,
        }
        return Row(evaluation, facts)

    def _plans(
        self, name: str, condition: str, conditions: Sequence[str], controllers: Sequence[str]
    ) -> PlannedFlights:
        """Flights of a plan; other rows with the same plans fly along, and find their flights cached."""
        shared = as_known(self.scene, condition)
        others = [other for other in conditions if as_known(self.scene, other) == shared]
        followers = [CONTROLLERS[other] for other in controllers if CONTROLLERS[other] != RECEDING]
        flown = fly_plans(self.scene, followers, others, self.n, self.executor, self.progress)
        return flown[name, condition]

    def _evaluation(
        self, name: str, condition: str, n: int, planned: PlannedFlights, wall_seconds: float
    ) -> Evaluation:
        flown, known = scene_under(self.scene, condition), as_known(self.scene, condition)
        announced = self._announced(name, condition)
        optimal = optimal_costs(
            flown,
            n,
            executor=self.executor,
            progress=lambda done, total: announced(Advance(STAGE, done, total)),
        )
        if name == RECEDING:
            seconds = time_per_action(RecedingHorizon(known).policy(), flown)
        else:
            onboard = onboard_follower(known, feedback=name == FEEDBACK)
            seconds = time_per_action(onboard, flown, batched=False)
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


def finished(
    kept: KeptRows,
    name: str,
    follows_from: Mapping[str, Any],
    fly: Callable[[], tuple[Evaluation, float]],
) -> tuple[Evaluation, float]:
    """A finished row, an evaluation and its planning time in s; flown and kept if there is none."""
    record = kept.read(name, follows_from)
    if record is not None:
        try:
            return Evaluation.from_record(record), float(record["planning_seconds"])
        except (ValueError, KeyError, TypeError):
            pass  # damaged: fly again
    evaluation, planning_seconds = fly()
    kept.write(name, follows_from, {"planning_seconds": planning_seconds, **evaluation.record()})
    return evaluation, planning_seconds


def distinct_names(files: Sequence[Path | ActingPolicy]) -> list[str]:
    """Name policies by the folders of their runs, or by their files; all differ, also from controllers."""
    names = [_name(file) for file in files]
    given, found = [*CONTROLLERS.values(), *names], list[str]()
    for name in names:
        others = (f"{name} ({number})" for number in count(1))
        free = (each for each in others if each not in (*given, *found))
        found.append(name if given.count(name) == 1 else next(free))
    return found


def _name(file: Path | ActingPolicy) -> str:
    if isinstance(file, ActingPolicy):
        return file.label
    return file.resolve().parent.name if file.stem == "policy" else file.stem


def _notes(controllers: Sequence[str], conditions: Sequence[str]) -> Iterator[str]:
    yield (
        "Cost gap: J / J_expert - 1, median; J_expert is the optimum of the scene that is flown in. Angle, "
        "distance, effort and base turn are medians. Plan: planning time before a flight, median."
    )
    if controllers and any(condition.endswith("payload") for condition in conditions):
        yield "Controllers plan with the payload of the unchanged scene: they do not know the new one."
    if any(condition in conditions for condition in ("delay", "noise", "push")):
        yield "J_expert is that of flights without delay, noise and pushes."


def _commands(rows: Sequence[Row]) -> Iterator[str]:
    """Commands that train the agents, and those that fly each row under all of its conditions."""
    found: dict[str, dict[str, None]] = {}
    for row in rows:
        if row.facts["training_command"] is not None:
            found.setdefault(row.facts["training_command"], {})
        if row.facts["evaluation_command"] is not None:
            flying, _, condition = row.facts["evaluation_command"].rpartition(" ")
            found.setdefault(flying, {})[condition] = None
    for command, conditions in found.items():
        yield " ".join([command, *conditions])


def check_sequences(**given: object) -> None:
    """Raise TypeError for a text or path where a sequence should be: of a text, each letter would count."""
    for name, value in given.items():
        if isinstance(value, str | os.PathLike):
            raise TypeError(f"{name}: {str(value)!r}, should be a sequence: put it into a list")


def _check(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    unknown = [one for one in given if one not in known]
    if unknown:
        raise ValueError(f"{name}: {unknown[0]!r} is unknown; choose from {', '.join(known)}")
