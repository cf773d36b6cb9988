"""Files that appear complete or not at all."""

import os
from pathlib import Path


def write_atomically(path: Path, content: str | bytes, *, durable: bool = False) -> None:
    """Write a file; an existing one is replaced in one go, or stays as it is if writing fails.

    Args:
        path: File to write; its folder must exist.
        content: Text, written as UTF-8, or bytes.
        durable: Whether to wait until the disk has it, so that even a power failure leaves the whole file or
            none.
    """
    data = content.encode() if isinstance(content, str) else content
    # Not mkstemp, whose files nobody else may read.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        if durable:
            _flush(temporary)
        temporary.replace(path)
        if durable:
            _flush(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Wait until the disk has the content of a file, or the names of the files in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
