"""Checkpoints: all that a learner needs to go on where it was."""

import json
from pathlib import Path
from typing import NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from agents.configuration import Configuration
from agents.reinforcement.building import LEARNERS
from agents.reinforcement.held_actions import HeldActions

_MODEL, _BUFFER, _PROGRESS = "model.zip", "replay_buffer.pkl", "progress.json"


class Progress(NamedTuple):
    """How far a run has come.

    Attributes:
        environment_steps: Of all copies together.
        seconds: Time spent on it, in all of its starts, s.
        expert_solves: Problems that the expert solved for what it learns from, or for what it began with.
        seconds_before: Time that these, and the training of what it began with, have taken, s.
    """

    environment_steps: int
    seconds: float
    expert_solves: int = 0
    seconds_before: float = 0.0


def write_checkpoint(folder: Path, model: BaseAlgorithm, progress: Progress) -> None:
    """Write a learner: parameters, the state of optimizers, the replay buffer if it has one, counters.

    Args:
        folder: An empty folder.
        model: The learner.
        progress: How far it has come.
    """
    model.save(folder / _MODEL)
    if isinstance(model, OffPolicyAlgorithm):
        model.save_replay_buffer(folder / _BUFFER)
    (folder / _PROGRESS).write_text(json.dumps(progress._asdict()), encoding="utf-8")


def read_checkpoint(
    folder: Path, configuration: Configuration, environment: HeldActions
) -> tuple[BaseAlgorithm, Progress]:
    """Read a learner, to go on in an environment.

    Episodes in flight are not part of it: they begin anew, with seeds that follow from the configuration's
    and the number of steps.

    Args:
        folder: A checkpoint. Only read your own: it holds pickled objects.
        configuration: Of the agent.
        environment: What it practices in.

    Returns:
        The learner, and how far it has come.

    Raises:
        OSError: If a file is missing.
    """
    progress = Progress(**json.loads((folder / _PROGRESS).read_text(encoding="utf-8")))
    learner = LEARNERS[configuration.algorithm.name]
    model = learner.load(folder / _MODEL, env=environment, device="cpu")
    if isinstance(model, OffPolicyAlgorithm):
        model.load_replay_buffer(folder / _BUFFER)
    model.set_random_seed(configuration.seed + progress.environment_steps)
    return model, progress
