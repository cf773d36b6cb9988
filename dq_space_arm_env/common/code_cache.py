"""Machine code on disk, for the next process: the guard of everything that runs without being compiled.

A file is named after its key, the hash of all that its content follows from. It is read only if it belongs to
this user, is writable by nobody else, and its checksum and key match; all of that is checked before any of it
is parsed or loaded. A damaged file is compiled again, with a warning; a folder that cannot be written costs
only the cache. Above `LIMIT` bytes, the files that were not used for the longest time are removed.
"""

import contextlib
import hashlib
import json
import os
import stat
import tempfile
import time
import warnings
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm
import platformdirs

from dq_space_arm_env.common.bounded_reading import UnreadableError, open_regular
from dq_space_arm_env.common.files import STALE, remove_leftovers, write_privately
from dq_space_arm_env.common.host_machine import host_machine

SUFFIX = ".kernel"
LIMIT = 2**30
"""Size of all files together, bytes."""

_MAGIC = b"DQSpaceArm machine code 2\n"
_HASH_BYTES = 32
_USED_AGAIN = 3600.0  # s; the time of the last use is kept no more precisely


def cache_directory() -> Path:
    """Folder of the machine code: $DQ_SPACE_ARM_CACHE, or the platform's user cache folder.

    A user without a home, as some containers have, gets one among the temporary files.
    """
    configured = os.environ.get("DQ_SPACE_ARM_CACHE")
    if configured:
        return Path(os.path.expanduser(configured))  # noqa: PTH111 - leaves "~" as it is without a home
    try:
        folder = Path(platformdirs.user_cache_dir("dq-space-arm"))
    except RuntimeError:  # of recent versions; others leave "~" as it is
        folder = Path("~")
    return folder if folder.is_absolute() else Path(tempfile.gettempdir(), f"dq-space-arm-{os.getuid()}")


def cache_key(*parts: str) -> str:
    """Hash everything that code depends on, including the machine and the version of LLVM."""
    machine = host_machine()
    everything = [*parts, llvmlite.__version__, str(llvm.llvm_version_info), machine.cpu, machine.features]
    return hashlib.sha256(json.dumps(everything).encode()).hexdigest()


def is_kept(name: str, key: str) -> bool:
    """Tell whether there is a file for code, which `read_code` may still refuse."""
    return os.path.isfile(_file(name, key))  # noqa: PTH113 - False below a folder that may not be entered


def read_code(name: str, key: str) -> bytes | None:
    """Read what `keep_code` wrote; None, with a warning unless it is missing, if it may not be used."""
    path, content = _file(name, key), b""
    try:
        with open_regular(path, LIMIT) as file:
            status = os.fstat(file.fileno())
            reason = _distrust(path, status)
            content = b"" if reason else file.read()
    except UnreadableError as error:
        if isinstance(error.__context__, FileNotFoundError | NotADirectoryError):
            return None
        reason = str(error)
    except OSError as error:
        reason = f"{path} cannot be read ({error.strerror})"
    code = _checked(content, key)
    if code is None:
        warnings.warn(f"{reason or f'{path} is damaged'}; its code is compiled again", stacklevel=2)
    elif time.time() - status.st_mtime > _USED_AGAIN:
        with contextlib.suppress(OSError):
            os.utime(path)
    return code


def keep_code(name: str, key: str, code: bytes) -> None:
    """Write code for other processes; warn if that is impossible."""
    path = _file(name, key)
    payload = key.encode() + code
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_privately(path, _MAGIC + hashlib.sha256(payload).digest() + payload)
    except OSError as error:
        warnings.warn(
            f"cannot keep machine code in {path.parent} ({error.strerror}); it is compiled again "
            "in every process. Set DQ_SPACE_ARM_CACHE to a folder that can be written.",
            stacklevel=2,
        )
        return
    _trim(path.parent, LIMIT)


def _file(name: str, key: str) -> Path:
    return cache_directory() / f"{name}-{key[:32]}{SUFFIX}"


def _distrust(path: Path, status: os.stat_result) -> str | None:
    """Explain why a file may not be used, if it may not."""
    if hasattr(os, "getuid") and status.st_uid != os.getuid():
        return f"{path} belongs to another user"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"{path} can be written by others"
    return None


def _checked(content: bytes, key: str) -> bytes | None:
    """Return the code in a file; None if the file is damaged or holds other code."""
    begin = len(_MAGIC) + _HASH_BYTES
    payload = content[begin:]
    if content[:begin] != _MAGIC + hashlib.sha256(payload).digest() or not payload.startswith(key.encode()):
        return None
    return payload[len(key) :]


def _trim(folder: Path, limit: int) -> None:
    """Remove the files that were not used for the longest time, until the others fit into a number of bytes.

    A process that reads one of them has opened it, and reads on; others compile it again.
    """
    remove_leftovers(folder, age=STALE)
    files = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(SUFFIX):
                with contextlib.suppress(OSError):
                    status = entry.stat(follow_symlinks=False)
                    files.append((status.st_mtime, status.st_size, entry.path))
    excess = sum(size for _, size, _ in files) - limit
    for _, size, path in sorted(files):
        if excess <= 0:
            break
        with contextlib.suppress(OSError):
            Path(path).unlink()
        excess -= size
