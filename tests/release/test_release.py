"""What a release says of itself: one version, a valid citation, metadata and forms that are complete."""

import ast
import importlib
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import dq_space_arm_env
from agents.command_line.info import EXTRAS

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


def test_the_version_is_written_in_one_place_and_cited_rightly() -> None:
    assert "version" in PROJECT["project"]["dynamic"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "dq_space_arm_env/__init__.py"
    assert CITATION["version"] == dq_space_arm_env.__version__
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## (\S+)", changelog, flags=re.MULTILINE)
    assert newest is not None
    assert newest[1] == dq_space_arm_env.__version__


def test_the_citation_has_what_its_format_requires() -> None:
    assert CITATION["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= set(CITATION)
    assert CITATION["license"] == PROJECT["project"]["license"]
    assert CITATION["keywords"] == PROJECT["project"]["keywords"]
    for reference in CITATION["references"]:
        assert {"type", "title", "authors"} <= set(reference)
        assert all(isinstance(name, str) for author in reference["authors"] for name in author.values())


def test_every_package_ships_its_types() -> None:
    for package in PACKAGES:
        assert (ROOT / package / "py.typed").is_file(), package
    assert "Typing :: Typed" in PROJECT["project"]["classifiers"]


def test_classifiers_name_python_versions_that_are_allowed() -> None:
    oldest = PROJECT["project"]["requires-python"].removeprefix(">=")
    named = [
        text.rsplit(" ", 1)[1]
        for text in PROJECT["project"]["classifiers"]
        if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", text)
    ]
    assert named[0] == oldest
    assert named == sorted(named, key=lambda version: int(version.split(".")[1]))


def test_a_bug_report_tells_of_every_extra() -> None:
    assert sorted(EXTRAS) == sorted(PROJECT["project"]["optional-dependencies"])
    for extra, names in EXTRAS.items():
        required = " ".join(PROJECT["project"]["optional-dependencies"][extra])
        assert all(name in required or name == "torch" for name in names), extra


def test_the_top_level_holds_what_is_distributed_and_nothing_else() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0 or not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    found = {line.split("/")[0] for line in listed.stdout.splitlines()}
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    always = {".gitignore", "LICENSE", "README.md", "pyproject.toml"}
    assert found == always | {path.lstrip("/") for path in included}


def test_a_users_program_knows_every_public_name() -> None:
    program = ast.parse((Path(__file__).parent / "public_names.py").read_text(encoding="utf-8"))
    imported: dict[str | None, set[str]] = {}
    for statement in ast.walk(program):
        if isinstance(statement, ast.ImportFrom):
            names = {name.name for name in statement.names}
            imported[statement.module] = imported.get(statement.module, set()) | names
    for package in PACKAGES:
        assert imported[package] == set(importlib.import_module(package).__all__), package


def test_the_source_distribution_has_what_its_tests_need() -> None:
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert all((ROOT / path.lstrip("/")).exists() for path in included)
    for needed in ("tests", "configs", "scripts", "requirements.lock", "CITATION.cff", ".github", ".ci"):
        assert f"/{needed}" in included


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_issue_forms_are_complete(path: Path) -> None:
    form: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= set(form)
    identifiers = [entry["id"] for entry in form["body"]]
    assert len(set(identifiers)) == len(identifiers)
    assert all(entry["type"] == "textarea" and entry["attributes"]["label"] for entry in form["body"])
    assert any(entry.get("validations", {}).get("required") for entry in form["body"])


def test_a_bug_report_asks_for_what_it_needs() -> None:
    assert [path.stem for path in FORMS] == ["bug", "feature", "question"]
    assert "dq-space-arm info --json" in FORMS[0].read_text(encoding="utf-8")
