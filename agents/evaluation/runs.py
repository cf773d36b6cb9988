"""Training runs: what a policy and its folder tell of one, and what several of one agent have in common."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agents.configuration import ConfigurationError, list_configurations, load_configuration
from agents.evaluation.evaluating import Evaluation
from agents.evaluation.statistics import FEWEST_RUNS, Runs, compare_runs
from agents.zoo.shelf import SHELF

CONFIGURATION, EVALUATIONS = "config.yaml", "evaluations.jsonl"
_BUDGET = {"total_steps": "--total-steps", "minutes": "--minutes"}


class CurvePoint(NamedTuple):
    """A line of a learning curve.

    Attributes:
        seconds: Time of training until then, s.
        environment_steps: Steps until then.
        success_rate: Of the flights of validation starts.
        median_cost: Of the same, dimensionless; NaN if nobody wrote it down.
    """

    seconds: float
    environment_steps: int
    success_rate: float
    median_cost: float


class Group(NamedTuple):
    """Training runs of one agent that differ in their seeds.

    Attributes:
        name: Name of the agent.
        condition: Under which they were evaluated.
        seeds: Of the runs.
        runs: What they have in common.
    """

    name: str
    condition: str
    seeds: tuple[int, ...]
    runs: Runs


def groups(evaluations: Sequence[Evaluation]) -> list[Group]:
    """Find agents of which there are several training runs, and take these together.

    Args:
        evaluations: Of any policies under any conditions, on the same starts.

    Returns:
        Agents with at least 3 runs, condition by condition.
    """
    found: dict[tuple[str, str], dict[int, Evaluation]] = {}
    for evaluation in evaluations:
        agent, seed = agent_of(evaluation.metadata), seed_of(evaluation.metadata)
        if agent is not None and seed is not None:
            found.setdefault((evaluation.condition, agent), {})[seed] = evaluation
    return [
        Group(
            str(next(iter(members.values())).metadata.get("agent")),
            condition,
            tuple(members),
            compare_runs(
                [evaluation.flights.is_success for evaluation in members.values()],
                [evaluation.cost_gaps for evaluation in members.values()],
            ),
        )
        for (condition, _), members in found.items()
        if len(members) >= FEWEST_RUNS
    ]


def learning_curve(policy: Path) -> list[CurvePoint]:
    """Read the learning curve beside a policy.

    Args:
        policy: Its file, in the folder of the run.

    Returns:
        The curve in the order of time; nothing if there is none.
    """
    file = policy.parent / EVALUATIONS
    if not file.is_file():
        return []
    points = []
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            found = json.loads(line)
            point = CurvePoint(
                float(found["seconds"]),
                int(found.get("environment_steps", 0)),
                float(found["success_rate"]),
                float(found.get("median_cost", "nan")),
            )
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # a line without these tells nothing about success over time
        points.append(point)
    return sorted(points)


def agent_of(metadata: Mapping[str, Any]) -> str | None:
    """Identify what training runs have in common that differ in their seeds alone.

    Args:
        metadata: Of a policy.

    Returns:
        A key that equal agents share; None if the metadata do not say enough.
    """
    configuration = metadata.get("configuration")
    if not isinstance(configuration, Mapping):
        return None
    return json.dumps([metadata.get("scene_hash"), _without(configuration, "seed")], sort_keys=True)


def seed_of(metadata: Mapping[str, Any]) -> int | None:
    """Look up the seed of a training run.

    Args:
        metadata: Of its policy.

    Returns:
        The seed; None if the metadata do not tell.
    """
    configuration = metadata.get("configuration")
    seed = configuration.get("seed") if isinstance(configuration, Mapping) else None
    return None if seed is None else int(seed)


def training_command(metadata: Mapping[str, Any], policy: Path | None = None) -> str | None:
    """Write the command that trains a policy again.

    Args:
        metadata: Of the policy.
        policy: Its file; a configuration that does not ship with the package is looked for beside it.

    Returns:
        The command; None if it cannot be told.
    """
    configuration = metadata.get("configuration")
    if not isinstance(configuration, Mapping):
        return None
    options = _shipped(configuration)
    if options is None:
        if policy is None or not (policy.parent / CONFIGURATION).is_file():
            return None
        options = [str(policy.parent / CONFIGURATION)]
    return shlex.join(["dq-space-arm", "train", *options])


def evaluation_command(policy: Path, scene: str, n: int) -> str:
    """Write the command that evaluates a policy again, but for the conditions at its end.

    Args:
        policy: Its file.
        scene: Name or path of the scene.
        n: Number of starts.

    Returns:
        The command.
    """
    name = policy.stem if policy.parent == SHELF else str(policy)
    options = [name, "--scene", scene, "-n", str(n), "--condition"]
    return shlex.join(["dq-space-arm", "evaluate", *options])


def _shipped(configuration: Mapping[str, Any]) -> list[str] | None:
    """Options that make a configuration out of one that ships with the package; None if none do."""
    name = configuration.get("name")
    if name not in list_configurations():
        return None
    try:
        shipped = load_configuration(name).model_dump(mode="json", exclude_none=True)
    except ConfigurationError:
        return None
    options = [str(name), "--seed", str(configuration.get("seed", 0))]
    here, there = configuration.get("schedule"), shipped.get("schedule")
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        for key, option in _BUDGET.items():
            if here.get(key) != there.get(key):
                if here.get(key) is None:
                    return None
                options += [option, f"{here[key]}"]
        configuration = {**configuration, "schedule": _without(here, *_BUDGET)}
        shipped = {**shipped, "schedule": _without(there, *_BUDGET)}
    left_out = ("seed", "description")
    return options if _without(configuration, *left_out) == _without(shipped, *left_out) else None


def _without(content: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in names}
