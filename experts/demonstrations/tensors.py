"""Memory-mapped files of arrays, in the safetensors format.

A file begins with the length of its header, 8 bytes, little-endian, and the header in JSON: name, type, shape
and offset of each array, and notes. Libraries for NumPy, PyTorch and others read it; here its arrays are
views of the mapped file, so that only the parts in use are read from disk.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common import bounded_formats
from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json
from dq_space_arm_env.common.shown_text import shortened

_NOTES = "notes"


class Tensors(NamedTuple):
    """Content of a file."""

    arrays: Mapping[str, NDArray[Any]]  # read-only views of the mapped file
    notes: Mapping[str, Any]  # JSON values


def pack(arrays: Mapping[str, NDArray[Any]], notes: Mapping[str, Any]) -> bytes:
    """Serialize arrays and notes; equal input gives equal bytes."""
    from safetensors.numpy import save  # solving alone does not need it

    # One key for all notes: the library writes several in an order that differs between processes.
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return bytes(save(content, {_NOTES: json.dumps(notes, sort_keys=True)}))


def map_tensors(path: Path) -> Tensors:
    """Map a file written by `pack`, which must not change while it is in use."""
    try:
        arrays, metadata = bounded_formats.map_tensors(path)
        notes = parse_json(metadata.get(_NOTES, ""), f"{path}: notes")
        if not isinstance(notes, dict):
            raise UnreadableError(f"{path}: notes are {shortened(notes, 40)}, they should be a mapping")
    except UnreadableError as error:
        raise DemonstrationsError(f"{path} cannot be read ({error}); generate it again") from error
    return Tensors(arrays, notes)


class DemonstrationsError(RuntimeError):
    """Demonstrations cannot be created, resumed or read; the message says why, and what to do."""
