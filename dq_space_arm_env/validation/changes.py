"""Changes of a model: a mapping changes what it names, anything else replaces what is there."""

from collections.abc import Iterable, Mapping
from typing import Any

from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.validation.problems import Model, field_path


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
    if isinstance(present, tuple) and all(_is_position(key) for key in change):
        entries = list(present)
        for key, value in change.items():
            if int(key) >= len(entries):
                here = field_path(location)
                raise ChangeError(
                    f"{here} has {len(entries)} entries, the first is 0; there is no {shortened(key)}"
                )
            entries[int(key)] = merged(entries[int(key)], value, (*location, int(key)))
        return entries
    return change


def _is_position(key: Any) -> bool:
    return (isinstance(key, int) and key >= 0) or (isinstance(key, str) and key.isdecimal())
