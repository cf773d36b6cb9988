"""Training an agent by reinforcement, from a configuration to a policy."""

import os
from collections.abc import Callable
from pathlib import Path
from traceback import walk_tb
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure

from agents.configuration import SAC, Configuration
from agents.demonstrations import expert_seconds, prepare_demonstrations
from agents.policies import ExportedPolicy
from agents.reinforcement.building import make_environment, make_learner, units_of
from agents.reinforcement.checkpoints import Progress, read_checkpoint
from agents.reinforcement.demonstrating import fly_again
from agents.reinforcement.held_actions import HeldActions, action_limits
from agents.reinforcement.networks import ScaledObservations
from agents.reinforcement.sac import DemonstrationBuffer, SoftActorCritic
from agents.reinforcement.starting import Before, spent_before
from agents.reinforcement.watching import Advance, Watcher
from agents.run_folder import DEMONSTRATIONS, MODEL, POLICY, TENSORBOARD, RunFolder
from dq_space_arm_env import Scene, load_scene


class Trained(NamedTuple):
    """What a training run gives.

    Attributes:
        folder: Where it is, see `agents.run_folder`.
        model: The learner of Stable-Baselines3.
        policy: Its policy as arrays.
    """

    folder: Path
    model: BaseAlgorithm
    policy: ExportedPolicy


def train_by_reinforcement(
    configuration: Configuration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Trained:
    """Train an agent; a run that was interrupted or killed goes on at its last checkpoint.

    Args:
        configuration: Of the agent.
        out: Folder of the run; made if it does not exist.
        report: Called between updates.

    Returns:
        The trained agent.

    Raises:
        SceneError: If the scene cannot be loaded.
        ValueError: If it has no normalized actions.
        RunFolderError: If the folder is for another configuration.
        ConfigurationError: If the policy that it begins with is not there, or does not fit.
        DemonstrationsError: If the demonstrations that it learns from cannot be made or read, or do not fit.
        DivergedError: If the network no longer gives numbers; likewise.
        KeyboardInterrupt: If the user interrupts it; the last checkpoint remains.
    """
    scene = load_scene(configuration.scene)
    folder = RunFolder(Path(out), configuration)
    environment = make_environment(configuration, scene)
    return train_learner(
        configuration,
        folder,
        environment,
        lambda: _begin(configuration, scene, folder, environment),
        lambda before: Watcher(configuration, scene, folder, before, report),
    )


def train_learner(
    configuration: Configuration,
    folder: RunFolder,
    environment: HeldActions,
    begin: Callable[[], tuple[BaseAlgorithm, Progress]],
    watch: Callable[[Progress], Watcher],
) -> Trained:
    """Let a learner practice to the end of its schedule, from its last checkpoint on if there is one.

    Args:
        configuration: Of the agent.
        folder: Of the run.
        environment: What it practices in; it is closed.
        begin: Makes a learner that has learned nothing yet, and says what was spent on it before.
        watch: Makes what evaluates it and writes checkpoints, given how far the run has come.

    Returns:
        The trained agent.

    Raises:
        DivergedError: If the network no longer gives numbers; the last checkpoint remains.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(configuration.threads)
    try:
        checkpoint = folder.checkpoint()
        if checkpoint is None:
            model, before = begin()
        else:
            model, before = read_checkpoint(checkpoint, configuration, environment)
        model.set_logger(configure(str(folder.path / TENSORBOARD), ["tensorboard"]))
        watcher = watch(before)
        _learn(model, watcher, configuration)
        policy = watcher.export()
    finally:
        torch.set_num_threads(threads)
        environment.close()
    policy.save(folder.path / POLICY)
    model.save(folder.path / MODEL)
    return Trained(folder.path, model, policy)


def _begin(
    configuration: Configuration, scene: Scene, folder: RunFolder, environment: HeldActions
) -> tuple[BaseAlgorithm, Progress]:
    """Make a learner, with what it is given to begin with."""
    model, spent = make_learner(configuration, environment), spent_before(configuration)
    algorithm = configuration.algorithm
    if isinstance(algorithm, SAC) and algorithm.demonstrations is not None:
        given = algorithm.demonstrations
        demonstrations = prepare_demonstrations(given.source, scene, folder.path / DEMONSTRATIONS)
        flown = fly_again(demonstrations, scene, environment)
        assert isinstance(model, SoftActorCritic)
        assert isinstance(model.replay_buffer, DemonstrationBuffer)
        model.replay_buffer.demonstrate(flown, action_limits(environment), given.share)
        if configuration.environment.normalize_observations:
            # What good flights see varies less than what random ones do.
            _see_in_units_of(model, flown.observations)
        spent = Before(
            spent.expert_solves + demonstrations.settings["problems"],
            spent.seconds + expert_seconds(demonstrations),
        )
    return model, Progress(0, 0.0, spent.expert_solves, spent.seconds)


def _see_in_units_of(model: SoftActorCritic, observations: NDArray[np.float32]) -> None:
    for module in model.policy.modules():
        if isinstance(module, ScaledObservations):
            module.set_units(*units_of(observations))


def _learn(model: BaseAlgorithm, watcher: Watcher, configuration: Configuration) -> None:
    schedule = configuration.schedule
    left = configuration.decisions(schedule.total_steps) - model.num_timesteps
    watcher.init_callback(model)
    if left <= 0 or watcher.is_time_up:
        return
    # Stable-Baselines3 adds what it is asked for to what was done before, and counts schedules by the sum.
    try:
        model.learn(left, callback=watcher, reset_num_timesteps=model.num_timesteps == 0)
    except (ValueError, RuntimeError) as error:
        if _is_refusal_of_numbers(error):
            raise watcher.diverged() from error
        raise
    watcher.check_network()
    watcher.evaluate()
    watcher.write_checkpoint()


def _is_refusal_of_numbers(error: BaseException) -> bool:
    """Whether PyTorch's distributions refuse what a network gives, or its optimizers the size of a step."""
    origin = [frame for frame, _ in walk_tb(error.__traceback__)][-1].f_globals.get("__name__", "")
    return str(origin).startswith(("torch.distributions.", "torch.optim."))
