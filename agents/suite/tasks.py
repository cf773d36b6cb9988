"""Suites: tasks with the scenes as they were when a version was published, and what counts as solving one."""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StrictStr, ValidationError

from agents.configuration import AgentConfiguration, load_configuration
from agents.configuration.residual import ResidualConfiguration
from agents.configuration.schema import Few, name_in
from agents.evaluation.conditions import CONDITIONS
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.plan_followers import CONTROLLERS
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.bounded_reading import UnreadableError
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.validation import (
    Model,
    NonNegative,
    Problem,
    Share,
    YAMLError,
    count_up_to,
    did_you_mean,
    mapping_at_top,
    problem_list,
    read_yaml,
    yaml_problem,
)

ZOO = "zoo"
"""Entrant: the policies that ship with the package, each in the scene that it was trained in."""
_Starts = Annotated[int, count_up_to(EVALUATION_SEEDS)]
_Hash = Annotated[StrictStr, Field(pattern="^[0-9a-f]{16,64}$")]


class SuiteError(ValueError):
    """An unusable suite; the message says what is wrong, and what would be right."""


class Limits(Model):
    """What a controller has to keep to solve a task."""

    success: Share = Field(description="least share of flights that reach the target")
    violating: Share = Field(description="largest share of flights that violate a constraint")
    cost_gap: NonNegative = Field(description="largest interquartile mean of J / J_expert - 1")

    def are_kept(self, success: float, violating: float | None, cost_gap: float | None) -> bool:
        """Whether a task is solved; no flight violates in a scene without constraints, which has None."""
        keeps = success >= self.success and (violating is None or violating <= self.violating)
        return keeps and cost_gap is not None and cost_gap <= self.cost_gap


class Suite(Model):
    """A version of the suite."""

    name: StrictStr = Field(min_length=1, description="name with its version")
    description: StrictStr = Field(default="", description="what its tasks are")
    starts: _Starts = Field(description="evaluation starts of each task, the first ones")
    receding_starts: _Starts = Field(description="the same of the receding-horizon expert")
    conditions: tuple[StrictStr, ...] = Field(
        default=("training",), min_length=1, description="conditions of the flights, see `scene_under`"
    )
    limits: Limits = Field(description="what solving a task asks for")
    agents: Mapping[StrictStr, Mapping[str, Any]] = Field(
        default_factory=dict, description="configurations without name and scene, trained for each task"
    )
    seeds: Few = Field(default=5, description="trainings of each agent and task")
    tasks: Mapping[StrictStr, _Hash] = Field(
        min_length=1,
        description="scenes, names or YAML files, by the first digits of the hash of their content",
    )

    def _problems(self) -> Iterator[Problem]:
        for name in self.conditions:
            if name not in CONDITIONS:
                yield Problem(("conditions",), name, f"must be one of {', '.join(CONDITIONS)}")
            elif self.conditions.count(name) > 1:
                yield Problem(("conditions",), name, "must stand there once")
        first: dict[str, str] = {}
        for task in self.tasks:
            other = first.setdefault(Path(task).stem, task)
            if other != task:
                sentence = f"has the folders and policies of {other}, the same name: rename its file"
                yield Problem(("tasks", task), task, sentence)
        for name in self.agents:
            if name in (*CONTROLLERS, ZOO):
                yield Problem(("agents",), name, "is the name of a controller: choose another")

    def scene(self, task: str) -> Scene:
        """The scene of a task; SuiteError if it is not what the suite was made of."""
        if task not in self.tasks:
            known = did_you_mean(task, self.tasks, f"choose from {', '.join(self.tasks)}")
            raise SuiteError(f"task: {task!r} is unknown; {known}")
        scene, expected = load_scene(task), self.tasks[task]
        found = scene.content_hash()
        if not found.startswith(expected):
            raise SuiteError(
                f"{self.name}: scene {task} has the hash {found[: len(expected)]}, should be {expected}: the "
                "scene has changed, and results would not compare; use the release that the suite came with"
            )
        return scene

    def training(self, agent: str | Path, task: str) -> AgentConfiguration:
        """Configuration of an agent for a task: one of the suite's, a shipped one, or a YAML file's.

        SuiteError if it cannot fly alone.
        """
        if agent in self.agents:
            content, name = dict(self.agents[str(agent)]), str(agent)
        else:
            given = load_configuration(agent)
            content, name = given.model_dump(exclude_none=True, exclude={"description"}), given.name
        configuration = load_configuration({**content, "name": name_in(name, task), "scene": task})
        if isinstance(configuration, ResidualConfiguration):
            raise SuiteError(
                f"{agent} corrects plans and cannot fly alone: use `dq-space-arm compare residual`"
            )
        return configuration


def list_suites() -> list[str]:
    """Versions of the suite that ship with the package, sorted."""
    return sorted(path.stem for path in _directory().glob("*.yaml"))


def load_suite(source: str | Path | Suite = "v1") -> Suite:
    """Load a suite.

    Args:
        source: A version that ships with the package, the path of a YAML file, or a suite.

    Returns:
        The suite; its scenes are checked when they are loaded.

    Raises:
        SuiteError: If it cannot be found, read or validated; the message lists every problem.
    """
    if isinstance(source, Suite):
        return source
    shipped = list_suites()
    if not isinstance(source, str | Path):
        raise SuiteError(f"suite: {shortened(source)}, should be one of {', '.join(shipped)}, or a YAML file")
    path = _directory() / f"{source}.yaml" if source in shipped else Path(source)
    if source not in shipped and path.suffix not in (".yaml", ".yml"):
        raise SuiteError(f"suite: {str(source)!r}, should be one of {', '.join(shipped)}, or a YAML file")
    try:
        return Suite.model_validate(mapping_at_top(path, read_yaml(path)))
    except UnreadableError as error:
        raise SuiteError(str(error)) from error
    except YAMLError as error:
        raise SuiteError(f"{path}: not valid YAML: {yaml_problem(error)}") from error
    except ValidationError as error:
        raise SuiteError(problem_list(str(path), error)) from error


def _directory() -> Path:
    installed = Path(str(importlib.resources.files("agents"))) / "suites"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "configs" / "suites"
