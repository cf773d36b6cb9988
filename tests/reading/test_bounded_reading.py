"""Files that claim more than they hold, nest deeper than a stack, or are no files: one sentence, at once."""

import io
import os
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env.common.bounded_formats import map_tensors, parse_xml, read_arrays
from dq_space_arm_env.common.bounded_reading import (
    DEPTH,
    UnreadableError,
    archive_members,
    parse_json,
    read_bytes,
    read_mapping,
    read_member,
    read_text,
)
from dq_space_arm_env.common.shown_text import markdown_text, printable, shortened


def refusal(attempt: Callable[[], Any]) -> str:
    with pytest.raises(UnreadableError) as caught:
        attempt()
    return str(caught.value)


READERS = (read_text, read_mapping, read_arrays, map_tensors, lambda path: read_member(path, "data"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
@pytest.mark.parametrize("read", READERS)
def test_only_regular_files_are_opened(read: Callable[[Path], Any], tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert refusal(lambda: read(pipe)) == f"{pipe} is a pipe, it should be a regular file"
    assert archive_members(pipe) == set()
    assert "is a folder" in refusal(lambda: read(tmp_path))
    assert "is a device" in refusal(lambda: read(Path("/dev/zero")))
    assert refusal(lambda: read(tmp_path / "none")) == f"{tmp_path / 'none'}: there is no such file"


def test_a_high_limit_costs_no_memory(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(b"abc")
    tracemalloc.start()
    try:
        assert read_bytes(tmp_path / "small", 2**30) == b"abc"
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_size_and_encoding_of_texts(tmp_path: Path) -> None:
    file = tmp_path / "text"
    file.write_bytes(b"one\r\ntwo\n")
    assert read_text(file) == "one\ntwo\n"
    assert "has 9 bytes, it should have at most 8" in refusal(lambda: read_text(file, 8))
    file.write_bytes(b"\xff")
    assert "must be a text file in UTF-8" in refusal(lambda: read_text(file))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000 + "]" * 100_000, f"nested deeper than {DEPTH} levels"),
        ("[" * (DEPTH + 1) + "]" * (DEPTH + 1), f"nested deeper than {DEPTH} levels"),
        ("9" * 5000, "thousands of digits"),
        ("[" + "9" * 400 + "]", "integers should be below"),
        ("{", "not valid JSON"),
        (b"\xff", "UTF-8"),
    ],
)
def test_json_that_would_break_its_readers(text: str | bytes, said: str) -> None:
    sentence = refusal(lambda: parse_json(text, "file"))
    assert sentence.startswith("file: ")
    assert said in sentence


def test_json_as_we_write_it() -> None:
    assert parse_json('{"a": [1e400, -3, "x", null]}', "file") == {"a": [float("inf"), -3, "x", None]}
    parse_json("[" * DEPTH + "]" * DEPTH, "file")


def npy(shape: str, descr: str = "<f8") -> bytes:
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00\x76\x00" + header.ljust(117).encode() + b"\n"


@pytest.mark.parametrize(
    ("member", "said"),
    [
        (npy("(500000000000,)"), "4,000,000,000,000 bytes; it should have at most"),
        (npy("(1000000000000000000,)", "<U0"), "claims shape"),
        (npy("(-3,)"), "is damaged"),
        (npy("(3,)"), "its size is not that of shape"),
        (npy("(1,)", "|O"), "holds object, it should hold numbers or text"),
        (npy("(1,)", "<c16") + bytes(16), "holds complex128"),
        (npy("()") + bytes(9), "its size is not that of shape"),
        (npy("()", "<U1") + b"\x00\x00\x00\x40", "holds text that is not Unicode"),
        (npy("(1,)", ">U2") + b"\x00\x00\x00a\x00\x00\xd8\x00", "holds text that is not Unicode"),
        (b"\x93NUMPY\x03\x00\xff\xff\xff\xff", "version (3, 0) of the npy format"),
        (b"nonsense", "is damaged"),
    ],
)
def test_arrays_are_checked_before_memory_is_spent(member: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "file.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("states.npy", member)
    sentence = refusal(lambda: read_arrays(file))
    assert sentence.startswith(f"{file}: 'states'")
    assert said in sentence
    assert read_arrays(file, names=("controls",)) == {}  # what nobody asks for is not read


def test_arrays_come_back(tmp_path: Path) -> None:
    file = tmp_path / "file.npz"
    arrays = {
        "rows": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "none": np.zeros((0, 3), dtype=np.float32),
        "text": np.array("größe"),
        "empty": np.array(""),
        "records": np.zeros(3, dtype=[("x", "<i8"), ("y", "?")]),
    }
    np.savez_compressed(file, **arrays)
    found = read_arrays(file)
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    assert archive_members(file) == set(arrays)
    assert "it should have at most 40" in refusal(lambda: read_arrays(file, ("rows",), most=40))


def test_damaged_archives(tmp_path: Path) -> None:
    file = tmp_path / "file.npz"
    np.savez_compressed(file, states=np.random.default_rng(0).normal(size=(50, 4)))
    content = file.read_bytes()
    for damaged in (b"", b"PK", content[:-40], content[:300] + b"\xff" * 20 + content[320:]):
        file.write_bytes(damaged)
        assert str(file) in refusal(lambda: read_arrays(file))
    many = io.BytesIO()
    with zipfile.ZipFile(many, "w") as archive:
        for number in range(20_000):
            archive.writestr(f"{number:020d}", b"")
    file.write_bytes(many.getvalue())
    assert "lists too many members" in refusal(lambda: read_arrays(file))


def test_members_that_unpack_to_more_than_they_may(tmp_path: Path) -> None:
    file = tmp_path / "model.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", bytes(10_000_000))
    assert "unpacks to more than 1,000 bytes" in refusal(lambda: read_member(file, "data", 1000))
    assert "is missing in the archive" in refusal(lambda: read_member(file, "policy"))


def header(entry: str) -> bytes:
    text = f'{{"a":{entry}}}'.encode()
    return len(text).to_bytes(8, "little") + text


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "claims a header"),
        (b"\xff" * 100, "claims a header"),
        (header('{"dtype":"F64","shape":[4],"data_offsets":[0,32]}') + bytes(24), "bytes of arrays"),
        (header('{"dtype":"F64","shape":[500000000000],"data_offsets":[0,24]}') + bytes(24), "of that size"),
        (header('{"dtype":"F64","shape":[-1],"data_offsets":[8,0]}') + bytes(24), "of that size"),
        (header('{"dtype":"F64","shape":[1],"data_offsets":[8,16]}') + bytes(16), "begins at byte 8"),
        (header('{"dtype":"O","shape":[1],"data_offsets":[0,8]}') + bytes(8), "a dtype of F64"),
        (header("[" * 100 + "]" * 100), "nested deeper"),
        (header("7"), "a dtype of F64"),
    ],
)
def test_headers_of_tensors_are_compared_with_the_file(content: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "file.safetensors"
    file.write_bytes(content)
    sentence = refusal(lambda: map_tensors(file))
    assert str(file) in sentence
    assert said in sentence


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<a>" * 100_000 + "</a>" * 100_000, f"nested deeper than {DEPTH}"),
        ('<!DOCTYPE a [<!ENTITY b "bbbb">]><a>&b;</a>', "remove the document type declaration"),
        ("<a>", "not valid XML"),
        ("<a>\ud800</a>", "not valid XML"),
        (b"<?xml version='1.0' encoding='nonsense'?><a/>", "not valid XML"),
        (b"<?xml version='1.0' encoding='shift_jis'?><a/>", "multi-byte encodings are not supported"),
    ],
)
def test_xml_that_expands(text: str | bytes, said: str) -> None:
    assert said in refusal(lambda: parse_xml(text, "URDF"))


def test_values_in_messages_are_cut_before_they_are_written() -> None:
    bomb: list[Any] = ["lol"] * 10
    for _ in range(60):
        bomb = [bomb] * 10
    for huge in (bomb, {"key": bomb}, "x" * 10**7, b"x" * 10**7, 10**10_000, -(2**100_000)):
        assert len(shortened(huge)) <= 123
    for small in (3, 2.5, "text", None, True, [1, 2.0], {"a": (1,), "b": {3}}, [[1.0, 0.0, 0.0]] * 3):
        assert shortened(small) == repr(small)


def test_control_characters_become_escapes() -> None:
    assert printable("größe 😀\n\t") == "größe 😀\n\t"
    assert printable("a\x1b[31m\x9b\x07\u202e\udc80\u2028\uffff") == (
        r"a\x1b[31m\x9b\x07\u202e\udc80\u2028\uffff"
    )


def test_markup_becomes_text() -> None:
    assert markdown_text("six-joint, 3 kg (1.5 m)") == "six-joint, 3 kg (1.5 m)"
    assert markdown_text("<img src=x>\n# [a](b)|`c`") == r"&lt;img src=x&gt; \# \[a\](b)\|\`c\`"
