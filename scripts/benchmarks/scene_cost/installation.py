"""Size of an installation on disk: the package with its requirements, and the additions of each extra.

The sizes are those of the files that the distributions list, without byte code. It needs `packaging`, of the
extra `test`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import dq_space_arm_env
from scripts.benchmarks.harness import Row

NAME = "dq-space-arm"
BASE = ""  # the extra of the base
_SOURCES = ("agents", "configs", "dq_space_arm_env", "experts")


def installation_rows() -> Iterator[Row]:
    """The base first, then the additions of each extra; nothing without metadata and sources."""
    try:
        requirements, extras = _own_requirements()
    except FileNotFoundError:
        return
    base, missing = _closure(requirements, BASE)
    yield _row("the package with what it requires", {NAME: _own_bytes(), **base}, missing)
    for extra in extras:
        found, missing = _closure(requirements, extra)
        added = {name: size for name, size in found.items() if name not in base}
        yield _row(f"[{extra}] adds", added, missing)


def _row(title: str, distributions: Mapping[str, int], missing: Sequence[str]) -> Row:
    largest = sorted(distributions.items(), key=lambda item: -item[1])[:4]
    known = bool(distributions) or not missing
    return {
        "table": "installation",
        "title": title,
        "packages": len(distributions) if known else None,
        "megabytes": sum(distributions.values()) / 1e6 if known else None,
        "largest": ", ".join(f"{name} {count / 1e6:.1f}" for name, count in largest),
        "missing": ", ".join(missing),
    }


def _own_requirements() -> tuple[list[Requirement], list[str]]:
    """Requirements and extras of this package, from its metadata if installed, else from its sources."""
    try:
        texts = metadata.requires(NAME) or []
        extras = {text.rpartition("extra ==")[2].strip(" '\"()") for text in texts if "extra ==" in text}
    except metadata.PackageNotFoundError:
        project = tomllib.loads((_root() / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        optional = project["optional-dependencies"]
        extras, texts = set(optional), list(project["dependencies"])
        for extra, own in optional.items():
            texts += [f"{text} {'and' if ';' in text else ';'} extra == '{extra}'" for text in own]
    return [Requirement(text) for text in texts], sorted(extras)


def _root() -> Path:
    return Path(dq_space_arm_env.__file__).parent.parent


def _own_bytes() -> int:
    """Size of the sources: an editable installation lists none of them."""
    folders = (_root() / name for name in _SOURCES)
    files = (path for folder in folders for path in folder.rglob("*"))
    return sum(path.stat().st_size for path in files if path.is_file() and path.parent.name != "__pycache__")


def _closure(requirements: Sequence[Requirement], extra: str) -> tuple[dict[str, int], tuple[str, ...]]:
    """Sizes of all distributions that an extra needs together with the base, and the missing ones."""
    sizes: dict[str, int] = {}
    missing: set[str] = set()
    seen: set[tuple[str, str]] = set()
    waiting = list(_wanted(requirements, extra))
    while waiting:
        name, wanted_extra = waiting.pop()
        if (name, wanted_extra) in seen:
            continue
        seen.add((name, wanted_extra))
        if name == NAME:
            waiting += _wanted(requirements, wanted_extra)
            continue
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            missing.add(name)
            continue
        if distribution.files is None:
            missing.add(name)
        else:
            paths = (Path(str(file.locate())) for file in distribution.files if file.suffix != ".pyc")
            sizes[name] = sum(path.stat().st_size for path in paths if path.is_file())
        theirs = [Requirement(text) for text in distribution.requires or ()]
        waiting += _wanted(theirs, wanted_extra)
    return dict(sorted(sizes.items())), tuple(sorted(missing))


def _wanted(requirements: Sequence[Requirement], extra: str) -> Iterator[tuple[str, str]]:
    """Names of what a distribution requires here with an extra, each without and with its own extras."""
    for requirement in requirements:
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            name = canonicalize_name(requirement.name)
            yield from ((name, own) for own in (BASE, *requirement.extras))
