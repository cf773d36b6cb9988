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

_TYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "U8": "u1"}
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
        content = np.memmap(path, mode="r").view(np.ndarray)
        begin = 8 + int.from_bytes(content[:8].tobytes(), "little")
        header = json.loads(content[8:begin].tobytes())
        notes = json.loads(header.pop("__metadata__")[_NOTES])
        arrays = {name: _view(content[begin:], entry) for name, entry in header.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DemonstrationsError(f"{path} cannot be read ({error}); generate it again") from error
    return Tensors(arrays, notes)


def _view(content: NDArray[np.uint8], entry: Mapping[str, Any]) -> NDArray[Any]:
    start, stop = entry["data_offsets"]
    return content[start:stop].view(_TYPES[entry["dtype"]]).reshape(entry["shape"])


class DemonstrationsError(RuntimeError):
    """Demonstrations cannot be created, resumed or read; the message says why, and what to do."""
