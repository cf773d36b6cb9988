"""The policies that ship with the package."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from agents.policies import ExportedPolicy
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.validation import did_you_mean

SHELF = Path(__file__).parent / "policies"
"""Folder of `<name>.npz` (weights), `<name>.json` (evaluation) and `<name>.md` (model card)."""
MOST_BYTES = 2_000_000  # limit of all weights together


class ZooError(ValueError):
    """The zoo has no such policy, or cannot take it; the message says what would be right."""


def list_policies(shelf: Path | None = None) -> list[str]:
    """List the policies that ship with the package.

    Args:
        shelf: Another folder than the package's own.

    Returns:
        Their names, sorted.
    """
    return sorted(path.stem for path in (shelf or SHELF).glob("*.npz"))


def policy_file(name: str, shelf: Path | None = None) -> Path:
    """Path of a policy's weights; ZooError if there is no policy of this name."""
    names = list_policies(shelf)
    if name in names:
        return (shelf or SHELF) / f"{name}.npz"
    if Path(name).suffix == ".npz" or len(Path(name).parts) > 1:
        there = (
            f"to load it, ExportedPolicy.load({name!r})" if Path(name).exists() else "there is no such file"
        )
        raise ZooError(f"{name}: is a path, should be a name of the zoo; {there}")
    close = did_you_mean(name, names)
    known = f"It has {', '.join(names)}" if names else "It is empty"
    raise ZooError(
        f"the zoo has no policy {name!r}{f'; {close}' if close else '. '}{known}. Give a policy of "
        "your own by the path of its .npz file, or by its run folder"
    )


def load_policy(name: str) -> ExportedPolicy:
    """Load a policy that ships with the package.

    Args:
        name: Its name, one of `list_policies`.

    Returns:
        The policy.

    Raises:
        ZooError: If there is no policy of this name.
        PolicyFileError: If its file is damaged.
    """
    return ExportedPolicy.load(policy_file(name))


def load_record(name: str, shelf: Path | None = None) -> dict[str, Any]:
    """Record of a policy's evaluation, JSON values as `scripts/add_to_zoo.py` describes them."""
    file = policy_file(name, shelf).with_suffix(".json")
    try:
        return read_mapping(file)
    except UnreadableError as error:
        raise ZooError(f"{file} cannot be read ({error}): add the policy to the zoo again") from error


def file_hash(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
