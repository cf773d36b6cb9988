"""The renderer of rows: tables, pages as HTML, Markdown and JSON, and figures."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Figure, Page, Section
from dq_space_arm_env.common.tables import Column, Row, TextTable, tabulate
from experts.report.timing import three_digits

PNG = b"\x89PNG made up"
TABLE = TextTable("A <title>\nexplained", ("", "m | s", "two\nlines"), (("a & b", "1", "2"),), right=1)


def printed(table: TextTable, width: int) -> list[str]:
    console = Console(width=width)
    with console.capture() as found:
        console.print(table.for_terminal())
    return found.get().splitlines()


@pytest.mark.parametrize(("width", "parts"), [(40, 9), (60, 4), (80, 3), (100, 3), (200, 1)])
def test_wide_tables_stand_in_parts_below_each_other(width: int, parts: int) -> None:
    """No number is broken, each column is in one part, and each part has the first column."""
    names = [f"constraint violations {index}" for index in range(9)]
    numbers = [f"{10**index:,} [0.0, {index}.5]" for index in range(9)]
    table = TextTable("Flights", ("policy", *names), (("mine, an agent", *numbers),), right=1)
    lines = printed(table, width)
    assert max(map(len, lines)) <= width
    assert sum("Flights" in line for line in lines) == 1
    for number in numbers:
        assert sum(f" {number} " in f" {line} " for line in lines) == 1
    heads = sum(line.lstrip().startswith(("policy", "mine")) for line in lines)
    assert heads == 2 * parts


def test_text_wraps_at_words_and_leaves_a_table_whole() -> None:
    table = TextTable("Keys", ("key", "meaning"), (("mass", "mass of the base " * 12),))
    lines = printed(table, 40)
    assert max(map(len, lines)) <= 40
    assert " ".join(" ".join(lines).split()).count("mass of the base") >= 8
    assert sum("meaning" in line for line in lines) == 1


def section() -> Section:
    figure = Figure("made_up", "What <is> seen", PNG)
    return Section("part", "A part", "What it is", [TABLE], ["A note."], [figure], record={"measured": 1.5})


@pytest.fixture(scope="module")
def origin() -> dict[str, Any]:
    return provenance()


def page_of(sections: list[Section], origin: dict[str, Any]) -> Page:
    return Page(
        "A report", sections, origin, "All is as accurate as declared.", "Less accurate than declared"
    )


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
    page = page_of([section()], origin).html()
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.seen.count("table") == 2  # machine and versions, and ours
    found = re.search(r"data:image/png;base64,([^\"]+)", page)
    assert found is not None
    assert b64decode(found.group(1)) == PNG
    escaped = ["A &lt;title&gt;", "<td>a &amp; b</td>", "What &lt;is&gt; seen"]
    for text in (*escaped, "A note.", f"numpy {origin['versions']['numpy']}", "as accurate as declared"):
        assert text in page


def test_markdown_tables_have_a_cell_for_each_column(origin: dict[str, Any]) -> None:
    page = page_of([section()], origin).markdown()
    assert "|  | m \\| s | two lines |\n| --- | ---: | ---: |\n| a & b | 1 | 2 |\n" in page
    assert "![What &lt;is> seen](made_up.png)" in page


def test_what_is_inaccurate_is_at_the_top_of_both(origin: dict[str, Any]) -> None:
    bad = replace(section(), shortcomings=["Something is off."])
    made = page_of([bad], origin)
    for page, heading in ((made.html(), "<h2"), (made.markdown(), "\n## ")):
        assert "Something is off." in page.split(heading)[0]
        assert "as accurate as declared" not in page


def test_without_matplotlib_there_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dq_space_arm_env.common.report_page.find_spec", lambda name: None)
    part = Section("part", "A part", "What it is")
    part.add_figure("made_up", "What is seen", lambda: PNG)
    assert part.figures == []
    assert "dq-space-arm[plots]" in part.notes[0]


ROWS = [
    {"method": "rk4", "motion": "spin", "time_us": 12, "error": 1e-9, "fits": True},
    {"method": "rk4", "motion": "spin", "time_us": 2400, "error": float("nan"), "fits": False},
    {"method": "euler", "motion": "stiff", "time_us": 3, "error": 0.02, "fits": None},
]


def test_rows_become_a_table() -> None:
    columns = ["method", Column("error", "error\nm", ".0e", "lost"), Column("time_us", format=str), "fits"]
    table = tabulate("Errors", ROWS, columns)
    assert table.rows[0] == ("rk4", "1e-09", "12", "yes")
    assert table.rows[1] == ("rk4", "lost", "2400", "no")
    assert table.rows[2] == ("euler", "2e-02", "3", "-")
    assert tabulate("All", ROWS).headings == ("method", "motion", "time us", "error", "fits")


@pytest.mark.parametrize(
    ("time", "text"), [(0.123456, "0.123"), (7.0, "7.00"), (152.7, "153"), (2111.5, "2,112")]
)
def test_times_have_three_digits_or_all_before_the_point(time: float, text: str) -> None:
    assert three_digits(time) == text


def test_a_page_is_saved_with_its_rows_as_json(tmp_path: Path, origin: dict[str, Any]) -> None:
    part = section()
    part.add_rows("errors", ROWS, ["method", "error"])
    assert page_of([part], origin).save(tmp_path)[:3] == ["report.html", "report.md", "report.json"]
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["parts"]["part"]["errors"][1]["error"] is None
    assert record["parts"]["part"]["measured"] == 1.5
    assert record["versions"] == origin["versions"]
    assert (tmp_path / "made_up.png").read_bytes() == PNG


def test_numbers_make_curves_and_text_makes_bars() -> None:
    pytest.importorskip("matplotlib")
    from experts.figures.plots import Plot

    plot = Plot("time_us", "error", color="method", facet="motion", log="xy", levels=(1e-6,), floor=1e-4)
    spin, stiff = plot.figure(ROWS).axes
    curves = {line.get_label(): line.get_xydata().tolist() for line in spin.lines}
    assert curves["rk4"] == [[12.0, 1e-4]]  # NaN is left out, small errors are drawn on the floor
    assert curves["euler"] == []
    assert [line.get_ydata()[0] for line in stiff.lines if line.get_linestyle() == "--"] == [1e-6]
    assert [axes.get_title(loc="left") for axes in (spin, stiff)] == ["spin", "stiff"]
    assert plot.png(ROWS).startswith(b"\x89PNG")
    assert len(plot.figure([]).axes) == 1  # where nothing is known there is nothing in it
    (axes,) = Plot("time_us", "method", color="motion", log="x").figure(ROWS).axes
    assert [bar.get_width() for bar in axes.patches] == [12, 2400, 3]


def test_bars_stand_beside_their_names_in_every_panel() -> None:
    pytest.importorskip("matplotlib")
    from experts.figures.plots import Plot

    lengths = {"step": {"a": 1.0, "b": 2.0, "c": 3.0}, "rate": {"c": 4.0}}
    rows: list[Row] = [
        {"quantity": quantity, "method": name, "largest": length}
        for quantity, found in lengths.items()
        for name, length in found.items()
    ]
    panels = Plot("largest", "method", facet="quantity").figure(rows).axes
    names = [label.get_text() for label in panels[0].get_yticklabels()]  # of both
    assert names == ["a", "b", "c"]
    for axes in panels:
        bars = {names[round(bar.get_y() + bar.get_height() / 2)]: bar.get_width() for bar in axes.patches}
        assert bars == lengths[axes.get_title(loc="left")]


@pytest.mark.parametrize("height", ["error", "method"])
def test_names_are_no_mathematics_and_none_is_left_out(height: str) -> None:
    pytest.importorskip("matplotlib")
    from experts.figures.plots import Plot

    names = ["gripper $5_a_b$", "a $x_{ b", "_mine"]
    rows: list[Row] = [{"time_us": 1.0, "error": 1.0, "name": name, "method": f"{name}s"} for name in names]
    plot = Plot("time_us", height, color="name", facet="name")
    assert plot.png(rows).startswith(b"\x89PNG")
    (legend,) = plot.figure(rows).legends
    shown = [text.get_text().strip().replace(r"\$", "$") for text in legend.get_texts()]
    assert shown == names


def test_names_from_files_make_no_markup(origin: dict[str, Any]):
    page = Page("<img src=x>", [Section("a", "", "", shortcomings=["<img> is missing."])], origin)
    assert page.markdown().startswith("# &lt;img src=x>\n")
    assert "<img" not in page.markdown()
    lines = "\n".join(TextTable("t", ("name",), (("<img src=x> [a](javascript:b)",),)).markdown())
    assert "&lt;img src=x> [a]\\(javascript:b)" in lines
