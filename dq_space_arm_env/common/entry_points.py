"""Entry points: what installed packages add to this one, listed without importing them."""

import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from os import listdir
from typing import Any


@cache
def entry_points(group: str) -> dict[str, str]:
    """List the entry points of a group, "module:attribute" by name; the first on `sys.path` wins.

    `importlib.metadata.entry_points` does the same. Importing it takes as long as importing Click, and
    doubles the time until `dq-space-arm --help` answers.
    """
    found: dict[str, str] = {}
    for folder in sys.path:
        for text in _metadata(folder or "."):
            if f"[{group}]" in text:
                section = text.partition(f"[{group}]")[2].partition("\n[")[0]
                for line in section.splitlines():
                    name, equals, reference = line.partition("=")
                    if equals:
                        found.setdefault(name.strip(), reference.partition("[")[0].strip())
    return dict(sorted(found.items()))


def load(reference: str) -> Any:
    """Import the object, or the module, that an entry point refers to."""
    module, _, attribute = reference.partition(":")
    return getattr(import_module(module), attribute) if attribute else import_module(module)


def _metadata(folder: str) -> Iterator[str]:
    """Read `entry_points.txt` of every distribution in a folder of `sys.path`."""
    try:
        names = sorted(listdir(folder))  # noqa: PTH208
    except OSError:
        return
    for name in names:
        if name.endswith((".dist-info", ".egg-info")):
            try:
                with open(f"{folder}/{name}/entry_points.txt", encoding="utf-8") as file:  # noqa: PTH123
                    yield file.read()
            except OSError:
                continue
