"""Training from a configuration."""

import os
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.configuration import (
    AgentConfiguration,
    Configuration,
    ConfigurationError,
    ImitationConfiguration,
    load_configuration,
)
from agents.configuration.gradients import GradientConfiguration
from agents.configuration.residual import ResidualConfiguration
from agents.configuration.schema import name_in
from dq_space_arm_env import load_scene
from dq_space_arm_env.common.progress import Advance

if TYPE_CHECKING:
    from agents.gradients.gradient_training import Learned
    from agents.imitation.imitation_training import Imitated
    from agents.reinforcement.reinforcement_training import Trained


def train(
    configuration: str | Path | Mapping[str, Any] | AgentConfiguration,
    out: str | os.PathLike[str] | None = None,
    *,
    report: Callable[[Advance], None] | None = None,
) -> "Trained | Imitated | Learned":
    """Train an agent in a run folder; the same call resumes an interrupted run at its last checkpoint.

    Args:
        configuration: Name of a shipped configuration, path of a YAML file, its content as a mapping, or a
            configuration.
        out: Folder of the run; results/agents/<name>-<seed> by default.
        report: Called with the progress between updates.

    Returns:
        The folder, the Stable-Baselines3 model or the network if it has one, and the exported policy.

    Raises:
        ConfigurationError: If the configuration is invalid.
        SceneError: If its scene cannot be loaded.
        RunFolderError: If the folder is for another configuration, or another process trains there.
        ImportError: If the extra `agents` is not installed, which all but policy gradients need.
        DivergedError, ValueError: If the training diverges; the last checkpoint remains.
        KeyboardInterrupt: On Ctrl-C; the last checkpoint remains.
    """
    checked = load_configuration(configuration).resolved()
    folder = Path(out) if out is not None else default_folder(checked)
    try:
        run = _run(checked, folder, report or (lambda advance: None))
    except ModuleNotFoundError as error:
        if error.name not in ("stable_baselines3", "sb3_contrib", "torch", "tensorboard"):
            raise
        raise ImportError(f'training needs {error.name}: pip install "dq-space-arm[agents]"') from error
    from agents.run_folder import reserved

    warn_of_equal_starts(checked)  # or a scene that is not there would leave a folder behind
    with reserved(folder):
        return run()


def warn_of_equal_starts(configuration: AgentConfiguration) -> None:
    """Warn where nothing is drawn in the scene of a configuration; SceneError if it cannot be loaded."""
    from agents.run_folder import starts_alike

    if starts_alike(scene := load_scene(configuration.scene)):
        warnings.warn(
            f"scene {scene.name!r} has no spread, so all episodes start alike: the policy learns to fly from "
            "this start alone; give the scene a spread for others",
            stacklevel=3,
        )


def is_trained(configuration: AgentConfiguration, folder: Path) -> bool:
    """Whether a folder holds the policy with which the training of a configuration ends."""
    from agents.policies.chunking import load_exported
    from agents.run_folder import POLICY

    try:
        kept = load_exported(folder / POLICY).metadata
        there = load_configuration(kept["configuration"]).resolved()
        scene_hash = load_scene(configuration.scene).content_hash()
    except (KeyError, TypeError, ValueError):
        return False
    same = there.model_copy(update={"description": configuration.description})
    return same == configuration.resolved() and kept.get("scene_hash") == scene_hash


def _run(
    checked: AgentConfiguration, folder: Path, tell: Callable[[Advance], None]
) -> "Callable[[], Trained | Imitated | Learned]":
    """The training function for a configuration, imported with what it needs."""
    if isinstance(checked, ImitationConfiguration):
        from agents.imitation.imitation_training import train_by_imitation

        return partial(train_by_imitation, checked, folder, tell)
    if isinstance(checked, GradientConfiguration):
        from agents.gradients.gradient_training import train_by_gradients

        return partial(train_by_gradients, checked, folder, tell)
    if isinstance(checked, ResidualConfiguration):
        from agents.residual.residual_training import train_residual

        return partial(train_residual, checked, folder, tell)
    from agents.reinforcement.reinforcement_training import train_by_reinforcement

    assert isinstance(checked, Configuration)
    return partial(train_by_reinforcement, checked, folder, tell)


def default_folder(configuration: AgentConfiguration) -> Path:
    """The default run folder, results/agents/<name>-<seed>."""
    return Path("results") / "agents" / f"{configuration.name}-{configuration.seed}"


def with_changes(
    configuration: AgentConfiguration,
    *,
    seed: int | None = None,
    total_steps: int | None = None,
    minutes: float | None = None,
    scene: str | None = None,
) -> AgentConfiguration:
    """Replace settings by those of the command line, minutes being the time limit; a scene adds its name."""
    content = configuration.model_dump(exclude_none=True)
    if seed is not None:
        content["seed"] = seed
    if scene is not None:
        content |= {"scene": scene, "name": name_in(configuration.name, scene)}
    for name, value in (("total_steps", total_steps), ("minutes", minutes)):
        if value is not None:
            if "schedule" not in content:
                option = "--" + name.replace("_", "-")
                raise ConfigurationError(
                    f"{option} is for reinforcement learning, not for {configuration.name}"
                )
            content["schedule"][name] = value
    return load_configuration(content)
