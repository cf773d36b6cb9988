"""Infos of vector environments: arrays with a row for each sub-environment, and a mask for each array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Info = dict[str, Any]
Rows = NDArray[np.intp]


def single_infos(info: Info, rows: Rows) -> list[Info]:
    """Infos of some sub-environments as Python values, as single environments give them.

    Entries that a sub-environment lacks are left out, and so are those about the end of its last episode.
    """
    found: list[Info] = [{} for _ in rows]
    for name, values in info.items():
        if name.startswith(("_", "final_")):
            continue
        column = single_infos(values, rows) if isinstance(values, dict) else _plain(values, rows)
        mask = info.get(f"_{name}")
        if mask is None or mask[rows].all():
            for each, value in zip(found, column, strict=True):
                each[name] = value
        else:
            for each, value, there in zip(found, column, mask[rows].tolist(), strict=True):
                if there:
                    each[name] = value
    return found


def _plain(values: NDArray[Any], rows: Rows) -> list[Any]:
    """Rows of an array: Python numbers and objects, or arrays of their own."""
    chosen = values[rows]
    return list(chosen) if chosen.ndim > 1 else chosen.tolist()


def with_rows(array: Any, source: Any, rows: Rows) -> Any:
    """A copy of an array, or a dictionary of arrays, with some rows of another."""
    if isinstance(array, dict):
        return {name: with_rows(part, source[name], rows) for name, part in array.items()}
    copied = array.copy()
    copied[rows] = source[rows]
    return copied


def merged(info: Info, source: Info, rows: Rows) -> Info:
    """An info with some rows of another, whose entries may have other names."""
    found: Info = {}
    for name in {**info, **source}:
        here, there = info.get(name), source.get(name)
        if isinstance(here, dict) or isinstance(there, dict):
            found[name] = merged(here or {}, there or {}, rows)
        elif here is None or there is None:
            # An entry that some sub-environments lack; its mask, which starts with "_", tells which.
            values = np.array(here if there is None else there)
            if name.startswith("_"):
                others = values.copy()
                others[rows] = False
                values = others if there is None else values & ~others
            found[name] = values
        else:
            found[name] = with_rows(here, there, rows)
    return found
