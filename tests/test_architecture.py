"""The house stays readable: names are unique, walks are short and name files that exist."""

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("dq_space_arm_env", "experts", "agents")
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
WALKS = dict(re.findall(r"^## (From .+?)\n(.*?)(?=^## |\Z)", PAGE, flags=re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("package", PACKAGES)
def test_no_two_files_of_a_package_share_a_name(package):
    names = Counter(path.name for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_every_room_is_described(package):
    rooms = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    described = set(re.findall(r"`(\w+)`", PAGE))
    assert rooms <= described


@pytest.mark.parametrize("title", WALKS)
def test_walks_are_short_and_name_files(title):
    folder = ROOT / re.search(r"in `([\w/]+)/`", WALKS[title])[1]
    steps = re.findall(r"^\| \d+ \| (.+?) \|", WALKS[title], flags=re.MULTILINE)
    files = [name for step in steps for name in re.findall(r"`([\w/]+\.py)`", step)]
    assert 0 < len(files) <= 12
    assert [name for name in files if not (folder / name).is_file()] == []
