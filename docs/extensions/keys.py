"""Tables of the keys of YAML files: meaning, unit, kind and default, from the schema that checks them."""

from __future__ import annotations

import re
import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

UNITS = (
    "1/(N m)^2", "(s/rad)^2", "N m s/rad", "kg m^2", "N m/rad", "rad/s^2", "1/N^2", "deg/s", "rad/s", "N m/s",
    "m/rad", "rad/m", "N s/m", "N s", "N/m", "m/s", "N m", "N/s", "degrees", "deg", "pixels", "rad", "kg",
    "m", "s", "N", "W",
)  # fmt: skip
"""Units as descriptions write them, longer ones before their parts."""
_UNIT = re.compile(r"(?<![\w/^])(" + "|".join(re.escape(unit) for unit in UNITS) + r")(?![\w/^])")


def models_of(model: type[BaseModel]) -> list[type[BaseModel]]:
    """List a model and all models that its fields are made of, each once, in the order of the fields.

    Args:
        model: The outermost one.

    Returns:
        The models.
    """
    found = [model]
    for field in _fields(model).values():
        for inner in _models_in(field.annotation):
            found += [each for each in models_of(inner) if each not in found]
    return found


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields by name, but for those that files must leave out."""
    return {name: field for name, field in model.model_fields.items() if not field.exclude}


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_in(part)


def units_of(field: FieldInfo) -> list[str]:
    """Find the units that a field's description names.

    Args:
        field: Of a model.

    Returns:
        The units, each once; none for what has no unit.
    """
    return list(dict.fromkeys(_UNIT.findall(field.description or "")))


def holds_numbers(field: FieldInfo) -> bool:
    """Tell whether a field holds real numbers, which have a unit or say that they have none.

    Args:
        field: Of a model.

    Returns:
        True for numbers and lists of them; false for counts, names, switches and parts.
    """
    return float in _leaves(field.annotation)


def _leaves(annotation: Any) -> set[Any]:
    parts = get_args(annotation)
    if get_origin(annotation) is Literal or not parts:
        return {annotation}
    return set().union(*(_leaves(part) for part in parts))


def key_tables(model: type[BaseModel], names: dict[type[BaseModel], str] | None = None) -> str:
    """Write the keys of a model and of its parts, a section with a table for each.

    Where a place takes one of several parts, what all of them have comes once, before the first of them.

    Args:
        model: The outermost model.
        names: Headings of the sections, by model; by default where the part stands in the file.

    Returns:
        Markdown, its headings of level 3.
    """
    parts = models_of(model)
    headings = _paths(model) | (names or {})
    rows = {part: _rows(part) for part in parts}
    sections, common = [], {}
    for part in parts:
        place = headings[part]
        together = [other for other in parts if headings[other] == place]
        if len(together) > 1 and place not in common:
            common[place] = [row for row in rows[part] if all(row in rows[other] for other in together)]
            if common[place]:
                sections.append(_section(place, "Keys of every kind.", common[place]))
        own = [row for row in rows[part] if row not in common.get(place, ())]
        sections.append(_section(place + _choice(part), _text(part.__doc__ or ""), own))
    return "\n".join(sections)


def _paths(model: type[BaseModel]) -> dict[type[BaseModel], str]:
    """Where each part first stands in the file: `links[].joint`."""
    paths = {model: "Top level"}

    def walk(outer: type[BaseModel], prefix: str) -> None:
        for name, field in _fields(outer).items():
            dots = "[]" if _is_list(field.annotation) else ""
            for inner in _models_in(field.annotation):
                if inner not in paths:
                    paths[inner] = f"`{prefix}{name}{dots}`"
                    walk(inner, f"{prefix}{name}{dots}.")

    walk(model, "")
    return paths


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) in (tuple, list)


def _section(heading: str, text: str, rows: list[str]) -> str:
    table = ["", "| key | meaning | kind | default |", "|---|---|---|---|", *rows] if rows else []
    return "\n".join([f"### {heading}", "", text, *table]) + "\n"


def _rows(model: type[BaseModel]) -> list[str]:
    """The rows of its table: all keys but the one that its heading has."""
    rows = []
    for name, field in _fields(model).items():
        if (name, field) != _chooser(model):
            cells = (f"`{name}`", _text(field.description or ""), kind_of(field), default_of(field))
            rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return rows


def _chooser(model: type[BaseModel]) -> tuple[str, FieldInfo] | None:
    """The key by which a file chooses a part, where there are several for one place: it has one value."""
    fields = ((name, model.model_fields[name]) for name in ("kind", "name") if name in model.model_fields)
    return next(((name, f) for name, f in fields if get_origin(f.annotation) is Literal), None)


def _choice(model: type[BaseModel]) -> str:
    chooser = _chooser(model)
    return f", `{chooser[0]}: {get_args(chooser[1].annotation)[0]}`" if chooser else ""


def _text(text: str) -> str:
    """A docstring or description as Markdown: one paragraph, brackets and stars as they stand."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(part if part.startswith("`") else re.sub(r"([\[\]*_<>])", r"\\\1", part) for part in parts)


def kind_of(field: FieldInfo) -> str:
    """Say in a few words what a key holds.

    Args:
        field: Of a model.

    Returns:
        Markdown.
    """
    return _kind(field.annotation)


def _kind(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(parts[0])
    if origin is Literal:
        return " or ".join(f"`{part}`" for part in parts)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_kind(part) for part in parts if part is not type(None)))
    if origin is tuple:
        if parts and get_origin(parts[0]) is tuple and get_args(parts[0])[1] is Any:  # read from a mapping
            return "mapping: text to value"
        one = _kind(parts[0])
        if len(parts) == 2 and parts[1] is Ellipsis:
            return {"number": "numbers", "keys": "list of keys"}.get(one, f"list: {one}")
        return f"{len(parts)} {one}s" if one == "number" else f"{len(parts)} x {one}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "keys"
    known = {float: "number", int: "whole number", str: "text", bool: "`true` or `false`"}
    return known.get(annotation, str(annotation))


def default_of(field: FieldInfo) -> str:
    """Write a default as a file would.

    Args:
        field: Of a model.

    Returns:
        Markdown; "required" where there is none.
    """
    if field.is_required():
        return "**required**"
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is None or value is PydanticUndefined:
        return "absent"
    if isinstance(value, BaseModel):
        changed = value.model_dump(exclude_defaults=True)
        return f"`{changed}`" if changed else "its defaults"
    return f"`{_plain(value)}`"


def _plain(value: Any) -> str:
    if isinstance(value, tuple | list):
        if len(value) > 1 and all(entry == value[0] for entry in value):
            return f"{_plain(value[0])} (each of {len(value)})"
        return "[" + ", ".join(_plain(entry) for entry in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    return str(value) if value != "" else '""'
