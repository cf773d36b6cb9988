"""Changes of a model: a mapping changes what it names, anything else replaces what is there."""

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.validation.problems import Model, field_path

_MOST_DIGITS = 18  # of a position; Python refuses to read some thousands


class ChangeError(ValueError):
    """A path that leads nowhere."""


def nested(changes: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Turn paths, such as "links.0.mass", with their values into mappings within mappings.

    Raises:
        ChangeError: If two paths change the same.
    """
    tree: dict[str, Any] = {}
    for path, value in changes:
        *parents, last = str(path).split(".")
        here = tree
        for key in parents:
            inner = here.setdefault(key, {})
            if not isinstance(inner, Mapping):
                raise ChangeError(f"{path}: {key} is replaced as a whole by another change")
            here[key] = here = dict(inner)
        if last in here:
            raise ChangeError(f"{path}: is changed twice, it should be once")
        here[last] = value
    return tree


def merged(present: Any, change: Any, location: tuple[str | int, ...] = ()) -> Any:
    """Data of what is present with a change, for validation.

    Raises:
        ChangeError: If a position is named that a list does not have.
    """
    if not isinstance(change, Mapping):
        return change
    if isinstance(present, Model):
        kind = getattr(present, "kind", None)
        if not change.keys().isdisjoint(present._other_keys) or change.get("kind", kind) != kind:
            return change  # another way to write all of it, or something else
        fields = {name: getattr(present, name) for name in type(present).model_fields}
        return fields | {
            key: merged(fields.get(key), value, (*location, key)) for key, value in change.items()
        }
    by_position = all(list_position(key) is not None for key in change)
    # A vector may be written as a mapping, an axis and an angle; a list of parts may not.
    if isinstance(present, tuple) and (by_position or any(isinstance(part, Model) for part in present)):
        entries = list(present)
        for key, value in change.items():
            position = list_position(key)
            if position is None or position >= len(entries):
                here = field_path(location)
                raise ChangeError(
                    f"{here} has {len(entries)} entries, the first is 0; there is no {shortened(key)}"
                )
            entries[position] = merged(entries[position], value, (*location, position))
        return entries
    return change


def list_position(key: Any) -> int | None:
    """Position in a list that a key names, 0 for the first; None if it names none."""
    if isinstance(key, str) and key.isdecimal():
        return int(key) if len(key) <= _MOST_DIGITS else sys.maxsize
    return key if isinstance(key, int) and key >= 0 else None
