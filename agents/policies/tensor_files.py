"""Files of tensors as PyTorch writes them, read without executing anything in them."""

from __future__ import annotations

import io
import pickle
import pickletools
import zipfile
import zlib
from typing import Any

MOST_STRUCTURE = 1 << 20
"""Largest description of names and shapes beside the tensors, bytes; a network takes some thousands."""

_MAKERS = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"}


class TensorFileError(ValueError):
    """A file does not hold tensors alone, or is damaged."""


def read_tensors(content: bytes, *, more: int = 0) -> Any:
    """Read what `torch.save` wrote, if it consists of tensors, numbers, text and containers alone.

    PyTorch's own restriction, `weights_only`, allows somewhat more, such as arrays of any length from a few
    bytes; those are refused here before it begins.

    Args:
        content: Bytes of the file.
        more: Bytes that the description may have beyond `MOST_STRUCTURE`, for numbers beside the tensors.

    Returns:
        The tensors in their containers, on the CPU.

    Raises:
        TensorFileError: If the file holds anything else, is compressed, or is damaged.
        ImportError: If PyTorch is not installed.
    """
    import torch

    try:
        _check_structure(content, MOST_STRUCTURE + more)
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except TensorFileError:
        raise
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        EOFError,
        AttributeError,
        RuntimeError,
        RecursionError,
        MemoryError,
        NotImplementedError,
        AssertionError,
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise TensorFileError(f"damaged ({reason})") from error


def _check_structure(content: bytes, most: int) -> None:
    """Refuse files that ask for more than tensors, or for more memory than they have bytes."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise TensorFileError("compressed, which PyTorch's files are not")
        (structure,) = (member for member in members if member.filename.endswith("/data.pkl"))
        if structure.file_size > most:
            raise TensorFileError(f"{structure.file_size:,} bytes of structure, should be {most:,} at most")
        pickled = archive.read(structure)
    for instruction, argument, _ in pickletools.genops(pickled):
        if instruction.name in ("STACK_GLOBAL", "INST"):
            raise TensorFileError(f"asks for {instruction.name}, should hold tensors alone")
        if instruction.name == "GLOBAL" and not _is_plain(str(argument)):
            raise TensorFileError(f"asks for {str(argument)[:80]!r}, should hold tensors alone")


def _is_plain(name: str) -> bool:
    """Whether a pickle's `module name` makes a tensor or a container."""
    module, _, kind = name.partition(" ")
    return name in _MAKERS or (module in ("torch", "torch.storage") and kind.endswith("Storage"))
