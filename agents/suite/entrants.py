"""Entrants of a suite: controllers of the expert, agents to train, and policies by their files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.configuration import list_configurations
from agents.evaluation.plan_followers import CONTROLLERS
from agents.suite.tasks import ZOO, Suite, SuiteError
from agents.zoo.finding import ActingPolicy, PolicyError, as_policy, check_fit, policy_path
from agents.zoo.shelf import list_policies, load_policy
from dq_space_arm_env import Scene
from dq_space_arm_env.validation import did_you_mean

TASK = "{task}"
"""In the path of a policy: the name of a task."""
_ONE_NAME = "entrants: two are named {!r}; put another name and = before the path of one"
_NAMED = re.compile(r"([\w.-]+)=(.+)")


def agent_name(agent: str) -> str:
    """Name of a trained agent in tables."""
    return Path(agent).stem if agent.endswith((".yaml", ".yml")) else agent


def entrant_names(entrants: Sequence[str], suite: Suite) -> list[str]:
    """Names of entrants in tables, before anything flies; all that ship with the package by default."""
    return names_of(*sorted_out(entrants or (*CONTROLLERS, *suite.agents, ZOO), suite))


def names_of(controllers: Sequence[str], agents: Sequence[str], files: Mapping[str, str]) -> list[str]:
    """Names in tables, those of all policies that ship with the package included."""
    shelf = [f"{each} ({ZOO})" for each in list_policies()] if ZOO in files else []
    named = [name for name in files if name != ZOO]
    return [*(CONTROLLERS[each] for each in controllers), *map(agent_name, agents), *named, *shelf]


def check_names(names: Sequence[str]) -> None:
    """Raise SuiteError if two entrants have one name: they would count as one."""
    for name, count in Counter(names).items():
        if count > 1:
            raise SuiteError(_ONE_NAME.format(name))


def sorted_out(entrants: Sequence[str], suite: Suite) -> tuple[list[str], list[str], dict[str, str]]:
    """Controllers, agents to train, and paths of policies by name among the entrants."""
    controllers: list[str] = []
    agents: list[str] = []
    files: dict[str, str] = {}
    for entrant in dict.fromkeys(map(str, entrants)):
        if entrant in CONTROLLERS:
            controllers.append(entrant)
        elif entrant in (*suite.agents, *list_configurations()) or entrant.endswith((".yaml", ".yml")):
            agents.append(entrant)
        elif entrant == ZOO:
            files[ZOO] = ZOO
        else:
            named = _NAMED.fullmatch(entrant)
            name, path = (named[1], named[2]) if named else (entrant, entrant)
            if named and name == ZOO:
                raise SuiteError(f"{entrant}: {ZOO} is the policies that ship: put another name before the =")
            if name in files:
                raise SuiteError(_ONE_NAME.format(name))
            try:
                policy_path(path)
            except PolicyError as error:
                known = dict.fromkeys([*CONTROLLERS, *suite.agents, *list_configurations(), ZOO])
                advice = did_you_mean(path, known, f"choose from {', '.join(known)}, or give a path")
                raise SuiteError(f"entrant: {path!r} is unknown; {advice}") from error
            files[name] = path
    return controllers, agents, files


def find_fliers(
    files: Mapping[str, str],
    policies: Mapping[str, Callable[[Scene], Any]],
    scenes: Mapping[str, Scene],
    trust: bool,
) -> dict[str, list[tuple[str, Any]]]:
    """Policies by name that fly in each task: those of files, and those that functions make for its scene.

    Raises SuiteError if a file fits no task.
    """
    fliers: dict[str, list[tuple[str, Any]]] = {}
    for task, scene in scenes.items():
        made = [(name, as_policy(make(scene), name)) for name, make in policies.items()]
        for _, acting in made:
            check_fit(acting, scene)
        fliers[task] = [*from_files(files, task, scene, trust), *made]
    fitting = {name for found in fliers.values() for name, _ in found}
    for name, path in files.items():
        if name not in fitting and name != ZOO:
            why = "there is no such file" if TASK in path else "fits no task"
            raise SuiteError(f"{path}: {why}, whichever the task")
    return fliers


def from_files(
    files: Mapping[str, str], task: str, scene: Scene, trust: bool
) -> Iterator[tuple[str, str | Path | ActingPolicy]]:
    """Names and policies that fly in a task."""
    for name, file in files.items():
        if name == ZOO:
            for each in list_policies():
                if load_policy(each).metadata.get("scene_hash") == scene.content_hash():
                    yield f"{each} ({ZOO})", each
            continue
        path = _path_in(file, task)
        if TASK in file and not path.exists():
            continue
        acting = as_policy(path, trust=trust)
        try:
            check_fit(acting, scene)
        except PolicyError:
            if TASK in file:
                raise
            continue
        yield name, path


def missing_files(files: Mapping[str, str], tasks: Iterable[str]) -> Iterator[str]:
    """A note on each entrant that lacks the files of some tasks."""
    for name, file in files.items():
        own = tasks if TASK in file else ()
        lacking = [Path(task).stem for task in own if not _path_in(file, task).exists()]
        if lacking:
            yield f"{name}: there is no file {file} for {', '.join(lacking)}"


def _path_in(file: str, task: str) -> Path:
    """Path of a policy in a task; what has the task in it is no name of the zoo."""
    return policy_path(Path(file.replace(TASK, Path(task).stem)) if TASK in file else file)
