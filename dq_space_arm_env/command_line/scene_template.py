"""A scene as a file to edit: every key with its value, and its description in the schema as a comment.

Absent parts stand there as comments.
"""

import json
import math
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from dq_space_arm_env import Scene
from dq_space_arm_env.scene import Pose
from dq_space_arm_env.scene.phases import Phase

WIDTH = 110
_HEADER = """\
# A scene: a spacecraft with an arm, and its maneuver.
# SI units: m, kg, s, rad, N, N m. Quaternions are [w, x, y, z]; a rotation may also be written as
# {axis: [x, y, z], angle: degrees}. Missing keys take their defaults.
# `dq-space-arm scenes validate FILE` lists the problems of this file with their lines.
"""


def commented_yaml(scene: Scene) -> str:
    """Write a scene with a comment at every key."""
    return _HEADER + "\n" + "\n".join(_mapping(scene, "", apart=True)) + "\n"


def _mapping(model: BaseModel, indent: str, *, apart: bool = False, explained: bool = True) -> Iterator[str]:
    """The keys of a model; `apart` sets an empty line before parts that take several lines."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        comment = (field.description or "") if explained else ""
        if value is None or value == ():
            if explained:
                yield from _comment(f"{name}: absent. {comment}", indent)
            continue
        if isinstance(model, Phase) and name == "changes":
            yield from _with_comment(f"{indent}{name}:", comment, indent)
            yield from (f"{indent}  {path}: {_untyped(number)}" for path, number in value)
            continue
        models = isinstance(value, tuple) and isinstance(value[0], BaseModel)
        line = f"{indent}{name}: {_inline(value)}" if isinstance(value, Pose) else ""
        nested = isinstance(value, BaseModel) and not 0 < len(line) <= WIDTH
        if not nested and not models:
            yield from _with_comment(line or f"{indent}{name}: {_inline(value)}", comment, indent)
            continue
        if apart:
            yield ""
        yield from _with_comment(f"{indent}{name}:", comment, indent)
        if nested:
            yield from _mapping(value, indent + "  ")
            continue
        for i, item in enumerate(value):
            lines = list(_mapping(item, indent + "    ", explained=i == 0))
            first = next(k for k, line in enumerate(lines) if not line.lstrip().startswith("#"))
            lines[first] = f"{indent}  - {lines[first].lstrip()}"
            yield from lines


def _with_comment(line: str, comment: str, indent: str) -> Iterator[str]:
    """A line with its comment behind it, or above it where there is no room."""
    if not comment:
        yield line
    elif len(line) + len(comment) + 3 <= WIDTH:
        yield f"{line} # {comment}"
    else:
        yield from _comment(comment, indent)
        yield line


def _comment(text: str, indent: str) -> Iterator[str]:
    words, line = text.split(), f"{indent}#"
    for word in words:
        if len(line) + 1 + len(word) > WIDTH:
            yield line
            line = f"{indent}#"
        line += f" {word}"
    yield line


def _inline(value: Any) -> str:
    """A value on one line, as YAML."""
    if isinstance(value, Pose):
        parts = (f"position: {_inline(value.position)}", f"rotation: {_inline(value.rotation)}")
        return "{" + ", ".join(parts) + "}"
    if isinstance(value, tuple):
        if _is_diagonal(value):
            value = tuple(value[i][i] for i in range(3))
        return f"[{', '.join(map(_inline, value))}]"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, int):
        return str(value)
    # JSON's text is YAML's, but for pairs of surrogates; what YAML takes for the end of a line is escaped.
    text = json.dumps(str(value), ensure_ascii=False)
    return "".join(each if each.isprintable() else f"\\U{ord(each):08x}" for each in text)


def _untyped(value: Any) -> str:
    """A value whose type nothing tells but how it is written: 2.0 stays 2.0."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_untyped, value))}]"
    return repr(value) if isinstance(value, float) and math.isfinite(value) else _inline(value)


def _is_diagonal(value: tuple[Any, ...]) -> bool:
    """Whether it is an inertia that three numbers say as well."""
    rows = all(isinstance(row, tuple) and len(row) == 3 for row in value)
    return rows and all(value[i][j] == 0.0 for i in range(len(value)) for j in range(3) if i != j)


def _number(value: float) -> str:
    """The shortest text that reads as the same number."""
    if math.isinf(value):
        return ".inf" if value > 0.0 else "-.inf"
    text = repr(value)
    return text.removesuffix(".0")
