"""Read what others wrote: regular files only, bounded in size, nesting and in the memory that they claim.

Sizes that a file declares are checked before memory is spent on them, and nothing is executed or unpickled.
Every refusal is an `UnreadableError`: one sentence that names file, place and value, and what would be right.
"""

from __future__ import annotations

import json
import os
import stat
import zipfile
from pathlib import Path
from typing import IO, Any

from dq_space_arm_env.common.shown_text import LONGEST, shortened

TEXT_BYTES = 8 * 2**20
"""Default limit of a text, which is parsed in half a second."""
ANY_SIZE = 2**63
"""Limit of files that are mapped, or read in parts."""
DEPTH = 64
"""Limit of nesting, some ten times that of our own files, and far below Python's for recursion."""
_INTEGER_BITS = 1023  # larger integers have no float
_PART = 2**20  # bytes read at a time
_MEMBERS = 2**20  # bytes of an archive's directory: some ten thousand members


class UnreadableError(ValueError):
    """A file or a text is not what it should be, or larger than anything plausible."""


def open_regular(path: str | os.PathLike[str], most: int) -> IO[bytes]:
    """Open a regular file of at most so many bytes; a pipe, a device or a folder is refused without waiting.

    Raises:
        UnreadableError: If there is no such file, it cannot be opened, is no regular file, or is larger.
    """
    try:
        _check_kind(path, Path(path).stat(), most)
        # Without waiting: between check and opening, a pipe may have taken its place.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        file = os.fdopen(os.open(path, flags), "rb")
    except FileNotFoundError:
        raise UnreadableError(f"{os.fspath(path)}: there is no such file") from None
    except OSError as error:
        raise UnreadableError(f"{os.fspath(path)}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError) as error:
        if isinstance(error, UnreadableError):
            raise
        raise UnreadableError(f"{shortened(path)} cannot be read: {error}") from error
    try:
        _check_kind(path, os.fstat(file.fileno()), most)
    except UnreadableError:
        file.close()
        raise
    return file


def kind_of(mode: int) -> str:
    """Say what is no regular file; `mode` is that of its status."""
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def _check_kind(path: str | os.PathLike[str], found: os.stat_result, most: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = kind_of(found.st_mode)
        raise UnreadableError(f"{os.fspath(path)} is {kind}, it should be a regular file")
    if found.st_size > most:
        raise _too_large(path, found.st_size, most)


def _too_large(path: str | os.PathLike[str], size: int, most: int) -> UnreadableError:
    return UnreadableError(f"{os.fspath(path)} has {size:,} bytes, it should have at most {most:,}")


def read_bytes(path: str | os.PathLike[str], most: int = TEXT_BYTES) -> bytes:
    """Read a regular file of at most so many bytes.

    Raises:
        UnreadableError: If it cannot be read, is no regular file, or is larger.
    """
    with open_regular(path, most) as file:
        try:
            parts, left = [], most + 1
            while left and (part := file.read(min(left, _PART))):  # it makes room for all that it may read
                parts.append(part)
                left -= len(part)
        except OSError as error:
            raise UnreadableError(f"{os.fspath(path)}: cannot be read: {error.strerror}") from error
    if not left:  # it has grown, or has no size
        raise _too_large(path, most + 1, most)
    return b"".join(parts)


def read_text(path: str | os.PathLike[str], most: int = TEXT_BYTES) -> str:
    """Read a regular text file in UTF-8 of at most so many bytes, with line feeds.

    Raises:
        UnreadableError: If it cannot be read, is no regular file, is larger, or is not in UTF-8.
    """
    try:
        text = read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableError(f"{os.fspath(path)}: must be a text file in UTF-8: {error}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | os.PathLike[str], most: int = TEXT_BYTES) -> Any:
    """Read a file of JSON, see `parse_json`."""
    return parse_json(read_bytes(path, most), os.fspath(path))


def parse_json(text: str | bytes, what: str) -> Any:
    """Parse JSON of at most `DEPTH` levels, whose integers a float can hold; NaN and infinity are numbers.

    Raises:
        UnreadableError: If it is not; the sentence begins with `what`.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise too_deep(what) from None
    except UnicodeDecodeError as error:
        raise UnreadableError(f"{what}: must be text in UTF-8: {error}") from error
    except json.JSONDecodeError as error:
        raise UnreadableError(f"{what}: not valid JSON: {error}") from error
    except ValueError:  # int() refuses thousands of digits
        raise UnreadableError(f"{what}: has an integer of thousands of digits, it should have few") from None
    check_tree(value, what)
    return value


def too_deep(what: str) -> UnreadableError:
    return UnreadableError(f"{what}: is nested deeper than {DEPTH} levels, it should not be")


def check_tree(value: Any, what: str) -> None:
    """Raise UnreadableError for JSON values nested too deep, or with integers that no float can hold."""
    waiting = [(value, 0)]
    while waiting:
        part, depth = waiting.pop()
        if isinstance(part, dict | list):
            if depth == DEPTH:
                raise too_deep(what)
            inner = part.values() if isinstance(part, dict) else part
            waiting += [(each, depth + 1) for each in inner if isinstance(each, dict | list | int)]
        elif isinstance(part, int) and part.bit_length() > _INTEGER_BITS:
            raise UnreadableError(
                f"{what}: has {shortened(part)}, integers should be below 2^{_INTEGER_BITS}"
            )


def read_mapping(path: str | os.PathLike[str], most: int = TEXT_BYTES) -> dict[str, Any]:
    """Read a file of JSON that holds a mapping, see `parse_json`."""
    value = read_json(path, most)
    if not isinstance(value, dict):
        raise UnreadableError(f"{os.fspath(path)}: is {shortened(value, 40)}, it should be a mapping")
    return value


def archive_members(path: str | os.PathLike[str]) -> set[str]:
    """List the arrays in an npz file; nothing for any other file."""
    try:
        with open_regular(path, ANY_SIZE) as file, open_archive(file, os.fspath(path)) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist()}
    except UnreadableError:
        return set()


def open_archive(file: IO[bytes], what: str) -> zipfile.ZipFile:
    """Open a zip archive whose directory is of a plausible size."""
    try:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - 2**16 - 64))  # the longest comment
        tail = file.read()
        place = tail.rfind(b"PK\5\6")
        directory = int.from_bytes(tail[place + 12 : place + 16], "little") if place >= 0 else 0
        if place < 0:
            raise UnreadableError(f"{what}: is no archive, or incomplete: it should be an npz or a zip file")
        # The mark of archives beyond 4 GB, whose directory has its size elsewhere.
        if directory > _MEMBERS or b"PK\6\7" in tail[max(0, place - 20) : place]:
            raise UnreadableError(f"{what}: lists too many members, it should have some dozens")
        file.seek(0)
        return zipfile.ZipFile(file)
    except UnreadableError:
        raise
    except Exception as error:  # damaged bytes make zipfile raise anything
        raise UnreadableError(f"{what}: is a damaged archive ({reason_of(error)})") from error


def reason_of(error: Exception) -> str:
    """What an error of a library says, on one line; some repeat the whole file."""
    return " ".join(str(error)[: 2 * LONGEST].split())[:LONGEST] or type(error).__name__


def read_member(path: str | os.PathLike[str], name: str, most: int = TEXT_BYTES) -> bytes:
    """Read a member of a zip archive of at most so many bytes, whatever it claims to unpack to.

    Raises:
        UnreadableError: If the archive is damaged, has no such member, or the member is larger.
    """
    what = f"{os.fspath(path)}: {shortened(name)}"
    with open_regular(path, ANY_SIZE) as file, open_archive(file, os.fspath(path)) as archive:
        try:
            with archive.open(name) as member:
                content = member.read(most + 1)
        except KeyError:
            raise UnreadableError(f"{what} is missing in the archive") from None
        except Exception as error:  # damaged bytes make zipfile raise anything
            raise UnreadableError(f"{what} is damaged ({reason_of(error)})") from error
    if len(content) > most:
        raise UnreadableError(f"{what} unpacks to more than {most:,} bytes, it should not")
    return content
