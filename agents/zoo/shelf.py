"""The policies that ship with the package: where they lie, and how to take one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from agents.policies import ExportedPolicy
from dq_space_arm_env.validation import did_you_mean

SHELF = Path(__file__).parent / "policies"
"""Their folder; for each `<name>.npz`, its weights, `<name>.json`, its evaluation, `<name>.md`, its card."""
MOST_BYTES = 2_000_000
"""What all weights may take together."""


class ZooError(ValueError):
    """The zoo has no such policy, or cannot take one; the message says what would be right."""


def list_policies(shelf: Path | None = None) -> list[str]:
    """List the policies that ship with the package.

    Args:
        shelf: A folder in place of the package's own.

    Returns:
        Their names, sorted; none if the zoo is empty.
    """
    return sorted(path.stem for path in (shelf or SHELF).glob("*.npz"))


def policy_file(name: str, shelf: Path | None = None) -> Path:
    """Find the weights of a policy.

    Args:
        name: Its name.
        shelf: A folder in place of the package's own.

    Returns:
        The file.

    Raises:
        ZooError: If there is no policy of this name.
    """
    names = list_policies(shelf)
    if name in names:
        return (shelf or SHELF) / f"{name}.npz"
    close = did_you_mean(name, names)
    known = f"It has {', '.join(names)}" if names else "It is empty"
    raise ZooError(
        f"the zoo has no policy {name!r}{f'; {close}' if close else '. '}{known}. A policy of your own is "
        "given by the path of its file, which ends in .npz, or by the folder of its training run"
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
    """Load what is known of a policy: how it was evaluated, and the hash of its file.

    Args:
        name: Its name.
        shelf: A folder in place of the package's own.

    Returns:
        JSON values, see `agents.zoo.adding`.

    Raises:
        ZooError: If there is no policy of this name, or nothing is known of it.
    """
    file = policy_file(name, shelf).with_suffix(".json")
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise ZooError(f"{file} cannot be read ({error}): add the policy to the zoo again") from error


def file_hash(path: Path) -> str:
    """Identify a file by its content.

    Args:
        path: The file.

    Returns:
        SHA-256, 64 hexadecimal digits.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()
