"""Atomic files, checks of files, folders and archives, JSON."""

import contextlib
import json
import math
import os
import re
import shutil
import stat
import time
from pathlib import Path
from typing import Any

from dq_space_arm_env.common.bounded_reading import kind_of

STALE = 86_400.0
"""Age at which the temporary file of a killed process is removed, s; a living one is renamed long before."""

_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{16}\.part", re.DOTALL)


def write_atomically(path: Path, content: str | bytes, *, durable: bool = False) -> None:
    """Write a file in one go, or leave the existing one as it is.

    A link stays, and the file it points to is written. An existing file keeps its permissions; a new one gets
    those of any other file. What killed processes left of earlier attempts is removed once it is `STALE`.

    Args:
        path: File to write.
        content: New content; text is encoded in UTF-8.
        durable: Whether to wait until the disk has it.

    Raises:
        ValueError: If a device, a pipe, a socket or a folder is there.
        OSError: If the file cannot be written, for example on a full disk.
    """
    target, mode = _target(path)
    data = content.encode() if isinstance(content, str) else content
    _replace(target, data, mode=mode, durable=durable)
    remove_leftovers(target.parent, target.name, age=STALE)


def write_privately(path: Path, content: bytes) -> None:
    """Replace whatever is at a path, in one go, by a file that only this user may read or write."""
    _replace(path, content, creation_mode=0o600)


def temporary_name(name: str) -> str:
    """Return a hidden name that no other host, process or thread uses, for what will be renamed to `name`."""
    return f".{name}.{os.urandom(8).hex()}.part"


def remove_leftovers(folder: Path, name: str | None = None, *, age: float = 0.0) -> None:
    """Remove temporary files and folders that killed processes left in a folder.

    Args:
        folder: Folder to look in.
        name: Only those of the file of this name.
        age: Only those that were last written this long ago, s. Without an age, the caller holds the lock of
            the folder.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _TEMPORARY.fullmatch(entry.name)
            if match is None or (name is not None and match[1] != name):
                continue
            with contextlib.suppress(OSError):
                if time.time() - entry.stat(follow_symlinks=False).st_mtime >= age:
                    is_folder = entry.is_dir(follow_symlinks=False)
                    shutil.rmtree(entry) if is_folder else Path(entry).unlink()


def _replace(
    path: Path, data: bytes, *, mode: int | None = None, creation_mode: int = 0o666, durable: bool = False
) -> None:
    """Write a temporary file beside a path, and rename it."""
    temporary = path.with_name(temporary_name(path.name))
    # O_EXCL: never through a link or into a file that is there already.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(temporary, flags, creation_mode), "wb") as file:
            file.write(data)
            if mode is not None:
                temporary.chmod(mode)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:  # nobody knows the temporary name, and a full disk names no file
        raise OSError(error.errno, error.strerror or str(error), os.fspath(path)) from error
    finally:
        with contextlib.suppress(OSError):  # where it could not be made, it cannot be removed
            temporary.unlink()
    if durable:
        _flush_names(path.parent)


def _target(path: Path) -> tuple[Path, int | None]:
    """Follow links; return the file and its permissions, None if it does not exist."""
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return target, None
    if not stat.S_ISREG(mode):
        raise ValueError(f"{path} is {kind_of(mode)}: name a regular file, or one that does not exist")
    return target, stat.S_IMODE(mode)


def flush(folder: Path) -> None:
    """Wait until the disk has the files in a folder, and the names of all that is in it."""
    for path in folder.iterdir():
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())
    _flush_names(folder)


def _flush_names(folder: Path) -> None:
    """Wait until the disk has the names of what is in a folder."""
    if os.name == "nt":  # Windows opens no folders
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_writable_file(path: Path, *read: str | Path | None) -> None:
    """Raise ValueError if a file cannot be created or replaced, or is one that is read; create nothing."""
    target, mode = _target(path)
    if path.is_symlink() and not target.parent.is_dir():
        raise ValueError(f"{path} links to {target}, whose folder does not exist")
    check_writable(target.parent)
    if mode is not None and not os.access(target, os.W_OK):
        raise ValueError(f"{path}: no permission to write this file")
    # A name of a scene or policy is no file.
    if mode is not None and target.resolve() in [Path(each).resolve() for each in read if each is not None]:
        raise ValueError(f"{path} is what is read, which it would replace: name another file")


def check_writable(folder: Path) -> None:
    """Raise ValueError if a folder cannot be created or written; create nothing."""
    # Path.exists would fail below a folder that may not be entered.
    nearest = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise ValueError(f"cannot create {folder}: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        place = "there" if nearest == folder else f"in {nearest}"
        raise ValueError(f"{folder}: no permission to write {place}")


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


def differences(there: dict[str, Any], here: dict[str, Any], prefix: str = "") -> list[str]:
    """Describe each entry in which two mappings of JSON values differ."""
    found = []
    for key in sorted({*there, *here}):
        name, old, new = f"{prefix}{key}", there.get(key), here.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{name}.")
        elif old != new:
            found.append(f"{name} is {_short_json(old)} there and {_short_json(new)} here")
    return found


def _short_json(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."
