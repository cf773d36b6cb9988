"""The README is short, and its pictures, pages and first steps exist; `test_docs.py` runs its code."""

import doctest
import re
import shlex
import shutil
from importlib import import_module
from pathlib import Path

import pytest

from agents.zoo import list_policies
from agents.zoo.shelf import policy_file
from dq_space_arm_env.command_line import main
from scripts import reproduce_paper

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_is_short_and_its_pictures_and_pages_exist():
    assert len(README.split()) <= 1150
    assert README.count("```python") >= 4
    targets = re.findall(r"\]\(([^):]+)\)", README)
    assert any(target.startswith("docs/") for target in targets)
    for target in targets:
        path, _, heading = target.partition("#")
        assert (ROOT / path).exists(), target
        headings = re.findall(r"^#+ (.+)$", (ROOT / path).read_text("utf-8"), re.MULTILINE) if heading else []
        assert not heading or heading in [text.lower().replace(" ", "-") for text in headings]


@pytest.mark.parametrize("name", ["dq_space_arm", "goal"])
def test_examples_in_the_docstrings_of_environments_run(name):
    results = doctest.testmod(import_module(f"dq_space_arm_env.environment.{name}"))
    assert results.attempted >= 5
    assert results.failed == 0


def test_its_table_of_agents_says_what_the_cards_of_the_zoo_say():
    row = r"^\| `([\w-]+)` \| [^|]+ \| ([\d.]+) \[([\d.]+), ([\d.]+)\] \| ([\d.]+) \|"
    shown = {name: [float(each) for each in cells] for name, *cells in re.findall(row, README, re.MULTILINE)}
    for name in set(list_policies()) & shown.keys():
        card = policy_file(name).with_suffix(".md").read_text(encoding="utf-8")
        line = re.search(r"\| as in training \| ([\d.]+) \[([\d.]+), ([\d.]+)\] \| ([\d.]+) ", card)
        *success, gap = map(float, line.groups())
        assert shown[name] == [*success, round(gap, 2)], name
    assert len(set(list_policies()) & shown.keys()) == 5


@pytest.mark.slow
def test_the_first_ten_minutes_go_as_written(tmp_path, monkeypatch):
    """What a newcomer types after `make paper`, line by line, in a folder with nothing but the examples."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    tour = README.partition("## The first ten minutes")[2].partition("```bash\n")[2].partition("```")[0]
    lines = [shlex.split(line, comments=True) for line in tour.splitlines()]
    assert ["source", ".venv/bin/activate"] in lines
    commands = [words[1:] for words in lines if words[:1] == ["dq-space-arm"]]
    assert {command[0] for command in commands} >= {"replay", "simulate", "scenes", "solve"}
    assert reproduce_paper.main([]) == 0
    for command in commands:
        assert main(command) == 0, shlex.join(command)
    for words in commands:
        if words[0] == "replay":
            assert (tmp_path / words[words.index("--out") + 1]).stat().st_size < 2_000_000
    for name in ("results/both.html", "results/small-arm.html"):
        assert (tmp_path / name).is_file()
