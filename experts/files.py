"""Files that appear complete or not at all."""

import os
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file; an existing one is replaced in one go, or stays as it is if writing fails.

    Args:
        path: File to write; its folder must exist.
        content: Text, written as UTF-8, or bytes.
    """
    data = content.encode() if isinstance(content, str) else content
    # Not mkstemp, whose files nobody else may read.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
