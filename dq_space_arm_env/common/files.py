"""Atomic writes, checks of folders and archives, JSON."""

import json
import math
import os
from pathlib import Path
from typing import Any


def write_atomically(path: Path, content: str | bytes, *, durable: bool = False) -> None:
    """Write a file in one go, or leave the existing one as it is; `durable` waits until the disk has it."""
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
    """Wait until the disk has the content of a file, or the entries of a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_writable(folder: Path) -> None:
    """Raise ValueError if a folder cannot be created or written; create nothing."""
    # Path.exists would fail below a folder that may not be entered.
    nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise ValueError(f"cannot create {folder}: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        place = "there" if nearest == folder else f"in {nearest}"
        raise ValueError(f"{folder}: no permission to write {place}")


def archive_members(path: Path) -> set[str]:
    """List the arrays in an npz file; nothing for any other file."""
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile):
        return set()


def to_json(record: dict[str, Any]) -> str:
    """Write JSON text."""
    return json.dumps(record, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def json_value(value: Any) -> Any:
    """Replace infinities and NaN by None, tuples by lists."""
    if isinstance(value, dict):
        return {key: json_value(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
