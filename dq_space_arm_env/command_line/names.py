"""Names that the shell completes and lists show, read from file names without importing what uses them."""

import re
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_text
from dq_space_arm_env.common.suggestions import did_you_mean


def package_folder(package: str) -> Path:
    """Find the folder of a package without importing it."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"the package {package} is missing: install dq-space-arm again")
    return Path(next(iter(spec.submodule_search_locations)))


def shipped_files(package: str, installed: str, checkout: str) -> dict[str, Path]:
    """List a package's YAML files by name; `installed` lies in the package, `checkout` beside it."""
    home = package_folder(package)
    folder = home / installed if (home / installed).is_dir() else home.parent / checkout
    return {path.stem: path for path in sorted(folder.glob("*.yaml"), key=lambda path: path.stem)}


def scene_files() -> dict[str, Path]:
    """List the scenes that ship with the package, paths by name."""
    return shipped_files("dq_space_arm_env", "configs/scenes", "configs/scenes")


def description_of(file: Path) -> str:
    """Read the one-line description in a YAML file that ships with the package."""
    for line in file.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        if key == "description":
            return value.partition(" #")[0].strip().strip("\"'")
    return ""


def given(**values: Any) -> dict[str, Any]:
    """Leave out options that the user did not give."""
    return {name: value for name, value in values.items() if value is not None and value != ()}


class Named(click.ParamType[str]):
    """A word that completes to known names, or to files; the verb checks it."""

    def __init__(self, kind: str, names: Callable[[], Iterable[str]], *, files: bool = True) -> None:
        self.name = kind
        self._names, self._files = names, files

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Show the kind of thing it names."""
        return self.name.upper()

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete a name; a file where no name begins so."""
        found = [CompletionItem(name) for name in self._names() if name.startswith(incomplete)]
        return found if found or not self._files else [CompletionItem(incomplete, type="file")]


class OneOf(Named):
    """A choice whose words are listed, and imported, only when one is given."""

    def __init__(self, kind: str, names: Callable[[], Iterable[str]]) -> None:
        super().__init__(kind, names, files=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Refuse an unknown word."""
        names = list(self._names())
        if value not in names:
            known = did_you_mean(str(value), names, f"choose from {', '.join(names)}")
            self.fail(f"{value!r} is unknown; {known}", param, ctx)
        return str(value)


class PartOf(Named):
    """A link or a joint, completed from the URDF file that the command line already names."""

    def __init__(self, part: str, argument: str) -> None:
        super().__init__(part, tuple, files=False)
        self._argument = argument

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete from the file's text, which may not be well-formed."""
        try:
            text = read_text(str(ctx.params.get(self._argument)))
        except UnreadableError:
            return []
        names = re.findall(rf"""<{self.name}\s[^>]{{0,500}}?\bname\s*=\s*["']([^"'>]{{1,200}})["']""", text)
        return [CompletionItem(name) for name in dict.fromkeys(names) if name.startswith(incomplete)]


SCENE = Named("scene", scene_files)
scene_option = click.option(
    "--scene", type=SCENE, default="paper", show_default=True, help="Name of a shipped scene, or a YAML file."
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(min=0),
    help="Draw the start from the scene's spread, as env.reset(seed=) does.",
)
start_option = click.option(
    "--start",
    metavar="STATE",
    help="Begin here: numbers separated by commas, or a file (.npy, .json, .npz).  [default: the scene's "
    "own start]",
)
trust_option = click.option(
    "--trust",
    is_flag=True,
    help="Execute the code in models (.zip) that need it, with your rights: only if you trust who made them.",
)
normalize_option = click.option(
    "--normalize",
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Statistics of a model (.zip), saved by VecNormalize.",
)
