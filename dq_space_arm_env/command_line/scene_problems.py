"""Problems of a scene file, with their lines."""

from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError
from ruamel.yaml.error import MarkedYAMLError

from dq_space_arm_env.common.bounded_reading import read_text
from dq_space_arm_env.scene import SceneError, load_scene
from dq_space_arm_env.validation import line_of


class LocatedProblem(NamedTuple):
    """A problem in a file."""

    line: int | None
    field: str | None
    message: str


def check(source: str) -> list[LocatedProblem]:
    """Find the problems of a scene."""
    try:
        load_scene(source)
    except SceneError as error:
        cause = error.__cause__
        if isinstance(cause, ValidationError):
            return _located(cause, Path(source))
        mark = cause.problem_mark if isinstance(cause, MarkedYAMLError) else None
        line = None if mark is None else int(mark.line) + 1
        return [LocatedProblem(line, None, str(error).removeprefix(f"{source}: "))]
    return []


def step_advice(source: str) -> str | None:
    """What the scene's integrator cannot follow, in a sentence; None where its steps are stable."""
    from dq_space_arm_env.dynamics.step_stability import advice

    return advice(load_scene(source))


def warnings(source: str) -> list[str]:
    """What is unwise in a valid scene, a sentence each."""
    from dq_space_arm_env.command_line.scene_warnings import warnings_of

    return warnings_of(load_scene(source))


def _located(error: ValidationError, file: Path) -> list[LocatedProblem]:
    text = read_text(file) if file.is_file() else None
    found = []
    for detail in error.errors(include_url=False):
        line = None if text is None else line_of(text, detail["loc"])
        found.append(LocatedProblem(line, detail.get("ctx", {}).get("path"), detail["msg"]))
    return sorted(found, key=lambda problem: problem.line or 0)
