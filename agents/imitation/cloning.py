"""Clone the expert: train a network on demonstrations."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic

import torch

from agents.configuration.imitation import Cloning, Fit
from agents.configuration.schema import Network
from agents.demonstrations import check_gains, check_scene, fingerprint
from agents.imitation.objective import Objective
from agents.imitation.samples import Statistics
from agents.imitation.trainer import N, Progress, Record, Trainer, Watch, torch_threads
from agents.policies.chunking import Exported
from agents.policies.network import PolicyNetwork
from dq_space_arm_env import Scene
from experts.demonstrations import Demonstrations


@dataclass(frozen=True)
class Making:
    """Network, seed and threads of a training."""

    network: Network = field(default_factory=Network)
    seed: int = 0
    threads: int = 1  # of PyTorch; another number changes the last digits


@dataclass(frozen=True, eq=False)
class Cloned(Generic[N]):
    """A cloned network."""

    network: N  # with the weights of the lowest validation loss
    history: list[Record]  # losses at every validation, see `Trainer`
    facts: dict[str, Any]  # metadata of the exported policy, JSON values

    def export(self) -> Exported:
        """Export the policy, which needs NumPy alone."""
        return self.network.export(self.facts)


def clone(
    demonstrations: Demonstrations,
    settings: Cloning | None = None,
    folder: str | os.PathLike[str] | None = None,
    *,
    making: Making | None = None,
    scene: Scene | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Cloned[PolicyNetwork]:
    """Train a network on demonstrations; the same call resumes an interrupted run, with the same result.

    Args:
        demonstrations: What to learn from, a part of them kept for validation.
        settings: Hyperparameters; `Cloning()` by default.
        folder: Where to keep a checkpoint; None for nowhere.
        making: Network, seed and threads; `Making()` by default.
        scene: The scene to fly in, which may differ in its tolerances; that of the demonstrations by default.
        progress: Called now and then.
        watch: Called with the network at every validation; its result is added to the history.

    Returns:
        The network.

    Raises:
        ValueError: If there are too few demonstrations, gains are missing, or the training diverges.
        DemonstrationsError: If the demonstrations are of another scene.
        CheckpointError: If the folder holds another training, or a damaged checkpoint.
    """
    settings, making = settings or Cloning(), making or Making()
    intended = scene or demonstrations.scene
    check_scene(demonstrations, intended)
    training, validation = divide(demonstrations, settings, making.seed)
    facts = facts_of(demonstrations, settings, making, intended)
    with torch_threads(making.threads):
        statistics = Statistics.of(training)
        network = new_network(statistics, making)
        if settings.stationary:
            network.observation_scale[-1] = 0.0  # of the time left
        trainer = Trainer(
            network,
            Objective(demonstrations.kernels, statistics, settings.objective),
            settings.optimization,
            validate_every=settings.validate_every,
            seed=making.seed,
            part="cloning",
        )
        place = None if folder is None else Path(folder)
        trainer.train(training, validation, place, facts["training"], progress=progress, watch=watch)
    return Cloned(network, trainer.history, facts)


def new_network(statistics: Statistics, making: Making) -> PolicyNetwork:
    """An untrained network that knows the units of its data."""
    hidden, activation = making.network.hidden, making.network.activation
    return with_units(
        lambda seen, taken: PolicyNetwork(seen, taken, hidden, activation), statistics, making.seed
    )


def with_units(make: Callable[[int, int], N], statistics: Statistics, seed: int) -> N:
    """Make a network for numbers of observations and actions, and tell it the units of its data."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = make(len(statistics.observation_mean), len(statistics.action_mean))
    network.normalize(
        statistics.observation_mean,
        statistics.observation_deviation,
        statistics.action_mean,
        statistics.action_deviation,
    )
    return network


def facts_of(demonstrations: Demonstrations, settings: Fit, making: Making, scene: Scene) -> dict[str, Any]:
    """Metadata that identifies a training, JSON values."""
    return {
        "scene": scene.name,
        "scene_hash": scene.content_hash(),
        "training": {
            "demonstrations": len(demonstrations),
            "tolerances": demonstrations.scene.success.model_dump(mode="json"),
            "data": demonstrations.manifest["settings_sha256"],
            "problems": fingerprint(demonstrations),
            "network": making.network.model_dump(mode="json"),
            "seed": making.seed,
            "threads": making.threads,
            **settings.model_dump(mode="json"),
        },
    }


def divide(
    demonstrations: Demonstrations, settings: Fit, seed: int
) -> tuple[Demonstrations, Demonstrations | None]:
    """Split into demonstrations to train on and to validate on."""
    count, share, gains = len(demonstrations), settings.validation_share, settings.needs_gains
    aside = max(1, round(share * count)) if share else 0
    if count - aside < 1 or (gains and count - aside < 2):
        raise ValueError(
            f"{count} demonstrations, {aside} of them for the validation, are too few: training needs one, "
            "or two with gains, whose spread is the unit of deviations"
        )
    if gains:
        check_gains(demonstrations, "gain_weight and augmentation_weight need: set both to 0")
    if not aside:
        return demonstrations, None
    training, validation = demonstrations.split(1.0 - aside / count, aside / count, seed=seed)
    return training, validation
