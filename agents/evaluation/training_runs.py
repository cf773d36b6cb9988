"""Training runs: learning curves, commands that reproduce them, and runs of one agent taken together."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agents.configuration import ConfigurationError, list_configurations, load_configuration
from agents.evaluation.evaluating import Evaluation
from agents.evaluation.statistics import FEWEST_RUNS, Runs, compare_runs
from agents.run_folder import CONFIGURATION, EVALUATIONS
from agents.zoo.shelf import SHELF
from dq_space_arm_env.common.bounded_reading import parse_json, read_text

_EPISODES = {"schedule": "evaluation_episodes", "progression": "evaluation_episodes", "curve": "episodes"}
_BUDGET = {"total_steps": "--total-steps", "minutes": "--minutes"}


class Group(NamedTuple):
    """Training runs of one agent that differ in their seeds, each with one policy."""

    name: str  # with a remark where a later policy of each run is in another group
    condition: str
    seeds: tuple[int, ...]
    runs: Runs
    evaluations: tuple[Evaluation, ...]

    @property
    def label(self) -> str:
        """Name in tables."""
        return f"{self.name}, seeds {', '.join(map(str, self.seeds))}"


def groups(evaluations: Sequence[Evaluation]) -> list[Group]:
    """Aggregate agents with at least 3 training runs, condition by condition."""
    found = _by_agent(evaluations)
    return [
        _group(condition, age, runs)
        for (condition, _, age), runs in found.items()
        if len(runs) >= FEWEST_RUNS
    ]


def pairs(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    """Tell of agents with two training runs, which are too few to aggregate."""
    agents = {key[1:]: runs for key, runs in _by_agent(evaluations).items() if len(runs) == 2}
    for runs in agents.values():
        name = runs[0].metadata.get("agent")
        yield f"{name}: two training seeds are too few to be aggregated, which takes {FEWEST_RUNS}."


def _by_agent(evaluations: Sequence[Evaluation]) -> dict[tuple[str, str, int], list[Evaluation]]:
    """Evaluations of training runs by condition, agent, and how many later policies their run has here.

    A run has `best.npz` beside `policy.npz`. The same policy twice, which costs the same, counts once.
    """
    runs: dict[tuple[str, str, str], dict[bytes, Evaluation]] = {}
    for evaluation in evaluations:
        agent = agent_of(evaluation.metadata)
        if agent is not None and seed_of(evaluation.metadata) is not None:
            run = json.dumps(evaluation.metadata["configuration"], sort_keys=True)
            flown = evaluation.flights.cost.tobytes()
            runs.setdefault((evaluation.condition, agent, run), {})[flown] = evaluation
    found: dict[tuple[str, str, int], list[Evaluation]] = {}
    for (condition, agent, _), policies in runs.items():
        for age, each in enumerate(sorted(policies.values(), key=_seconds, reverse=True)):
            found.setdefault((condition, agent, age), []).append(each)
    return found


def _seconds(evaluation: Evaluation) -> float:
    """Time of the training, s; 0 if the metadata lack it."""
    seconds = evaluation.summary()["training_seconds"]
    return float(seconds) if isinstance(seconds, int | float) else 0.0


def _group(condition: str, age: int, members: Sequence[Evaluation]) -> Group:
    seeds = tuple(seed for each in members if (seed := seed_of(each.metadata)) is not None)
    runs = compare_runs([each.flights.is_success for each in members], [each.cost_gaps for each in members])
    name = f"{members[0].metadata.get('agent')}{' (earlier)' * age}"
    return Group(name, condition, seeds, runs, tuple(members))


def learning_curve(policy: Path) -> list[dict[str, Any]]:
    """Read the learning curve in the folder of a policy, in the order of time.

    A point has `seconds` of training, `environment_steps`, and `success_rate` and `median_cost` (None if
    unknown) of the flights from validation starts.
    """
    file = policy.parent / EVALUATIONS
    if not file.is_file():
        return []
    points = []
    for line in read_text(file).splitlines():
        try:
            found = parse_json(line, str(file))
            seconds, rate = float(found["seconds"]), float(found["success_rate"])
            cost = found.get("median_cost")
            point = {
                "seconds": seconds,
                "environment_steps": int(found.get("environment_steps", 0)),
                "success_rate": rate,
                "median_cost": None if cost is None or not math.isfinite(cost) else float(cost),
            }
            if not (math.isfinite(seconds) and 0.0 <= rate <= 1.0):
                continue
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
            continue  # not a point of a learning curve
        points.append(point)
    return sorted(points, key=lambda point: point["seconds"])


def agent_of(metadata: Mapping[str, Any]) -> str | None:
    """A key shared by training runs that differ only in their seeds; None if the metadata lack it."""
    configuration = metadata.get("configuration")
    if not isinstance(configuration, Mapping):
        return None
    return json.dumps([metadata.get("scene_hash"), _without_seeds(configuration)], sort_keys=True)


def seed_of(metadata: Mapping[str, Any]) -> int | None:
    """The seed of a training run; None if the metadata lack it."""
    configuration = metadata.get("configuration")
    seed = configuration.get("seed") if isinstance(configuration, Mapping) else None
    return seed if isinstance(seed, int) else None


def validation_episodes(metadata: Mapping[str, Any]) -> int | None:
    """Number of flights of each point of a learning curve; None if the metadata lack it."""
    configuration = metadata.get("configuration")
    for part, name in _EPISODES.items():
        found = configuration.get(part) if isinstance(configuration, Mapping) else None
        if isinstance(found, Mapping) and isinstance(found.get(name), int):
            return int(found[name])
    return None


def training_command(metadata: Mapping[str, Any], policy: Path | None = None) -> str | None:
    """The command that trains a policy again, from a shipped configuration or that of its folder; or None."""
    configuration = metadata.get("configuration")
    if not isinstance(configuration, Mapping):
        return None
    options = _shipped(configuration)
    if options is None:
        if policy is None or not (policy.parent / CONFIGURATION).is_file():
            return None
        options = [str(policy.parent / CONFIGURATION)]
    return shlex.join(["dq-space-arm", "train", *options])


def evaluation_command(
    policy: Path, scene: str, n: int, normalize: str | Path | None = None, *, trust: bool = False
) -> str:
    """The command that evaluates a policy again; append the conditions."""
    name = policy.stem if policy.parent == SHELF else str(policy)
    statistics = [] if normalize is None else ["--normalize", str(normalize)]
    statistics += ["--trust"] if trust and policy.suffix == ".zip" else []
    options = [name, "--scene", scene, "-n", str(n), *statistics, "--condition"]
    return shlex.join(["dq-space-arm", "evaluate", *options])


def _shipped(configuration: Mapping[str, Any]) -> list[str] | None:
    """Options that turn a shipped configuration into this one; None if there are none."""
    name = configuration.get("name")
    if name not in list_configurations():
        return None
    try:
        content = load_configuration(name).model_dump(exclude_none=True)
        same_seed = load_configuration({**content, "seed": configuration.get("seed", 0)}).resolved()
        shipped = same_seed.model_dump(mode="json", exclude_none=True)
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
    same = _without(configuration, "description") == _without(shipped, "description")
    return options if same else None


def _without(content: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in names}


def _without_seeds(content: Any) -> Any:
    """JSON values without the seeds of training and of demonstrations."""
    if not isinstance(content, Mapping):
        return content
    return {name: _without_seeds(value) for name, value in content.items() if name != "seed"}
