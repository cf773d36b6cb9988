"""What a release says of itself: one version, a valid citation, complete metadata."""

import ast
import importlib
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import dq_space_arm_env

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CITATION = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
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


def test_every_locked_version_has_hashes() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8").replace("\\\n", " ")
    hashes = {line.split("==")[0]: line.count("--hash=sha256:") for line in lock.splitlines()}
    assert min(hashes.values()) >= 1
    extras = PROJECT["project"]["optional-dependencies"].values()
    required = [*PROJECT["project"]["dependencies"], *(each for extra in extras for each in extra)]
    named = {re.split(r"[^\w.-]", each)[0].lower().replace(".", "-") for each in required}
    assert named - {"dq-space-arm"} | {"editables", "hatchling", "uv"} <= hashes.keys()


def test_the_oldest_python_is_the_first_classifier() -> None:
    pattern = r"Programming Language :: Python :: (3\.\d+)"
    named = re.findall(pattern, "\n".join(PROJECT["project"]["classifiers"]))
    assert named[0] == PROJECT["project"]["requires-python"].removeprefix(">=")
    assert all((ROOT / package / "py.typed").is_file() for package in PACKAGES)


def test_make_begins_again_after_half_an_environment(tmp_path: Path) -> None:
    """As `python3 -m venv` leaves it on a machine without ensurepip; in a folder with a space."""
    make, folder = shutil.which("make"), tmp_path / "a folder"
    if make is None:
        pytest.skip("no make")
    folder.mkdir()
    for name in ("Makefile", "pyproject.toml", "requirements.lock"):
        shutil.copy(ROOT / name, folder)
    half = (
        "#!/bin/sh\n[ $1 = -c ] && exit 0\necho $* >> made\nmkdir -p .venv/bin\n"
        "printf '#!/bin/sh\\nexit 1\\n' > .venv/bin/python\nchmod +x .venv/bin/python\nexit 1\n"
    )
    python = folder / "python"
    python.write_text(half, encoding="utf-8")
    python.chmod(0o755)
    for _ in range(2):
        done = subprocess.run([make, "paper", "PYTHON=./python"], cwd=folder, capture_output=True, text=True)
        assert done.returncode != 0
    assert (folder / "made").read_text(encoding="utf-8") == "-m venv .venv\n-m venv .venv\n"


def test_make_refuses_older_pythons_than_the_package_does() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (oldest,) = re.findall(r"sys\.version_info < \((\d+), (\d+)\)", makefile)
    assert PROJECT["project"]["requires-python"] == f">={'.'.join(oldest)}"


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
