"""Every problem of a scene file, with the line that it stands on."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from pydantic import ValidationError

from dq_space_arm_env import SceneError, load_scene


class LocatedProblem(NamedTuple):
    """A mistake in a file.

    Attributes:
        line: Where, from 1; None if it is not known.
        field: Keys and indices that lead to it, for example "links[1].mass"; None if there is no field.
        message: Field, value, and what would be right.
    """

    line: int | None
    field: str | None
    message: str


def check(source: str) -> list[LocatedProblem]:
    """Find the problems of a scene.

    Args:
        source: Path of a file, or name of a scene.

    Returns:
        The problems in the order of the file; none if it is valid.
    """
    try:
        load_scene(source)
    except SceneError as error:
        cause = error.__cause__
        if isinstance(cause, ValidationError):
            found = _located(cause, _tree(source))
            return sorted(found, key=lambda problem: problem.line or 0)
        message = str(error).removeprefix(f"{source}: ")
        return [LocatedProblem(_line_of(cause), None, message)]
    return []


def _tree(source: str) -> yaml.Node | None:
    """The file as YAML nodes, which know their lines."""
    path = Path(source)
    if not path.is_file():
        return None
    tree: yaml.Node | None = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    return tree


def _line_of(cause: BaseException | None) -> int | None:
    """Line of a mistake in the YAML itself."""
    if isinstance(cause, yaml.MarkedYAMLError) and cause.problem_mark is not None:
        return int(cause.problem_mark.line) + 1
    return None


def _located(error: ValidationError, tree: yaml.Node | None) -> list[LocatedProblem]:
    found = []
    for detail in error.errors(include_url=False):
        context = detail.get("ctx", {})
        field = str(context["path"]) if "path" in context else None
        found.append(LocatedProblem(_line(tree, detail["loc"]), field, detail["msg"]))
    return found


def _line(tree: yaml.Node | None, location: Sequence[str | int]) -> int | None:
    """Line of the key at a location, or of the nearest one around it that the file has."""
    if tree is None:
        return None
    node, line = tree, tree.start_mark.line
    for part in location:
        if isinstance(node, yaml.MappingNode):
            entry = next((pair for pair in node.value if pair[0].value == part), None)
            if entry is None:
                break
            line, node = entry[0].start_mark.line, entry[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line
        else:
            break
    return int(line) + 1
