"""Files of arrays that are read where they lie, in the format safetensors.

A file begins with the length of its header, 8 bytes, little-endian, and the header in JSON: name, type, shape
and place of each array, and notes. Libraries for NumPy, PyTorch and others read it; here its arrays are views
of the mapped file, so that only what is looked at is read from the disk.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experts.demonstrations.errors import DemonstrationsError

_TYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "U8": "u1"}
_NOTES = "notes"


class Tensors(NamedTuple):
    """What a file holds.

    Attributes:
        arrays: Read-only views of the mapped file, by name.
        notes: JSON values.
    """

    arrays: Mapping[str, NDArray[Any]]
    notes: Mapping[str, Any]


def pack(arrays: Mapping[str, NDArray[Any]], notes: Mapping[str, Any]) -> bytes:
    """Write arrays into the bytes of a file; equal arrays and notes give equal bytes.

    Args:
        arrays: By name.
        notes: JSON values.

    Returns:
        The content of the file.
    """
    from safetensors.numpy import save  # who only solves needs it not

    # All notes under one key: the library writes several in an order that differs from process to process.
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return bytes(save(content, {_NOTES: json.dumps(notes, sort_keys=True)}))


def map_tensors(path: Path) -> Tensors:
    """Map a file that `pack` wrote.

    Args:
        path: The file.

    Returns:
        Its arrays and notes. The file may be removed while they are in use, but must not be changed.

    Raises:
        DemonstrationsError: If there is no such file, or it is none of this format.
    """
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
