"""The space of a search: a YAML file of the hyperparameters that may vary, by their keys."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError

from agents.configuration import AgentConfiguration, ConfigurationError, load_configuration
from agents.configuration.residual import ResidualConfiguration
from dq_space_arm_env.common.bounded_reading import UnreadableError
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.validation import (
    Flag,
    Model,
    Problem,
    YAMLError,
    mapping_at_top,
    problem,
    problem_list,
    read_yaml,
    yaml_problem,
)
from dq_space_arm_env.validation.changes import ChangeError, merged, nested

_IDENTITY = ("name", "description", "scene", "seed", "threads")
"""Keys of a configuration that are no hyperparameters; nor are seeds of its parts."""
_JUDGING = ("curve", "progression", "schedule")
"""Parts of a configuration that say how long trials may learn, and which flights they are judged by."""

_BETWEEN = 0.5 * (5.0**0.5 - 1.0)  # place in a range whose value is hardly ever a whole number


def _number(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise problem("must be a finite number")
    return value


class Parameter(Model):
    """Values that a hyperparameter may take: a range, of integers if both ends are, or choices."""

    low: Annotated[Any, BeforeValidator(_number)] = Field(default=None, description="smallest value")
    high: Annotated[Any, BeforeValidator(_number)] = Field(default=None, description="largest value")
    log: Flag = Field(default=False, description="whether factors count rather than differences")
    choices: tuple[Any, ...] | None = Field(default=None, description="values, two or more")

    def _problems(self) -> Iterator[Problem]:
        if self.choices is not None:
            if self.low is not None or self.high is not None or self.log:
                yield Problem(("choices",), self.choices, "must stand alone, without low, high and log")
            if len(self.labels) < 2 or len(self.labels) < len(self.choices):
                yield Problem(("choices",), self.choices, "must be two or more, all different")
        elif self.low is None or self.high is None:
            missing = "low" if self.low is None else "high"
            yield Problem((missing,), None, "is missing: give low and high, or choices")
        elif not self.low < self.high:
            yield Problem(("high",), self.high, f"must be larger than low, which is {self.low}")
        elif self.log and self.low <= 0:
            yield Problem(("low",), self.low, "must be positive on a logarithmic scale")

    @property
    def labels(self) -> dict[str, Any]:
        """Choices by a text for each, as a study keeps them."""
        return {json.dumps(choice, default=str): choice for choice in self.choices or ()}

    @property
    def is_whole(self) -> bool:
        """Whether its values are integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def examples(self) -> tuple[Any, ...]:
        """Values that all have to be valid for the others to be."""
        if self.choices is not None:
            return self.choices
        between = () if self.is_whole else (self.low + _BETWEEN * (self.high - self.low),)
        return (self.low, self.high, *between)


class SearchSpace(Model):
    """Hyperparameters that vary in a search."""

    search: Mapping[str, Parameter] = Field(
        min_length=1, description="ranges or choices by key, such as algorithm.learning_rate"
    )


def load_search_space(path: str | Path, configuration: AgentConfiguration) -> SearchSpace:
    """Read a search space, and check that its values fit a configuration.

    Args:
        path: A YAML file with the mapping `search`.
        configuration: Where the values go.

    Returns:
        The space.

    Raises:
        ConfigurationError: If it cannot be read, a key is no hyperparameter of the configuration, says how
            trials are judged, or is part of another, or one of its values is not allowed there.
    """
    try:
        space = SearchSpace.model_validate(mapping_at_top(path, read_yaml(path)))
    except UnreadableError as error:
        raise ConfigurationError(str(error)) from error
    except YAMLError as error:
        raise ConfigurationError(f"{path}: not valid YAML: {yaml_problem(error)}") from error
    except ValidationError as error:
        raise ConfigurationError(problem_list(str(path), error)) from error
    for key, parameter in space.search.items():
        part, last = key.partition(".")[0], key.rpartition(".")[2]
        is_residual = isinstance(configuration, ResidualConfiguration)  # whose mismatch its flights meet
        if part in _JUDGING or (part == "mismatch" and is_residual):
            raise ConfigurationError(
                f"{path}: search.{key}: {part} says how trials are judged, and has to be the same for all: "
                "leave it out"
            )
        if part in _IDENTITY or last == "seed":
            raise ConfigurationError(f"{path}: search.{key}: {key} is no hyperparameter: leave it out")
        for other in space.search:
            if other.startswith(f"{key}."):
                raise ConfigurationError(f"{path}: search.{other}: is part of search.{key}: give one of them")
        for value in parameter.examples:
            try:
                with_values(configuration, {key: value})
            except ConfigurationError as error:
                said = f"{path}: search.{key}: the value {shortened(value)} is not possible"
                raise ConfigurationError(f"{said}; {error}") from error
    return space


def with_values(
    configuration: AgentConfiguration, values: Mapping[str, Any], name: str | None = None
) -> AgentConfiguration:
    """A configuration with other values of some keys, and another name.

    Raises `ConfigurationError` if they are not possible.
    """
    changes = {**values, "name": configuration.name if name is None else name}
    try:
        return load_configuration(_plain(merged(configuration, nested(changes.items()))))
    except ChangeError as error:
        raise ConfigurationError(str(error)) from error


def _plain(data: Any) -> Any:
    """Mappings and lists in place of models, without what is absent."""
    if isinstance(data, Model):
        return data.model_dump(exclude_none=True)
    if isinstance(data, Mapping):
        return {key: _plain(value) for key, value in data.items() if value is not None}
    return [_plain(value) for value in data] if isinstance(data, list | tuple) else data
