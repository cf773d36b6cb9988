"""Good files of every kind, mutations of them, and a process that judges what their readers do.

A seed determines a mutation. It changes bytes anywhere, or the content: trees of JSON, YAML and XML, and
arrays, whose archive then has correct checksums again.
"""

from __future__ import annotations

import copy
import io
import json
import math
import os
import random
import resource
import signal
import struct
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

Mutation = Callable[[bytes, random.Random], bytes]

SECONDS, BYTES = 2.0, 500 * 2**20
"""Most processor time and memory that reading may take."""
_ALARM = 120  # s of wall clock, on a machine that may be busy, after which a reader hangs
_PACKAGES = ("agents", "dq_space_arm_env", "experts")

_NUMBERS = (0, 3, -1, 2**31, 2**63, 10**30, 10**299, 10**400, 0.5, -0.0, 1e16, 1e200, -1e200, 5e-324)
_TEXTS = ("", "x", "0", "nan", "\x1b[31m", "\x00", "\u202e", "\udc80", "../../x", "/etc/passwd", "2001-99-99")
_LISTS = (
    [],
    [[]],
    [1, 2],
    [1.0] * 8,
    [[1.0] * 3] * 3,
    ["x"] * 300,
    {},
    {"": 0},
    {"name": "x"},
    {"k": {"k": {}}},
)
NASTY: tuple[Any, ...] = (None, True, math.nan, math.inf, -math.inf, "x" * 5000, *_NUMBERS, *_TEXTS, *_LISTS)
DEEP = 200
_YAML = (
    b"&a [*a]",
    b"&a ",
    b"*a",
    b"<<: ",
    b"!!int x",
    b"!!python/object:os.system ",
    b"!!binary ",
    b"2001-99-99",
)
_WORDS = (
    b"NaN",
    b"1e400",
    b"\\ud800",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>",
    b"&#0;",
    b"<a>" * 80,
    b"</a>",
    b"${x}",
)
_MANY = (b"9" * 400, b"0x" + b"f" * 400, b"- " * 40, b"[" * 40, b"{" * 40)
_CODES = (b"\x1b[31m", b"\x00", b"\xff", b"\xef\xbb\xbf", b"\r", b"\t", b"---\n", b"%YAML 1.1\n", b"|\n")
_SIGNS = tuple(bytes([sign]) for sign in b"-:?#'[]{},<>&\"\\")
_TOKENS = (*_YAML, *_WORDS, *_MANY, *_CODES, *_SIGNS)
_DTYPES = (
    "<f8",
    ">f8",
    "<f4",
    "<f2",
    "<i8",
    "|u1",
    "|b1",
    "<c16",
    "|O",
    "<U3",
    "|S3",
    "<M8[s]",
    "|V8",
    "<f16",
)
_SHAPES = (
    "()",
    "(0,)",
    "(1,)",
    "(3,)",
    "(-1,)",
    "(500000000000,)",
    "(2, 3)",
    "(0, 3)",
    "(1,)*40",
    "(10**9, 10**9)",
)


def nasty(rng: random.Random) -> Any:
    """One of these values, which the next mutation may change."""
    return copy.deepcopy(rng.choice(NASTY))


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Change some bits."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def with_insertion(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    added = rng.choice(_TOKENS) if rng.random() < 0.7 else rng.randbytes(rng.randint(1, 60))
    return data[:place] + added + data[place:]


def without_part(data: bytes, rng: random.Random) -> bytes:
    first = rng.randrange(len(data) + 1)
    return data[:first] + data[first + rng.randint(1, 40) :]


def with_duplicate(data: bytes, rng: random.Random) -> bytes:
    """Repeat a part, here or elsewhere."""
    first, place = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
    part = data[first : first + rng.randint(1, 400)] * rng.choice((1, 1, 1, 2, 20))
    return data[:place] + part + data[place:]


def with_swap(data: bytes, rng: random.Random) -> bytes:
    """Exchange two lines, or two words of them."""
    separator = rng.choice((b"\n", b" ", b","))
    parts = data.split(separator)
    first, second = rng.randrange(len(parts)), rng.randrange(len(parts))
    parts[first], parts[second] = parts[second], parts[first]
    return separator.join(parts)


RAW: tuple[Mutation, ...] = (flipped, cut, with_insertion, without_part, with_duplicate, with_swap)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Containers and keys of all values in a tree."""
    found, waiting = [], [tree]
    while waiting:
        here = waiting.pop()
        keys = list(here) if isinstance(here, dict) else range(len(here)) if isinstance(here, list) else ()
        for key in keys:
            found.append((here, key))
            waiting.append(here[key])
    return found


def mutated_tree(tree: Any, rng: random.Random) -> Any:
    """Replace, remove, rename, copy or nest values of a tree of dictionaries and lists."""
    tree = json.loads(json.dumps(tree))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = _places(tree)
        if not places:
            return nasty(rng)
        holder, key = rng.choice(places)
        kind = rng.randrange(7)
        if kind <= 2:
            holder[key] = nasty(rng)
        elif kind == 3:
            del holder[key]
        elif kind == 4:
            other, there = rng.choice(places)
            if there in other if isinstance(other, dict) else there < len(other):
                holder[key] = json.loads(json.dumps(other[there]))
        elif kind == 5 and isinstance(holder, dict):
            holder[rng.choice(("", "\x1b[31m", "x" * 300, str(key) + "s"))] = holder.pop(key)
        else:
            for _ in range(rng.choice((1, 5, DEEP))):
                holder[key] = [holder[key]]
    return tree if rng.random() < 0.97 else nasty(rng)


def in_json(data: bytes, rng: random.Random) -> bytes:
    tree = mutated_tree(json.loads(data), rng)
    return json.dumps(tree).encode()


def in_lines(data: bytes, rng: random.Random) -> bytes:
    """Change one line of JSON."""
    lines = data.splitlines()
    index = rng.randrange(len(lines))
    lines[index] = in_json(lines[index], rng)
    return b"\n".join(lines) + b"\n"


def in_yaml(data: bytes, rng: random.Random) -> bytes:
    from dq_space_arm_env.validation import parse_yaml

    text = json.dumps(mutated_tree(parse_yaml(data.decode()), rng))
    # The words of YAML for numbers that JSON lacks.
    for theirs, ours in (("NaN", ".nan"), ("-Infinity", "-.inf"), ("Infinity", ".inf")):
        text = text.replace(theirs, ours)
    return text.encode()


def in_xml(data: bytes, rng: random.Random) -> bytes:
    """Change attributes and elements."""
    root = ElementTree.fromstring(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        elements = list(root.iter())
        element = rng.choice(elements)
        kind = rng.randrange(5)
        if kind <= 1 and element.attrib:
            value = rng.choice(
                (*NASTY, "1e15 1 1", "0 0 0", "1 2 3", "-1", "fixed", "floating", "base", "hand")
            )
            element.set(rng.choice(list(element.attrib)), str(value)[:6000])
        elif kind == 2 and element.attrib:
            del element.attrib[rng.choice(list(element.attrib))]
        elif kind == 3 and len(element):
            element.remove(rng.choice(list(element)))
        else:
            element.append(rng.choice(elements[-20:]) if rng.random() < 0.8 else ElementTree.Element("mimic"))
            if any(child is element for child in element.iter() if child is not element):
                element.remove(element[-1])
    try:
        return ElementTree.tostring(root, encoding="unicode").encode("utf-8", "surrogatepass")
    except RecursionError:  # an element inside itself
        return data


def _npy(rng: random.Random) -> bytes:
    header = f"{{'descr': '{rng.choice(_DTYPES)}', 'fortran_order': False, 'shape': {rng.choice(_SHAPES)}, }}"
    text = header.ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(rng.choice((0, 8, 24, 48)))


def _mutated_array(content: bytes, rng: random.Random) -> bytes:
    """Change an array's numbers, type or shape, or the JSON in its text."""
    array = np.load(io.BytesIO(content))
    kind = rng.randrange(6)
    if array.dtype.kind == "U" and kind < 5:
        try:
            changed: Any = np.array(json.dumps(mutated_tree(json.loads(str(array)), rng)))
        except ValueError:
            changed = np.array(str(rng.choice(NASTY))[:6000].replace("\udc80", "?"))
    elif kind <= 1 and array.size and array.dtype.kind == "f":
        changed = array.copy()
        value = rng.choice([each for each in NASTY if isinstance(each, float)])
        with np.errstate(all="ignore"):
            changed.flat[rng.randrange(array.size)] = value
            if rng.random() < 0.3:
                changed[...] = value
    elif kind == 2 and array.ndim:
        changed = array[: rng.randrange(len(array) + 1)]
    elif kind == 3:
        changed = array[None] if rng.random() < 0.5 else array.ravel()
    elif kind == 4 and array.dtype.kind in "iufb":
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            changed = array.astype(rng.choice(("f4", "f2", "i8", "u1", "c16", "?", "U", ">f8")))
    else:
        return _npy(rng)
    stream = io.BytesIO()
    np.save(stream, changed, allow_pickle=False)
    return stream.getvalue()


def in_archive(data: bytes, rng: random.Random) -> bytes:
    """Change, remove, repeat or rename members; the archive is sound again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(rng.choice((1, 1, 2))):
        index, kind = rng.randrange(len(members)), rng.randrange(9)
        name, content = members[index]
        if kind <= 4 and content[:6] == b"\x93NUMPY":
            members[index] = name, _mutated_array(content, rng) if rng.random() < 0.8 else _npy(rng)
        elif kind == 4 and content[:1] in b"{[":
            members[index] = name, in_json(content, rng)
        elif kind <= 6:
            members[index] = name, rng.choice(RAW)(content, rng)
        elif kind == 7 and len(members) > 1:
            del members[index]
        else:
            members.append((rng.choice((name, "x.npy", "../x", "weight_7.npy")), content))
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # duplicate names
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def in_tensors(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a safetensors file, or its arrays."""
    begin = 8 + int.from_bytes(data[:8], "little")
    if rng.random() < 0.5:
        return data[:begin] + rng.choice(RAW)(data[begin:], rng)
    header = in_json(data[8:begin], rng) if rng.random() < 0.7 else rng.choice(RAW)(data[8:begin], rng)
    return len(header).to_bytes(8, "little") + header + data[begin:]


def in_hdf5(data: bytes, rng: random.Random) -> bytes:
    """Remove, replace or link elsewhere a member or an attribute of an HDF5 file."""
    import h5py

    stream, members = io.BytesIO(data), []
    with h5py.File(stream, "r+") as file:
        file.visititems(lambda name, item: members.append(item))
        item, kind = rng.choice(members), rng.randrange(5)
        name = item.name
        if item.attrs and rng.random() < 0.5:
            value = rng.choice(("x", np.nan, 2.0**80, -1, [1, 2, 3], h5py.Empty("f8")))
            item.attrs[rng.choice(sorted(item.attrs))] = value
            return _closed(file, stream)
        del file[name]
        if kind == 1:
            file[name] = rng.choice((h5py.SoftLink("/"), h5py.ExternalLink("/etc/passwd", "/")))
        elif kind == 2:
            shape = rng.choice(((), (0,), (3,), (4, 7), (2**40,), (2**20, 2**20)))
            file.create_dataset(name, shape, rng.choice(("f8", "f4", "i8", "c16", "S3")), chunks=shape != ())
        elif kind == 3 and isinstance(item, h5py.Dataset):
            file.create_dataset(name, item.shape, maxshape=(None,) * item.ndim, chunks=(2**10,) * item.ndim)
        elif kind == 4:
            file.create_group(name)
        return _closed(file, stream)


def _closed(file: Any, stream: io.BytesIO) -> bytes:
    file.close()
    return stream.getvalue()


class Subject(NamedTuple):
    """A kind of file, or a folder, and how it is read."""

    files: Mapping[str, bytes]  # good ones by their places in a folder; one of them is mutated
    read: Callable[[Path], Any]  # of the folder
    kinds: tuple[type[Exception], ...]  # errors that say in a sentence what is wrong
    mutations: Mapping[str, tuple[Mutation, ...]]  # besides those of bytes, by file
    repair: Callable[[Path], None] = lambda folder: None  # makes the rest fit what has changed
    use: Callable[[Any], None] = lambda accepted: None  # what must work with whatever is accepted


class Outcome(NamedTuple):
    """What became of the mutations."""

    tried: int
    accepted: int
    refused: int
    failures: list[str]
    slowest: float  # s
    memory: float  # MB


def mutated(subject: Subject, rng: random.Random) -> tuple[str, bytes]:
    """One of the files, changed once to three times."""
    name = rng.choice(sorted(subject.files))
    data, special = subject.files[name], subject.mutations.get(name, ())
    for turn in range(rng.choice((1, 1, 2, 3))):
        structured = special and turn == 0 and rng.random() < 0.6
        try:
            data = rng.choice(special if structured else RAW)(data, rng)
        except Exception:  # what has been mutated before may not be readable any more, even for us
            data = flipped(data, rng)
    return name, data


def judge(subject: Subject, seeds: list[int], folder: Path) -> Outcome:
    """Read mutations in a process of its own, whose memory is limited; a crash of it counts as well."""
    read_end, write_end = os.pipe()
    process = os.fork()
    if process == 0:
        status = 1
        try:
            os.close(read_end)
            with os.fdopen(write_end, "w") as answer:
                json.dump(_judge_here(subject, seeds, folder), answer)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(write_end)
    with os.fdopen(read_end) as answer:
        text = answer.read()
    _, status = os.waitpid(process, 0)
    if status or not text:
        last = (folder / "last").read_text() if (folder / "last").exists() else "?"
        return Outcome(len(seeds), 0, 0, [f"the process ended with status {status} at seed {last}"], 0.0, 0.0)
    return Outcome(*json.loads(text))


def _judge_here(subject: Subject, seeds: list[int], folder: Path) -> Outcome:
    before = _kilobytes("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (before * 1024 + BYTES, resource.RLIM_INFINITY))
    signal.signal(signal.SIGALRM, _raise_timeout)
    warnings.simplefilter("ignore")
    counts, failures, slowest = Counter[str](), [], 0.0
    good = folder / "files"
    for name, content in subject.files.items():
        (good / name).parent.mkdir(parents=True, exist_ok=True)
        (good / name).write_bytes(content)
    for seed in seeds:
        (folder / "last").write_text(str(seed))
        name, data = mutated(subject, random.Random(seed))
        (good / name).write_bytes(data)
        subject.repair(good)
        began = time.process_time()
        signal.alarm(_ALARM)
        try:
            subject.use(subject.read(good))
            counts["accepted"] += 1
        except subject.kinds as error:
            problem = _unclear(error)
            counts["refused"] += not problem
            if problem:
                failures.append(f"seed {seed}, {name}: {problem}")
        except BaseException as error:
            where = "".join(traceback.format_tb(error.__traceback__)[-2:])
            failures.append(f"seed {seed}, {name}: {type(error).__name__}: {str(error)[:300]}\n{where}")
        finally:
            signal.alarm(0)
        seconds = time.process_time() - began
        slowest = max(slowest, seconds)
        if seconds > SECONDS:
            failures.append(f"seed {seed}, {name}: took {seconds:.1f} s")
        for other, content in subject.files.items():
            if other == name or subject.repair is not Subject._field_defaults["repair"]:
                (good / other).parent.mkdir(parents=True, exist_ok=True)
                (good / other).write_bytes(content)
    memory = (_kilobytes("VmPeak") - before) / 1024
    return Outcome(len(seeds), counts["accepted"], counts["refused"], failures, slowest, memory)


def _kilobytes(name: str) -> int:
    """Look up an entry of this process's status.

    Address space, not resident memory: a fork's resident memory grows with the libraries that it uses again.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


def _raise_timeout(*signal_and_frame: object) -> None:
    raise TimeoutError(f"hangs for more than {_ALARM} s")


def _unclear(error: Exception) -> str:
    """Say what is wrong with an error: raised by another package, or no sentence."""
    frames = traceback.extract_tb(error.__traceback__)
    if type(error) is ValueError and not any(f"/{package}/" in frames[-1].filename for package in _PACKAGES):
        return f"a ValueError of {frames[-1].filename}: {str(error)[:200]}"
    text = str(error)
    if not text.strip() or len(text) > 20_000:
        return f"{type(error).__name__} of {len(text)} characters"
    return ""
