"""Built, installed into an empty environment outside the repository, and used there.

Needs the package index, as the installation of the tests themselves does.
"""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

import dq_space_arm_env
from agents.configuration import list_configurations
from agents.zoo import list_policies
from dq_space_arm_env import list_scenes

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
VERSION = dq_space_arm_env.__version__
NOT_SOURCE = (".git", ".venv", "__pycache__", "*_cache", "results", "dist", "build", "*.egg-info")


def run(*command: str | Path, cwd: Path, environment: Mapping[str, str] | None = None) -> str:
    """Run a command that must succeed; what it printed."""
    ended = subprocess.run(list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, f"{command}: {ended.stdout[-2000:]}\n{ended.stderr[-4000:]}"
    return ended.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an empty environment."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", folder, cwd=folder)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def distributions(python: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the source distribution, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("distributions")
    shutil.copytree(ROOT, folder / "source", ignore=shutil.ignore_patterns(*NOT_SOURCE))
    builder = folder / "builder"
    run(sys.executable, "-m", "venv", builder, cwd=folder)
    run(builder / "bin" / "python", "-m", "pip", "install", "--retries", "10", "build", cwd=folder)
    run(builder / "bin" / "python", "-m", "build", "--outdir", folder, folder / "source", cwd=folder)
    return folder


@pytest.fixture(scope="module")
def installed(python: Path, distributions: Path) -> Path:
    """The same Python, with the wheel and what it requires."""
    wheel = distributions / f"dq_space_arm-{VERSION}-py3-none-any.whl"
    # pip alone decides which versions a user gets; those of the lock are what all other tests run with.
    run(python, "-m", "pip", "install", "--retries", "10", "--only-binary", ":all:", wheel, cwd=distributions)
    return python


def test_distributions_have_their_files(distributions: Path) -> None:
    with zipfile.ZipFile(distributions / f"dq_space_arm-{VERSION}-py3-none-any.whl") as wheel:
        names = wheel.namelist()
    information = f"dq_space_arm-{VERSION}.dist-info/"
    assert f"{information}licenses/LICENSE" in names
    # Everything that the packages have, and nothing else: no tests, results or pictures.
    expected = {
        **{package: package for package in ("agents", "dq_space_arm_env", "experts")},
        "configs/agents": "agents/configs",
        "configs/suites": "agents/suites",
        "configs/scenes": "dq_space_arm_env/configs/scenes",
    }
    files = {
        str(Path(there) / path.relative_to(ROOT / here))
        for here, there in expected.items()
        for path in (ROOT / here).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__"
    }
    assert {name for name in names if not name.startswith(information)} == files
    with tarfile.open(distributions / f"dq_space_arm-{VERSION}.tar.gz") as archive:
        paths = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    needed = ["README.md", "LICENSE", "CITATION.cff", "requirements.lock", ".github/pictures/maneuver.png"]
    assert set(map(Path, [*needed, "configs/scenes/paper.yaml"])) <= paths
    assert {path for path in paths if path.match("tests/**/test_*.py")}


def test_first_use(installed: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "DQ_SPACE_ARM_CACHE": str(tmp_path / "cache")}
    environment.pop("PYTHONPATH", None)
    found = json.loads(run(installed, "-I", HERE / "first_use.py", cwd=tmp_path, environment=environment))
    assert found["version"] == VERSION
    assert found["scenes"] == list_scenes()
    assert found["configurations"] == list_configurations()
    assert found["policies"] == list_policies()
    program = installed.with_name("dq-space-arm")
    assert run(program, "--version", cwd=tmp_path, environment=environment).split()[-1] == VERSION
    information = json.loads(run(program, "info", "--json", cwd=tmp_path, environment=environment))
    assert information["dq-space-arm"]["scenes"] == len(list_scenes())
    page = (tmp_path / "replay.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the oldest versions have no wheels for it")
def test_first_use_with_the_oldest_requirements(
    distributions: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    uv, folder = shutil.which("uv", path=Path(sys.executable).parent), tmp_path_factory.mktemp("oldest")
    if uv is None:
        pytest.skip("uv, which `make` installs, resolves to the oldest versions")
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    install = (uv, "pip", "install", "--python", folder / "bin" / "python", "--only-binary", ":all:")
    wheel = distributions / f"dq_space_arm-{VERSION}-py3-none-any.whl"
    requirements = distributions / "source" / "pyproject.toml"
    run(*install, "--resolution", "lowest-direct", "--requirement", requirements, cwd=folder)
    run(*install, "--no-deps", wheel, cwd=folder)
    environment = {**os.environ, "DQ_SPACE_ARM_CACHE": str(tmp_path / "cache")}
    environment.pop("PYTHONPATH", None)
    python = folder / "bin" / "python"
    found = json.loads(run(python, "-I", HERE / "first_use.py", cwd=tmp_path, environment=environment))
    assert found["version"] == VERSION


def test_a_users_program_passes_strict_type_checks(installed: Path, tmp_path: Path) -> None:
    command = ("-m", "mypy", "--strict", "--python-executable", installed, "--cache-dir", tmp_path / "mypy")
    program = shutil.copy(HERE / "public_names.py", tmp_path)
    assert "no issues found" in run(sys.executable, *command, program, cwd=tmp_path)
