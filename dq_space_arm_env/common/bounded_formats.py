"""Read arrays and XML that others wrote: npz and safetensors files, XML without entities.

Sizes that a file declares are checked before memory is spent on them; see `bounded_reading`.
"""

from __future__ import annotations

import math
import os
import sys
import zipfile
from collections.abc import Callable, Collection, Mapping
from typing import IO, Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.bounded_reading import (
    ANY_SIZE,
    DEPTH,
    UnreadableError,
    open_archive,
    open_regular,
    parse_json,
    reason_of,
    too_deep,
)
from dq_space_arm_env.common.shown_text import shortened

ARRAY_BYTES = 256 * 2**20
"""Default limit of the arrays of a file, 8 bytes per number: flights of a million steps."""
_HEADER_BYTES = 2**20  # of a safetensors file: some thousands of arrays
_TENSOR_TYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "U8": "u1"}
_CHUNK = 2**20  # bytes unpacked at a time
_MOST_AXES = 32


def read_arrays(
    path: str | os.PathLike[str], names: Collection[str] | None = None, most: int = ARRAY_BYTES
) -> dict[str, NDArray[Any]]:
    """Read arrays of numbers and text from an npz file, without unpickling anything.

    Args:
        path: The file.
        names: Names of the arrays to read, others are passed over; None for all.
        most: Limit of the memory of all that are read, 8 bytes or more per entry, in bytes.

    Returns:
        The arrays by name; those that the file lacks are missing.

    Raises:
        UnreadableError: If the file is damaged, an array holds objects, or they claim more memory.
    """
    where = os.fspath(path)
    found: dict[str, NDArray[Any]] = {}
    with open_regular(path, most) as file, open_archive(file, where) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if names is not None and name not in names:
                continue
            if name in found:
                raise UnreadableError(f"{where}: holds {shortened(name)} twice, it should once")
            found[name], size = _read_member(archive, member, f"{where}: {shortened(name)}", most)
            most -= size
    return found


def read_array(path: str | os.PathLike[str], most: int = ARRAY_BYTES) -> NDArray[Any]:
    """Read the array of an npy file, as `read_arrays` does those of an npz file."""
    with open_regular(path, most) as file:
        return _read_stream(file, os.fspath(path), most)[0]


def _read_member(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, what: str, most: int
) -> tuple[NDArray[Any], int]:
    try:
        with archive.open(member) as stream:
            return _read_stream(stream, what, most)
    except UnreadableError:
        raise
    except Exception as error:  # damaged bytes make zipfile and zlib raise anything
        raise UnreadableError(f"{what}: is damaged ({reason_of(error)})") from error


def _read_stream(stream: IO[bytes], what: str, most: int) -> tuple[NDArray[Any], int]:
    """Read an array, and count the bytes that it stands for."""
    try:
        shape, fortran, dtype = _npy_header(stream)
        count, kind = math.prod(shape), f"{dtype}"[:60]
        # Small numbers become double precision sooner or later; empty text takes no bytes at all.
        size = count * max(dtype.itemsize, 8)
        if size > most:
            raise UnreadableError(
                f"{what}: claims shape {shortened(shape)} of {kind}, {size:,} bytes; it should have at most "
                f"{most:,}"
            )
        if dtype.hasobject or (dtype.kind not in "biufU" and dtype.names is None):
            raise UnreadableError(f"{what}: holds {kind}, it should hold numbers or text")
        # Zeroed pages take no memory until the file really has content for them.
        content = np.zeros(count * dtype.itemsize, np.uint8)
        if _fill(content, stream) < len(content) or stream.read(1):
            raise UnreadableError(f"{what}: its size is not that of shape {shape} of {kind}")
        array = content.view(dtype) if dtype.itemsize else np.zeros(count, dtype)
        if dtype.kind == "U" and not _is_unicode(array):
            raise UnreadableError(f"{what}: holds text that is not Unicode")
        return array.reshape(shape, order="F" if fortran else "C"), size
    except UnreadableError:
        raise
    except Exception as error:  # damaged bytes make zipfile, zlib and NumPy raise anything
        raise UnreadableError(f"{what}: is damaged ({reason_of(error)})") from error


def _is_unicode(array: NDArray[Any]) -> bool:
    """Whether all characters are some; NumPy makes strings of any numbers, which crash what reads them."""
    codes = array.view(f"{array.dtype.str[0]}u4") if array.itemsize else np.zeros(0, "u4")
    return not ((codes > sys.maxunicode) | ((codes >= 0xD800) & (codes < 0xE000))).any()


def _fill(content: NDArray[np.uint8], stream: IO[bytes]) -> int:
    """Fill an array from a stream; count the bytes that it had."""
    done = 0
    while done < len(content):
        part = stream.read(min(_CHUNK, len(content) - done))
        if not part:
            break
        content[done : done + len(part)] = np.frombuffer(part, np.uint8)
        done += len(part)
    return done


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version} of the npy format, it should be 1.0 or 2.0")
    shape, fortran, dtype = readers[version](stream)
    if not all(isinstance(length, int) and length >= 0 for length in shape) or len(shape) > _MOST_AXES:
        raise ValueError(f"shape {shortened(shape)}")
    return shape, fortran, dtype


def map_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray[Any]], Mapping[str, Any]]:
    """Map a safetensors file, whose bytes must not change while it is in use.

    Args:
        path: The file.

    Returns:
        Read-only views of the arrays by name, and the metadata, text by text.

    Raises:
        UnreadableError: If the file is damaged; arrays may not overlap or leave gaps.
    """
    where = os.fspath(path)
    with open_regular(path, ANY_SIZE) as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, _HEADER_BYTES):
            raise UnreadableError(
                f"{where}: claims a header of {length:,} bytes, it should have at most {_HEADER_BYTES:,} and "
                f"be within the file's {size:,}"
            )
        header = parse_json(file.read(length), f"{where}: its header")
        # An empty file cannot be mapped; one with a header is not empty.
        content = np.memmap(file, mode="r").view(np.ndarray)[8 + length :]
    if not isinstance(header, dict):
        raise UnreadableError(f"{where}: its header is {shortened(header, 40)}, it should be a mapping")
    metadata = header.pop("__metadata__", {})
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise UnreadableError(f"{where}: its metadata are {shortened(metadata, 40)}, they should be texts")
    places = {name: _place(entry, f"{where}: {shortened(name, 60)}") for name, entry in header.items()}
    end = 0
    for name, (start, stop, _, _) in sorted(places.items(), key=lambda place: place[1][:2]):
        if start != end:
            raise UnreadableError(
                f"{where}: {shortened(name, 60)} begins at byte {start}, it should at {end}"
            )
        end = stop
    if end != len(content):
        raise UnreadableError(f"{where}: has {len(content):,} bytes of arrays, it should have {end:,}")
    arrays = {
        name: content[start:stop].view(dtype).reshape(shape)
        for name, (start, stop, dtype, shape) in places.items()
    }
    return arrays, metadata


def _place(entry: Any, what: str) -> tuple[int, int, str, tuple[int, ...]]:
    """Where an array lies in its file, and its type and shape."""
    wrong = UnreadableError(
        f"{what}: {shortened(entry, 80)}, it should have a dtype of {', '.join(_TENSOR_TYPES)}, a shape, and "
        "data_offsets of that size"
    )
    if not isinstance(entry, dict) or entry.get("dtype") not in list(_TENSOR_TYPES):
        raise wrong
    dtype, shape, offsets = _TENSOR_TYPES[entry["dtype"]], entry.get("shape"), entry.get("data_offsets")
    if not isinstance(shape, list) or not isinstance(offsets, list):
        raise wrong
    if len(offsets) != 2 or len(shape) > _MOST_AXES:
        raise wrong
    if not all(type(number) is int and 0 <= number < ANY_SIZE for number in (*shape, *offsets)):
        raise wrong
    start, stop = offsets
    if stop - start != math.prod(shape) * np.dtype(dtype).itemsize:
        raise wrong
    return start, stop, dtype, tuple(shape)


def parse_xml(
    content: str | bytes,
    what: str,
    check: Callable[[str, Mapping[str, str]], None] = lambda tag, attributes: None,
) -> Element:
    """Parse XML of at most `DEPTH` levels without a document type, and thus without entities of its own.

    Args:
        content: The text, or bytes whose encoding the parser detects.
        what: Beginning of the sentences of errors.
        check: Called with tag and attributes of each element; it may raise.

    Returns:
        The outermost element; namespaces are not resolved.

    Raises:
        UnreadableError: If it is not well-formed, nested too deep, or has a document type declaration.
    """
    builder, depth = TreeBuilder(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEPTH:
            raise too_deep(what)
        check(tag, attributes)
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*declaration: object) -> None:
        raise UnreadableError(f"{what}: remove the document type declaration (<!DOCTYPE ...>)")

    # Text is text already, whatever encoding it declares.
    parser = expat.ParserCreate("utf-8" if isinstance(content, str) else None)
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content.encode("utf-8") if isinstance(content, str) else content, True)
        return builder.close()
    except (expat.ExpatError, LookupError, ValueError, AssertionError) as error:
        if isinstance(error, ValueError) and type(error).__module__ != "builtins":
            raise  # ours, or that of `check`
        raise UnreadableError(f"{what}: not valid XML: {reason_of(error)}") from error
