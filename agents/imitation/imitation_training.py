"""Train an agent by imitation: configuration -> demonstrations -> clone -> aggregate -> exported policy."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from torch.utils.tensorboard import SummaryWriter

from agents.configuration.imitation import ActionChunking, Dagger, ImitationConfiguration
from agents.demonstrations import expert_seconds, prepare_demonstrations
from agents.imitation.action_chunking import clone_chunks
from agents.imitation.aggregation import aggregate, check_labels
from agents.imitation.cloning import Making, clone
from agents.imitation.trainer import Record
from agents.policies.chunking import Exported
from agents.policies.network import NormalizedNetwork
from agents.run_folder import (
    CHECKPOINTS,
    DEMONSTRATIONS,
    POLICY,
    TENSORBOARD,
    RunFolder,
    validate,
    validation_seeds,
)
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.progress import Advance


class Imitated(NamedTuple):
    """Result of a training run: its folder, the network, and the exported policy."""

    folder: Path
    network: NormalizedNetwork
    policy: Exported


def train_by_imitation(
    configuration: ImitationConfiguration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Imitated:
    """Train an agent in a run folder, resuming from its last checkpoint."""
    scene, configuration = load_scene(configuration.scene), configuration.resolved()
    folder = RunFolder(Path(out), configuration)
    demonstrations = prepare_demonstrations(
        configuration.demonstrations, scene, folder.path / DEMONSTRATIONS, progress=report
    )
    if isinstance(configuration.algorithm, Dagger):
        check_labels(configuration.algorithm, demonstrations)  # before the cloning
    making = Making(configuration.network, configuration.seed, configuration.threads)
    algorithm, place = configuration.algorithm, folder.path / CHECKPOINTS
    solved_in, solves = expert_seconds(demonstrations), demonstrations.settings["problems"]
    with SummaryWriter(str(folder.path / TENSORBOARD)) as writer:
        watch = _Curve(configuration, scene, folder, solved_in, writer).add
        network: NormalizedNetwork
        common: dict[str, Any] = {"making": making, "progress": report, "watch": watch}
        if isinstance(algorithm, ActionChunking):
            chunked = clone_chunks(demonstrations, algorithm, place / "act", scene=scene, **common)
            network, history = chunked.network, chunked.history
        else:
            cloned = clone(demonstrations, configuration.cloning, place / "cloning", scene=scene, **common)
            network, history = cloned.network, cloned.history
            if isinstance(algorithm, Dagger):
                corrected = aggregate(cloned, demonstrations, algorithm, place, **common)
                network, history = corrected.network, corrected.history
                solves += sum(each.solves for each in corrected.rounds)
    spent = history[-1]
    effort = {
        "environment_steps": int(spent["environment_steps"]),
        "updates": int(spent["updates"]),
        "seconds": spent["seconds"] + solved_in,
        "expert_solves": solves,
        "demonstrations": len(demonstrations),
    }
    policy = network.export(folder.metadata(configuration, scene, effort))
    policy.save(folder.path / POLICY)
    return Imitated(folder.path, network, policy)


class _Curve:
    """Flies the network now and then, and keeps the learning curve."""

    def __init__(
        self,
        configuration: ImitationConfiguration,
        scene: Scene,
        folder: RunFolder,
        solved_in: float,
        writer: SummaryWriter,
    ) -> None:
        self._every, self._scene, self._folder = configuration.curve.every, scene, folder
        self._seeds = validation_seeds(configuration.curve.episodes)
        self._solved_in, self._writer = solved_in, writer
        self._lines = folder.evaluations(names=["updates"])

    def add(self, network: NormalizedNetwork, record: Record, is_last: bool) -> Record:
        """Fly if it is time to, add a line to the curve, and return the results of the flights."""
        # A resumed run repeats what came after its checkpoint.
        self._lines = [line for line in self._lines if line["updates"] < record["updates"]]
        flown = self._lines[-1]["updates"] if self._lines else 0.0
        found: Record = {}
        if is_last or record["updates"] - flown >= self._every:
            found = validate(network.export({}), self._scene, self._seeds)
            line = {**record, **found, "seconds": round(record["seconds"] + self._solved_in, 3)}
            self._lines.append(line)
            self._folder.write_evaluations(self._lines)
        for name, value in {**record, **found}.items():
            if name != "updates":
                self._writer.add_scalar(name, value, int(record["updates"]))
        return found
