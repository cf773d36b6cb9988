"""The report on one page: what HTML and Markdown hold, and how the script ends."""

import json
import re
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from agents.command_line import main
from experts.report.command import INACCURATE, INTERRUPTED, SUCCESS
from experts.report.page import command
from experts.report.page.parts import AGREEMENT, PARTS, Announce, disagreements
from experts.report.page.rendering import html_page, markdown_page
from experts.report.page.sections import Figure, Section, printed
from experts.report.provenance import provenance
from experts.report.tables import TextTable
from experts.report.throughput.agreement import ACCELERATIONS, ANGLES, Agreement
from experts.report.throughput.kernels import VECTOR
from experts.report.throughput.timing import OURS

PNG = b"\x89PNG made up"
TABLE = TextTable("A <title>\nexplained", ("", "m | s", "two\nlines"), (("a & b", "1", "2"),), right=1)


def section() -> Section:
    figure = Figure("made_up", "What <is> seen", PNG)
    return Section(
        "part",
        "A part",
        "What it is",
        [TABLE],
        "drawn < text",
        ["A note."],
        [figure],
        record={"measured": 1.5},
    )


@pytest.fixture(scope="module")
def origin() -> dict[str, Any]:
    return provenance()


def run(arguments: Sequence[str]) -> int:
    return main(["report", *arguments])


class Tags(HTMLParser):
    """Collects tags, checks that they are closed in order, and refuses links to other files."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href"):
                assert value is not None
                assert value.startswith(("data:", "#"))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_html_is_well_formed_and_needs_no_other_file(origin: dict[str, Any]) -> None:
    page = html_page([section()], origin)
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.seen.count("table") == 2  # machine and versions, and ours
    found = re.search(r"data:image/png;base64,([^\"]+)", page)
    assert found is not None
    assert b64decode(found.group(1)) == PNG
    for text in (
        "A &lt;title&gt;",
        "a &amp; b",
        "drawn &lt; text",
        "What &lt;is&gt; seen",
        "A note.",
        "<br>explained",
    ):
        assert text in page
    assert '<td class="right">1</td>' in page
    assert "<td>a &amp; b</td>" in page
    for value in (origin["machine"]["processor_name"], f"numpy {origin['versions']['numpy']}"):
        assert value in page
    assert "as accurate as declared" in page


def test_numbers_are_not_broken_at_their_hyphen(origin: dict[str, Any]) -> None:
    table = TextTable("A title", ("case", "error"), (("masses 1e-6 to 1e6 apart", "2.5e-16"),), right=1)
    page = html_page([replace(section(), tables=[table])], origin)
    assert '<td>masses <span class="number">1e-6</span> to 1e6 apart</td>' in page
    assert '<td class="right"><span class="number">2.5e-16</span></td>' in page


def test_html_fits_a_narrow_screen(origin: dict[str, Any]) -> None:
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in html_page([], origin)


def test_markdown_tables_have_a_cell_for_each_column(origin: dict[str, Any]) -> None:
    page = markdown_page([section()], origin)
    lines = page.splitlines()
    assert "**A <title>**: explained" in lines
    start = lines.index("|  | m \\| s | two lines |")
    assert lines[start : start + 3] == [
        "|  | m \\| s | two lines |",
        "| --- | ---: | ---: |",
        "| a & b | 1 | 2 |",
    ]
    assert "![What <is> seen](made_up.png)" in lines
    assert "```text\ndrawn < text\n```" in page


def test_what_is_inaccurate_is_at_the_top_of_both(origin: dict[str, Any]) -> None:
    bad = replace(section(), shortcomings=["Something is off."])
    for page, heading in ((html_page([bad], origin), "<h2"), (markdown_page([bad], origin), "\n## ")):
        assert "Something is off." in page.split(heading)[0]
        assert "as accurate as declared" not in page


def test_printed_text_has_no_colors_and_no_trailing_blanks() -> None:
    text = printed(lambda console: console.print(TABLE.for_terminal(), style="red"))
    assert "\x1b" not in text
    assert text.startswith("A <title>")
    assert all(line == line.rstrip() for line in text.splitlines())


def test_without_matplotlib_there_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experts.report.page.sections.find_spec", lambda name: None)
    part = Section("part", "A part", "What it is")
    part.draw("made_up", "What is seen", lambda: PNG)
    assert part.figures == []
    assert "dq-space-arm[plots]" in part.notes[0]


def test_other_engines_must_agree_with_ours_in_double_precision() -> None:
    good = Agreement(ACCELERATIONS, OURS, "Pinocchio", "", 1e-13, "1")
    bad = replace(good, error=2.0 * AGREEMENT)
    single = replace(bad, engine=f"{OURS}, float32")
    coarse = replace(bad, quantity=ANGLES, integrator="symplectic_euler")
    vector = replace(bad, engine=VECTOR, error=float("nan"))
    assert disagreements([good, single, coarse]) == []
    assert len(disagreements([bad, vector])) == 2


def test_script_writes_both_pages_and_fails_on_what_is_inaccurate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def part(*, quick: bool, announce: Announce) -> Section:
        announce("something")
        asked.append(quick)
        return section()

    monkeypatch.setattr(command, "PARTS", {"part": part})
    out = tmp_path / "deep" / "out"
    assert run(["--quick", "--out", str(out)]) == SUCCESS
    assert sorted(file.name for file in out.iterdir()) == [
        "made_up.png",
        "part.json",
        "report.html",
        "report.md",
    ]
    assert (out / "made_up.png").read_bytes() == PNG
    bad = replace(section(), shortcomings=["Something is off."])
    monkeypatch.setattr(command, "PARTS", {"part": lambda quick, announce: bad})
    assert run(["--out", str(out)]) == INACCURATE
    assert "Something is off." in capsys.readouterr().err
    assert asked == [True]


def test_an_interrupt_keeps_the_parts_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*, quick: bool, announce: Announce) -> Section:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "PARTS", {"part": lambda quick, announce: section(), "next": interrupted})
    assert run(["--out", str(tmp_path)]) == INTERRUPTED
    assert "What &lt;is&gt; seen" in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "part.json").read_text())["measured"] == 1.5


def test_every_part_is_an_option(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(command, "run", lambda destination, *, parts, quick: asked.append(parts))
    for name in PARTS:
        assert run(["--part", name]) == SUCCESS
    assert asked == [(name,) for name in PARTS]


@pytest.mark.slow
def test_the_throughput_part_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    part = PARTS["throughput"](quick=True, announce=print)
    assert "forward dynamics" in part.printed
    assert part.shortcomings == []
    assert part.figures[0].png.startswith(b"\x89PNG")
