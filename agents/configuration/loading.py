"""Load and validate configurations by name, path or content."""

import importlib.resources
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from agents.configuration.algorithms import Algorithm
from agents.configuration.gradients import AnalyticPolicyGradient, GradientConfiguration
from agents.configuration.imitation import ActionChunking, Cloning, Dagger, ImitationConfiguration
from agents.configuration.reinforcement import Configuration
from agents.configuration.residual import ResidualConfiguration, ResidualPPO, ResidualSAC
from agents.configuration.schema import AgentConfiguration
from dq_space_arm_env import SceneError, load_scene
from dq_space_arm_env.common.bounded_reading import UnreadableError
from dq_space_arm_env.common.shown_text import shortened, yaml_like
from dq_space_arm_env.validation import (
    YAMLError,
    did_you_mean,
    mapping_at_top,
    parse_yaml,
    problem_list,
    read_yaml,
    yaml_problem,
)

_SUFFIXES = (".yaml", ".yml")


def _names(algorithm: Any) -> tuple[str, ...]:
    return get_args(algorithm.model_fields["name"].annotation)


_CLASSES: dict[str, type[AgentConfiguration]] = {
    name: kind
    for kind, algorithms in (
        (Configuration, get_args(get_args(Algorithm)[0])),
        (GradientConfiguration, (AnalyticPolicyGradient,)),
        (ImitationConfiguration, (Cloning, Dagger, ActionChunking)),
        (ResidualConfiguration, (ResidualPPO, ResidualSAC)),
    )
    for algorithm in algorithms
    for name in _names(algorithm)
}
"""Configuration class by algorithm name."""


class ConfigurationError(ValueError):
    """An unusable configuration; the message gives field, value, and what would be right."""


def list_configurations() -> list[str]:
    """Names of the configurations that ship with the package, sorted."""
    names = (Path(entry.name) for entry in _directory().iterdir())
    return sorted(name.stem for name in names if name.suffix == ".yaml")


def load_configuration(source: str | Path | Mapping[str, Any] | AgentConfiguration) -> AgentConfiguration:
    """Load and validate a configuration.

    Args:
        source: Name of a shipped configuration ("ppo"), path of a YAML file (with a slash or ending in
            .yaml), its content as a mapping, or a configuration.

    Returns:
        The configuration, of the class its algorithm belongs to.

    Raises:
        ConfigurationError: If it cannot be found, read or validated; the message lists every problem.
    """
    if isinstance(source, AgentConfiguration):
        return _validated(type(source), source, f"configuration {source.name!r}")
    if isinstance(source, Mapping):
        return _of_its_class(source, f"configuration {shortened(source.get('name'))}")
    if not isinstance(source, str | Path):
        raise ConfigurationError(
            f"{shortened(source)} is no configuration: give a name, the path of a YAML file, a mapping or an "
            "AgentConfiguration"
        )
    if isinstance(source, Path) or "/" in source or "\\" in source or source.endswith(_SUFFIXES):
        return _read(Path(source))
    names = list_configurations()
    if source not in names:
        close = did_you_mean(source, names)
        raise ConfigurationError(
            f"no configuration is named {shortened(source)}{f'; {close}' if close else '. '}They are "
            f"{', '.join(names)}; give a file of your own by its path, ending in .yaml"
        )
    return _read(_directory() / f"{source}.yaml")


def _directory() -> Traversable:
    installed = importlib.resources.files("agents") / "configs"
    checkout = Path(__file__).resolve().parents[2] / "configs" / "agents"
    for directory in (installed, checkout):
        if directory.is_dir():
            return directory
    raise ConfigurationError(
        f"the configurations that ship with the package are missing: neither {installed} nor {checkout} is a "
        "folder"
    )


def _read(file: Traversable) -> AgentConfiguration:
    try:
        # A package in a zip file has its configurations there.
        data = read_yaml(file) if isinstance(file, Path) else parse_yaml(file.read_text(encoding="utf-8"))
        content = mapping_at_top(file, data)
        if "links" in content and "algorithm" not in content:
            raise ConfigurationError(
                f"{file} is a scene, should be a configuration of an agent; to train for the scene: "
                f"dq-space-arm train apg --scene {file}"
            )
        return _of_its_class(content, str(file))
    except UnreadableError as error:
        raise ConfigurationError(str(error)) from error
    except YAMLError as error:
        raise ConfigurationError(f"{file}: not valid YAML: {yaml_problem(error)}") from error


def _of_its_class(data: Mapping[str, Any], origin: str) -> AgentConfiguration:
    algorithm = data.get("algorithm")
    name = algorithm.get("name") if isinstance(algorithm, Mapping) else None
    if isinstance(name, str) and name in _CLASSES:
        return _validated(_CLASSES[name], dict(data), origin)
    known = f"it must be one of {', '.join(_CLASSES)}"
    known = did_you_mean(name, _CLASSES, known) if isinstance(name, str) else known
    wrong = f"algorithm.name = {shortened(name)}: {known}"
    if algorithm is not None and not isinstance(algorithm, Mapping):
        example = algorithm if isinstance(algorithm, str) and algorithm in _CLASSES else "PPO"
        wrong = f"algorithm = {yaml_like(algorithm)}: must be a mapping, as {{name: {example}}}"
    problems = _scene_problems(data)
    try:
        _CommonKeys.model_validate(dict(data))
    except ValidationError as error:
        raise ConfigurationError(problem_list(origin, error, wrong, *problems)) from error
    raise ConfigurationError(problem_list(origin, None, wrong, *problems))


class _CommonKeys(AgentConfiguration, extra="ignore"):
    """The keys of every algorithm."""


def _validated(kind: type[AgentConfiguration], data: object, origin: str) -> AgentConfiguration:
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        problems = _scene_problems(data) if isinstance(data, Mapping) else ()
        raise ConfigurationError(problem_list(origin, error, *problems)) from error


def _scene_problems(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Tell what is wrong with the scene, which is not loaded here where the rest is right."""
    scene = data.get("scene")
    try:
        if isinstance(scene, str):
            load_scene(scene)
    except SceneError as error:
        return (f"scene: {str(error).splitlines()[0]}",)
    return ()
