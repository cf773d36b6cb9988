"""What an installation takes on disk: the package with what it requires, and what each extra adds to it.

Counted are the files that the distributions list, without byte code, which installers write or leave out.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import dq_space_arm_env

NAME = "dq-space-arm"
BASE = ""
_SOURCES = ("agents", "configs/agents", "configs/scenes", "dq_space_arm_env", "experts")
# A requirement: name, extras in brackets, version, and after a semicolon when it holds.
_REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([^]]*)\])?[^;]*(?:;(.*))?")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


@dataclass(frozen=True)
class InstalledSize:
    """What the base installation takes, or what an extra adds to it.

    Attributes:
        extra: Name of the extra; empty for the base.
        distributions: Bytes of each distribution on disk.
        missing: Required distributions that are not installed, or do not list their files.
    """

    extra: str
    distributions: Mapping[str, int]
    missing: tuple[str, ...]

    @property
    def bytes(self) -> int:
        """Bytes of all of them."""
        return sum(self.distributions.values())


@dataclass(frozen=True)
class _Requirement:
    """A distribution that another one asks for.

    Attributes:
        name: Its name, normalized.
        extras: Extras of it that are asked for.
        only_for: Extras of the other one that ask for it; empty if it always does.
        conditional: Whether it is asked for on some platforms, or by some versions of Python, only.
    """

    name: str
    extras: frozenset[str]
    only_for: frozenset[str]
    conditional: bool


def measure_installation() -> list[InstalledSize]:
    """Add up what is installed.

    Returns:
        The base first, then each extra in alphabetical order; nothing if neither the installed package nor
        its sources say what it requires.
    """
    try:
        requirements = [_parsed(text) for text in _own_requirements()]
    except FileNotFoundError:
        return []
    base, missing = _closure(requirements, BASE)
    sizes = [InstalledSize(BASE, {NAME: _own_bytes(), **base}, missing)]
    for extra in sorted({name for requirement in requirements for name in requirement.only_for}):
        found, missing = _closure(requirements, extra)
        added = {name: size for name, size in found.items() if name not in base}
        sizes.append(InstalledSize(extra, added, missing))
    return sizes


def _own_requirements() -> Sequence[str]:
    """What this package requires, as installed or else as its sources say."""
    try:
        return metadata.requires(NAME) or []
    except metadata.PackageNotFoundError:
        project = tomllib.loads((_root() / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        return [
            *project["dependencies"],
            *(
                f"{text} {'and' if ';' in text else ';'} extra == '{extra}'"
                for extra, texts in project["optional-dependencies"].items()
                for text in texts
            ),
        ]


def _root() -> Path:
    return Path(dq_space_arm_env.__file__).parent.parent


def _own_bytes() -> int:
    """This package; its sources are counted, for an editable installation lists none of them."""
    folders = (_root() / name for name in _SOURCES)
    files = (path for folder in folders for path in folder.rglob("*"))
    return sum(path.stat().st_size for path in files if path.is_file() and path.parent.name != "__pycache__")


def _parsed(text: str) -> _Requirement:
    match = _REQUIREMENT.match(text.strip())
    assert match is not None, text
    name, extras, marker = match.groups(default="")
    return _Requirement(
        name=_normalized(name),
        extras=frozenset(filter(None, (extra.strip() for extra in extras.split(",")))),
        only_for=frozenset(_EXTRA.findall(marker)),
        conditional=bool(_EXTRA.sub("", marker).strip(" ()")),
    )


def _normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _closure(requirements: Sequence[_Requirement], extra: str) -> tuple[dict[str, int], tuple[str, ...]]:
    """Sizes of all distributions that an extra needs together with the base, and the missing ones."""
    sizes: dict[str, int] = {}
    missing: list[str] = []
    seen: set[tuple[str, str]] = set()
    waiting = list(_wanted(requirements, extra))
    while waiting:
        requirement, wanted_extra = waiting.pop()
        key = (requirement.name, wanted_extra)
        if key in seen:
            continue
        seen.add(key)
        if requirement.name == NAME:
            waiting += _wanted(requirements, wanted_extra)
            continue
        try:
            distribution = metadata.distribution(requirement.name)
        except metadata.PackageNotFoundError:
            if not requirement.conditional:  # otherwise it is not for this platform
                missing.append(requirement.name)
            continue
        size = _size(distribution)
        if size is None:
            missing.append(requirement.name)
        else:
            sizes[requirement.name] = size
        theirs = [_parsed(text) for text in distribution.requires or ()]
        waiting += _wanted(theirs, wanted_extra)
    return dict(sorted(sizes.items())), tuple(sorted(set(missing)))


def _wanted(requirements: Sequence[_Requirement], extra: str) -> Iterator[tuple[_Requirement, str]]:
    """Requirements of a distribution with an extra, each with each of its own extras, and without."""
    for requirement in requirements:
        if not requirement.only_for or extra in requirement.only_for:
            yield requirement, BASE
            for own in requirement.extras:
                yield requirement, own


def _size(distribution: metadata.Distribution) -> int | None:
    """Bytes of a distribution's files; None if it does not list them."""
    if distribution.files is None:
        return None
    paths = (Path(str(file.locate())) for file in distribution.files if file.suffix != ".pyc")
    return sum(path.stat().st_size for path in paths if path.is_file())
