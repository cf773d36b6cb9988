"""Action chunking with a transformer (ACT): learn the expert's next actions at every time step.

After Zhao et al. 2023, Learning fine-grained bimanual manipulation with low-cost hardware: chunks, L1 loss,
temporal ensemble. Their conditional autoencoder, a latent variable for the style of a demonstration, is left
out: it is for people, who act differently in equal situations, and the expert has one answer to a state.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from agents.configuration.imitation import ActionChunking
from agents.demonstrations import check_scene
from agents.imitation.cloning import Cloned, Making, divide, facts_of, with_units
from agents.imitation.objective import Losses, action_errors
from agents.imitation.samples import Statistics
from agents.imitation.trainer import Progress, Trainer, Watch, torch_threads
from agents.policies.chunk_network import ChunkNetwork
from dq_space_arm_env import Scene
from dq_space_arm_env.scene import StateLayout
from experts.demonstrations import Demonstrations
from experts.demonstrations.reading import Batch


class Chunks:
    """Time steps with the actions that follow them, in memory in single precision; a `Source`.

    All of them are shuffled together; `Demonstrations.batches` mixes some dozens of maneuvers at a time.
    """

    def __init__(self, demonstrations: Demonstrations, chunk: int, spacing: int) -> None:
        self._ahead = spacing * np.arange(chunk)
        self._observations = np.stack([each.observations[:-1].astype(np.float32) for each in demonstrations])
        self._actions = np.stack([each.actions.astype(np.float32) for each in demonstrations])

    def batches(self, size: int, names: Sequence[str], *, seed: int) -> Iterator[Batch]:
        """One pass over all time steps; `actions` are of shape (B, k, n_u), the last repeats at the end."""
        maneuvers, horizon = self._actions.shape[:2]
        order = np.random.default_rng(seed).permutation(maneuvers * horizon)
        for first in range(0, len(order), size):
            maneuver, stage = np.divmod(order[first : first + size], horizon)
            ahead = np.minimum(stage[:, None] + self._ahead, horizon - 1)
            arrays = {
                "observations": self._observations[maneuver, stage],
                "actions": self._actions[maneuver[:, None], ahead],
            }
            yield Batch(maneuver, stage, arrays)


class ChunkLoss:
    """Mean absolute error of all actions of the chunks, in units of the demonstrations' spread."""

    needs = ("observations", "actions")

    def __init__(self, scene: Scene) -> None:
        layout = StateLayout.of(scene)
        self._least = layout.lower_limits(np.ones(layout.n_u))

    def __call__(self, network: ChunkNetwork, batch: Batch, rng: np.random.Generator) -> Losses:
        """Evaluate the loss, with gradients."""
        outputs = network(network.normalized(batch.arrays["observations"]))
        action = action_errors(network, outputs, batch.arrays["actions"], self._least).abs().mean()
        none = torch.zeros(())
        return Losses(action, action, none, none)


def clone_chunks(
    demonstrations: Demonstrations,
    settings: ActionChunking | None = None,
    folder: str | os.PathLike[str] | None = None,
    *,
    making: Making | None = None,
    scene: Scene | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Cloned[ChunkNetwork]:
    """Train a transformer on demonstrations; arguments, result and errors are those of `clone`."""
    settings, making = settings or ActionChunking(), making or Making()
    intended = scene or demonstrations.scene
    check_scene(demonstrations, intended)
    training, validation = divide(demonstrations, settings, making.seed)
    facts = facts_of(demonstrations, settings, making, intended)
    source = Chunks(training, settings.chunk, settings.spacing)
    judge = None if validation is None else Chunks(validation, settings.chunk, settings.spacing)
    with torch_threads(making.threads):
        trainer = Trainer(
            network := _new_network(Statistics.of(training), settings, making),
            ChunkLoss(demonstrations.scene),
            settings.optimization,
            validate_every=settings.validate_every,
            seed=making.seed,
            part="act",
        )
        place = None if folder is None else Path(folder)
        trainer.train(source, judge, place, facts["training"], progress=progress, watch=watch)
    return Cloned(network, trainer.history, facts)


def _new_network(statistics: Statistics, settings: ActionChunking, making: Making) -> ChunkNetwork:
    """An untrained network that knows the units of its data."""

    def make(n_observation: int, n_action: int) -> ChunkNetwork:
        return ChunkNetwork(
            n_observation,
            n_action,
            hidden=making.network.hidden,
            activation=making.network.activation,
            chunk=settings.chunk,
            width=settings.width,
            layers=settings.layers,
            heads=settings.heads,
            spacing=settings.spacing,
            weighting=settings.weighting,
        )

    return with_units(make, statistics, making.seed)
