"""Training from a configuration, and the command `python -m agents.train`."""

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from agents.configuration import (
    AgentConfiguration,
    Configuration,
    ConfigurationError,
    ImitationConfiguration,
    list_configurations,
    load_configuration,
)
from agents.configuration.residual import ResidualConfiguration
from agents.progress import Advance, ProgressDisplay
from experts.demonstrations import DemonstrationsError
from experts.report.command import INTERRUPTED, complain, guarded

if TYPE_CHECKING:
    from agents.imitation.training import Imitated
    from agents.reinforcement.training import Trained

FAILURE = 1

_DESCRIPTION = """Train an agent as a configuration says.

The folder of the run gets the resolved configuration, commit and versions, checkpoints, curves for
TensorBoard, the learning curve, and the policy, exported. A run that was interrupted or killed goes on at its
last checkpoint when the same command is given again.
Exit status: 0; 1 if the folder is for another run, or in use; 2 if the input is unusable; 130 if
interrupted."""


def train(
    configuration: str | Path | Mapping[str, Any] | AgentConfiguration,
    out: str | os.PathLike[str] | None = None,
    *,
    report: Callable[[Advance], None] | None = None,
) -> "Trained | Imitated":
    """Train an agent; a run that was interrupted or killed goes on at its last checkpoint.

    Args:
        configuration: Name of a shipped configuration, path of a YAML file, what such a file holds as a
            mapping, or a configuration.
        out: Folder of the run; results/agents/<name>-<seed> by default.
        report: Called between updates.

    Returns:
        The folder, the learner of Stable-Baselines3 or the network, and its policy, exported.

    Raises:
        ConfigurationError: If the configuration cannot be used.
        SceneError: If its scene cannot be loaded.
        RunFolderError: If the folder is for another configuration, or another process trains there.
        ImportError: If the extra `agents` is not installed.
        KeyboardInterrupt: If the user interrupts it; the last checkpoint remains.
    """
    checked = load_configuration(configuration)
    folder = Path(out) if out is not None else default_folder(checked)
    try:
        run = _run(checked, folder, report or (lambda advance: None))
    except ModuleNotFoundError as error:
        if error.name not in ("stable_baselines3", "sb3_contrib", "torch", "tensorboard"):
            raise
        raise ImportError(f'training needs {error.name}: pip install "dq-space-arm[agents]"') from error
    from agents.run_folder import reserved

    with reserved(folder):
        return run()


def _run(
    checked: AgentConfiguration, folder: Path, tell: Callable[[Advance], None]
) -> "Callable[[], Trained | Imitated]":
    """What trains such an agent; finding it loads what it needs."""
    if isinstance(checked, ImitationConfiguration):
        from agents.imitation.training import train_by_imitation

        return partial(train_by_imitation, checked, folder, tell)
    if isinstance(checked, ResidualConfiguration):
        from agents.residual.training import train_residual

        return partial(train_residual, checked, folder, tell)
    from agents.reinforcement.training import train_by_reinforcement

    assert isinstance(checked, Configuration)
    return partial(train_by_reinforcement, checked, folder, tell)


def default_folder(configuration: AgentConfiguration) -> Path:
    """Name the folder of a run.

    Args:
        configuration: Of the agent.

    Returns:
        The folder.
    """
    return Path("results") / "agents" / f"{configuration.name}-{configuration.seed}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    console = Console(highlight=False)
    return guarded(lambda: _train(console, options))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m agents.train",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = ", ".join(list_configurations())
    parser.add_argument(
        "--config", required=True, help=f"name of a shipped configuration ({names}), or path of a YAML file"
    )
    parser.add_argument("--out", type=Path, help="folder of the run (default: results/agents/<name>-<seed>)")
    parser.add_argument("--seed", type=int, help="in place of the configuration's")
    parser.add_argument("--total-steps", type=int, help="environment steps, in place of the configuration's")
    parser.add_argument("--minutes", type=float, help="limit of time, in place of the configuration's")
    return parser.parse_args(arguments)


def _train(console: Console, options: argparse.Namespace) -> int:
    configuration = _with_options(load_configuration(options.config), options)
    folder = options.out or default_folder(configuration)
    from agents.run_folder import RunFolderError

    try:
        with ProgressDisplay(console) as shown:
            train(configuration, folder, report=shown.update)
    except (RunFolderError, DemonstrationsError) as error:
        complain([str(error)])
        return FAILURE
    except KeyboardInterrupt:
        sentence = f"Interrupted: the same command goes on at the last checkpoint in {folder}."
        console.print(sentence, markup=False)
        return INTERRUPTED
    console.print(f"{folder}: the policy is in policy.npz", markup=False)
    return 0


def _with_options(configuration: AgentConfiguration, options: argparse.Namespace) -> AgentConfiguration:
    content = configuration.model_dump(exclude_none=True)
    if options.seed is not None:
        content["seed"] = options.seed
    for name in ("total_steps", "minutes"):
        if getattr(options, name) is not None:
            if "schedule" not in content:
                option = "--" + name.replace("_", "-")
                raise ConfigurationError(
                    f"{option} is for reinforcement learning: {configuration.name} imitates"
                )
            content["schedule"][name] = getattr(options, name)
    return load_configuration(content)
