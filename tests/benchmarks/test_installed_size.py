"""What is installed: distributions made up, and those of this very environment."""

import sys
from pathlib import Path

import pytest

from scripts.benchmarks.scene_cost import installation
from scripts.benchmarks.scene_cost.installation import NAME, installation_rows


def install(folder: Path, name: str, size: int, *requirements: str, listed: bool = True) -> None:
    """A distribution of one file, and of byte code that does not count."""
    information = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    information.mkdir(parents=True)
    lines = ["Metadata-Version: 2.1", f"Name: {name}", "Version: 1.0"]
    lines += [f"Requires-Dist: {requirement}" for requirement in requirements]
    (information / "METADATA").write_text("\n".join(lines) + "\n")
    if listed:
        for suffix in ("py", "pyc"):
            (folder / f"{name}.{suffix}").write_bytes(bytes(size))
        (information / "RECORD").write_text(f"{name}.py,,\n{name}.pyc,,\n")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where made-up distributions are found; only they are."""
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.setattr(installation, "_own_bytes", lambda: 7)
    return tmp_path


def test_extras_add_what_the_base_does_not_have(folder: Path) -> None:
    install(
        folder,
        NAME,
        0,
        "Core_Package>=1",
        "core-package[fast]; extra == 'speed'",
        'shared; extra == "speed"',
        f"{NAME}[speed]; extra == 'all'",
        "tool (>=2); python_version >= '3' and extra == 'all'",
    )
    install(folder, "core-package", 100, "below", "quick; extra == 'fast'", "never; extra == 'docs'")
    install(folder, "below", 20, "core.package")  # a circle ends
    install(folder, "quick", 3)
    install(folder, "shared", 4, "below")
    install(folder, "tool", 5)
    rows = list(installation_rows())
    assert [row["title"] for row in rows[1:]] == ["[all] adds", "[speed] adds"]
    assert [row["packages"] for row in rows] == [3, 3, 2]
    assert [1e6 * row["megabytes"] for row in rows] == pytest.approx([127, 12, 7])
    assert rows[0]["largest"].startswith("core-package 0.0, below 0.0, dq-space-arm")
    assert [row["missing"] for row in rows] == ["", "", ""]


def test_what_is_not_installed_is_named_unless_it_is_for_another_platform(folder: Path) -> None:
    install(folder, NAME, 0, "nowhere", "elsewhere; sys_platform == 'none'", "unlisted; extra == 'more'")
    install(folder, "unlisted", 5, listed=False)
    base, more = list(installation_rows())
    assert base["missing"] == "nowhere"
    assert more["missing"] == "nowhere, unlisted"
    assert more["megabytes"] is None


def test_without_installation_the_sources_say_what_is_required(folder: Path) -> None:
    install(folder, "numpy", 11)
    base, *extras = list(installation_rows())
    assert 1e6 * base["megabytes"] == pytest.approx(18)
    assert "gymnasium" in base["missing"]
    assert "stable-baselines3" in extras[0]["missing"]


@pytest.mark.slow
def test_this_environment_has_all_that_the_base_requires() -> None:
    base, *_ = list(installation_rows())
    assert base["missing"] == ""
    assert base["packages"] > 10
    assert "casadi" in base["largest"]
    assert base["megabytes"] > 100
