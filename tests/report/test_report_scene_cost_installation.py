"""What is installed: distributions made up, and those of this very environment."""

import sys
from pathlib import Path

import pytest

from experts.report.scene_cost import installation
from experts.report.scene_cost.installation import NAME, measure_installation


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
    base, all_, speed = measure_installation()
    assert (base.extra, base.distributions) == ("", {NAME: 7, "below": 20, "core-package": 100})
    assert base.bytes == 127
    assert (speed.extra, speed.distributions) == ("speed", {"quick": 3, "shared": 4})
    assert (all_.extra, all_.distributions) == ("all", {"quick": 3, "shared": 4, "tool": 5})
    assert [size.missing for size in (base, speed, all_)] == [(), (), ()]


def test_what_is_not_installed_is_named_unless_it_is_for_another_platform(folder: Path) -> None:
    install(folder, NAME, 0, "nowhere", "elsewhere; sys_platform == 'none'", "unlisted; extra == 'more'")
    install(folder, "unlisted", 5, listed=False)
    base, more = measure_installation()
    assert base.missing == ("nowhere",)
    assert set(more.missing) == {"nowhere", "unlisted"}
    assert more.bytes == 0


def test_without_installation_the_sources_say_what_is_required(folder: Path) -> None:
    install(folder, "numpy", 11)
    base, *extras = measure_installation()
    assert base.distributions == {NAME: 7, "numpy": 11}
    assert "gymnasium" in base.missing
    assert [size.extra for size in extras] == ["agents", "docs", "minari", "plots", "ray", "render", "test"]
    assert "stable-baselines3" in extras[0].missing


def test_own_bytes_are_those_of_the_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "_root", lambda: tmp_path)
    for place in (
        "agents/a.py",
        "configs/agents/b.yaml",
        "configs/scenes/c.yaml",
        "experts/__pycache__/d.nbc",
        "tests/e.py",
    ):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_bytes(bytes(5))
    assert installation._own_bytes() == 15


def test_nothing_is_known_without_installation_and_sources(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "_root", lambda: folder)
    assert measure_installation() == []


def test_this_environment_has_all_that_the_base_requires() -> None:
    base, *_ = measure_installation()
    assert base.missing == ()
    assert {"casadi", "gymnasium", "llvmlite", "numba", "numpy", "pydantic"} <= set(base.distributions)
    assert base.distributions[NAME] > 100_000
    assert all(size > 0 for size in base.distributions.values())
