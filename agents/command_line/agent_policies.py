"""Trained policies for `simulate` and `replay`: entry point of the group `dq_space_arm.policies`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from dq_space_arm_env.command_line.names import Named, package_folder, shipped_files
from dq_space_arm_env.common.bounded_reading import archive_members

if TYPE_CHECKING:
    from rich.console import Console

    from dq_space_arm_env.command_line.simulated_episode import Pilot, Start


_MARKS = {"weight_0", "chunk_format"}  # arrays in the files of exported policies


def configuration_files() -> dict[str, Path]:
    """List the configurations that ship with the package, paths by name."""
    return shipped_files("agents", "configs", "configs/agents")


def policy_files() -> dict[str, Path]:
    """List the policies of the zoo, paths by name."""
    folder = package_folder("agents") / "zoo" / "policies"
    return {path.stem: path for path in sorted(folder.glob("*.npz"))}


def policy_names() -> dict[str, str]:
    """List the policies of the zoo."""
    return dict.fromkeys(policy_files(), "a trained policy that ships with the package")


def owns_policy(policy: str) -> bool:
    """Recognize names of the zoo, exported policies, networks, models of Stable-Baselines3, and runs."""
    path = Path(policy)
    if path.is_dir():
        return (path / "policy.npz").is_file()
    if path.suffix in (".zip", ".onnx"):
        return path.is_file()
    return policy in policy_files() or bool(_MARKS & archive_members(path))


def load_policy(
    policy: str,
    start: Start,
    console: Console,
    seed: int | None,
    trust: bool,
    normalize: Path | None = None,
) -> Pilot:
    """Load a trained policy."""
    from agents.zoo.finding import as_policy, check_fit
    from dq_space_arm_env.command_line.simulated_episode import Pilot

    path = Path(policy) if Path(policy).exists() else policy_files()[policy]
    label = path.stem if path.is_file() else path.name
    acting = as_policy(path, label, trust=trust, normalize=normalize)
    check_fit(acting, start.scene)
    return Pilot(acting.label, acting.act)


CONFIGURATION = Named("configuration", configuration_files)
TRAINED_POLICY = Named("policy", policy_files)
