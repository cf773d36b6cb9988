"""Names and keys of others: terminals obey none of them, other formats stay well-formed, pages show them."""

import io
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.table import Table
from rich.text import Text

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import (
    FAILURE,
    UNUSABLE,
    complain,
    message_console,
    print_document,
    say,
    table_console,
)
from dq_space_arm_env.common.results import Destination
from dq_space_arm_env.interoperability.mjcf_export import scene_to_mjcf
from dq_space_arm_env.interoperability.urdf_export import scene_to_urdf
from dq_space_arm_env.validation import parse_yaml
from experts.demonstrations import data_card

RED = "\x1b[31mred\x9b1m"
SHOWN = r"\x1b[31mred\x9b1m"
HOSTILE = "<img src=x onerror=alert(1)> [a](http://b) `c` | # & *d*"


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    file = tmp_path / "scene.yaml"
    text = 'name: box\nbase: {mass: 1, inertia: [1, 1, 1]}\ntarget: {pose: {}}\n"\\e[31mred\\x9b1m": 3\n'
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    "words", [["scenes", "validate"], ["scenes", "show"], ["scenes", "validate", "--json"]]
)
def test_keys_do_not_reach_the_terminal(
    words: list[str], scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, str(scene_file)]) in (FAILURE, UNUSABLE)
    captured = capsys.readouterr()
    said = captured.out + captured.err
    assert "\x1b" not in said
    assert "\x9b" not in said
    assert "x1b[31mred" in said


def test_consoles_escape_what_they_print(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table()
    table.add_column(Text(RED))
    table.add_row(Text(RED))
    for console in (table_console(), message_console()):
        console.print(table)
        console.print(RED, markup=False)
    complain(RED)
    captured = capsys.readouterr()
    for said in (captured.out, captured.err):
        assert "\x1b" not in said
        assert "\x9b" not in said
        assert SHOWN in said


def test_what_a_stream_cannot_encode_is_a_question_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, "ascii"))
    table_console().print(Text("3° off, größe"))
    say("5 µs")
    sys.stdout.flush()
    assert written.getvalue().decode().splitlines() == ["3? off, gr??e", "5 ?s"]


def test_documents_escape_what_json_does_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    print_document({"name": RED})
    said = capsys.readouterr().out
    assert "\x9b" not in said
    assert json.loads(said) == {"name": RED}
    print_document({"name": "größe"})
    assert "größe" in capsys.readouterr().out
    Destination(Path(), document=True).print({"name": RED})
    assert "\x9b" not in capsys.readouterr().out


@pytest.mark.parametrize(("columns", "width"), [("0", 110), ("wide", 110), ("", 110), ("47", 47)])
def test_tables_are_as_wide_as_they_are_told(
    columns: str, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert table_console().width == width


@pytest.mark.parametrize("name", [HOSTILE, "größe 😀", "a\"b'c"])
def test_other_formats_stay_well_formed(name: str) -> None:
    scene = load_scene("no-wrist")
    links = [link.model_dump() | {"name": f"{name} {i}"} for i, link in enumerate(scene.links)]
    renamed = scene.replace(name=name, links=links)
    assert ElementTree.fromstring(scene_to_urdf(renamed)).get("name") == name
    assert ElementTree.fromstring(scene_to_mjcf(renamed)).get("model") == name
    assert load_scene(parse_yaml(renamed.to_yaml())) == renamed


def facts(name: str) -> Any:
    """As much of a data set as the table of its contents shows."""
    demonstrations = SimpleNamespace(
        scene=load_scene("planar").replace(name=name),
        settings={"seed": 3, "versions": {"numpy<b>": "2<i>"}},
        manifest={"shards": [], "failures": {"<u>": 2}},
    )

    class Stub(SimpleNamespace):
        def __len__(self) -> int:
            return 4

    whole = Stub(**vars(demonstrations))
    return SimpleNamespace(demonstrations=whole, problems=6, failures={"index": [1, 2]})


def test_a_card_shows_names_as_they_are() -> None:
    hostile = facts(HOSTILE)
    card = "\n".join([*data_card._contents(hostile).markdown(), data_card._failures(hostile)])
    for markup in ("<img", "<b>", "<i>", "<u>", " [a]("):
        assert markup not in card
    assert "&lt;img src=x" in card
    assert parse_yaml(data_card._pretty_name(HOSTILE))["pretty_name"].endswith(HOSTILE)
    plain = "pretty_name: Optimal maneuvers of a spacecraft with an arm, scene paper"
    assert data_card._pretty_name("paper") == plain


def test_help_of_the_terminal_itself_is_left_alone() -> None:
    """Colors of a terminal are codes of rich, which stay."""
    console = table_console()
    console.file = io.StringIO()
    console._force_terminal, console._color_system = True, None
    console.print(Text("red", "red"))
    assert "red" in console.file.getvalue()


def test_pictures_of_others_stay_where_none_is_drawn(tmp_path: Path) -> None:
    place, drawn = Destination(tmp_path, picture=False), {"errors.png": lambda: b"new"}
    (tmp_path / "errors.png").write_bytes(b"mine")
    place.write("flight", {}, drawn)
    assert (tmp_path / "errors.png").read_bytes() == b"mine"
    place.write("flight", {}, drawn)  # now it is taken for that of the first
    assert not (tmp_path / "errors.png").exists()
