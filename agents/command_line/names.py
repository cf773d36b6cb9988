"""Names that the shell completes, and that lists show: scenes, configurations of agents, policies.

They are read from the folders in which the files ship, without importing the packages that they belong to:
Gymnasium alone would take longer than a user who has pressed TAB likes to wait.
"""

import re
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

POLICIES = {
    "zero": "no input at all",
    "random": "inputs drawn at random within their limits",
    "plan": "the expert's plan from this start, open loop",
    "gains": "the expert's plan with its feedback gains",
    "receding": "the expert, who plans the next stages anew at every step",
}
"""What `simulate` can fly besides trained policies."""


def package_folder(package: str) -> Path:
    """Find a package of this project without importing it.

    Args:
        package: Its name.

    Returns:
        Its folder.

    Raises:
        ImportError: If it is not installed.
    """
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"the package {package} is missing: install dq-space-arm again")
    return Path(next(iter(spec.submodule_search_locations)))


def shipped_files(package: str, kind: str) -> dict[str, Path]:
    """Find the YAML files that ship with a package.

    Args:
        package: Its name.
        kind: Name of the folder in the checkout's `configs`, and of the files.

    Returns:
        Paths by name, sorted.
    """
    home = package_folder(package)
    installed = home / "configs" / kind if kind == "scenes" else home / "configs"
    checkout = home.parent / "configs" / kind
    folder = installed if installed.is_dir() else checkout
    return _by_name(folder.glob("*.yaml"))


def _by_name(files: Iterable[Path]) -> dict[str, Path]:
    return {path.stem: path for path in sorted(files, key=lambda path: path.stem)}


def scene_files() -> dict[str, Path]:
    """Find the scenes that ship with the package.

    Returns:
        Paths by name, sorted.
    """
    return shipped_files("dq_space_arm_env", "scenes")


def configuration_files() -> dict[str, Path]:
    """Find the configurations of agents that ship with the package.

    Returns:
        Paths by name, sorted.
    """
    return shipped_files("agents", "agents")


def policy_files() -> dict[str, Path]:
    """Find the trained policies that ship with the package.

    Returns:
        Paths by name, sorted.
    """
    folder = package_folder("agents") / "zoo" / "policies"
    return _by_name(folder.glob("*.npz"))


def check_policy(policy: str) -> None:
    """Refuse what is no policy.

    Args:
        policy: Out of `POLICIES`, the name of a policy that is shipped, or a path.

    Raises:
        ValueError: If it is none of them.
    """
    known = [*POLICIES, *policy_files()]
    if policy.lower() not in POLICIES and policy not in known and not Path(policy).exists():
        raise ValueError(
            f"no policy is named {policy!r}, and there is no such file; {did_you_mean(policy, known)}The "
            f"policies are {', '.join(known)}; one of your own is given by its file (.npz, .zip) or the "
            "folder of its run"
        )


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Suggest the closest known word.

    Args:
        word: What was written.
        known: The words that would have been right.

    Returns:
        "did you mean 'plan'? " with a trailing blank, or an empty string when nothing is close.
    """
    from difflib import get_close_matches

    close = get_close_matches(word, list(known), n=1)
    return f"did you mean {close[0]!r}? " if close else ""


def description_of(file: Path) -> str:
    """Read what a scene or a configuration says of itself.

    Args:
        file: A YAML file of the package's own.

    Returns:
        Its description, on one line; empty if it has none.
    """
    for line in file.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        if key == "description":
            return value.partition(" #")[0].strip().strip("\"'")
    return ""


def completions(incomplete: str, names: Iterable[str], *, files: bool = True) -> list[CompletionItem]:
    """What a word may become.

    Args:
        incomplete: What is typed so far.
        names: Words that are known.
        files: Whether a path would do as well.

    Returns:
        The names that begin so; where there are none, or nothing is typed, paths too.
    """
    found = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    return found if found or not files else [CompletionItem(incomplete, type="file")]


if TYPE_CHECKING:
    Type = click.ParamType[Any]
else:  # older versions of Click cannot be indexed
    Type = click.ParamType


class Named(Type):
    """A word that is checked where it is used, and completed here: a scene, a configuration, a policy."""

    def __init__(self, kind: str, names: Callable[[], Iterable[str]], *, files: bool = True) -> None:
        """Set up.

        Args:
            kind: What it names, for the help.
            names: Lists what can be completed.
            files: Whether a path would do as well.
        """
        self.name = kind
        self._names, self._files = names, files

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What the help calls it."""
        return self.name.upper()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Take the word as it is."""
        return str(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete it."""
        return completions(incomplete, self._names(), files=self._files)


class OneOf(Named):
    """A word out of several that are listed only when one of them is given."""

    def __init__(self, kind: str, names: Callable[[], Iterable[str]]) -> None:
        """Set up.

        Args:
            kind: What it names, for the help.
            names: Lists them.
        """
        super().__init__(kind, names, files=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Refuse what is none of them."""
        names = list(self._names())
        if value not in names:
            self.fail(
                f"{value!r} is unknown; {did_you_mean(str(value), names)}There are {', '.join(names)}",
                param,
                ctx,
            )
        return str(value)


class PartOf(Named):
    """The name of a link or a joint, completed from the URDF file that the command line already names."""

    def __init__(self, part: str, argument: str) -> None:
        """Set up.

        Args:
            part: "link" or "joint".
            argument: The argument that is the file's path.
        """
        super().__init__(part, tuple, files=False)
        self._argument = argument

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete it; the file is searched, not parsed, and may be broken or missing."""
        try:
            text = Path(str(ctx.params.get(self._argument))).read_text(encoding="utf-8")
        except (OSError, ValueError):
            return []
        names = re.findall(rf"""<{self.name}\s[^>]*?\bname\s*=\s*["']([^"'>]+)["']""", text)
        return completions(incomplete, dict.fromkeys(names), files=False)


SCENE = Named("scene", scene_files)


def given(**values: Any) -> dict[str, Any]:
    """Leave out what the user has not said.

    Args:
        **values: Of options; None or empty where they were not given.

    Returns:
        The others.
    """
    return {name: value for name, value in values.items() if value is not None and value != ()}


CONFIGURATION = Named("configuration", configuration_files)
POLICY = Named("policy", lambda: [*POLICIES, *policy_files()])
TRAINED_POLICY = Named("policy", policy_files)
