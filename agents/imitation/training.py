"""Training an agent by imitation, from a configuration to a policy."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from torch.utils.tensorboard import SummaryWriter

from agents.configuration.imitation import Dagger, ImitationConfiguration
from agents.demonstrations import expert_seconds, prepare_demonstrations
from agents.imitation.aggregation import Round, aggregate
from agents.imitation.cloning import Making, clone
from agents.imitation.progress import Generating
from agents.imitation.trainer import Record
from agents.policies import ExportedPolicy
from agents.policies.network import PolicyNetwork
from agents.progress import Advance
from agents.run_folder import CHECKPOINTS, DEMONSTRATIONS, POLICY, TENSORBOARD, RunFolder
from agents.validation import validate, validation_seeds
from dq_space_arm_env import Scene, load_scene
from experts.demonstrations import Demonstrations


class Imitated(NamedTuple):
    """What a training run gives.

    Attributes:
        folder: Where it is, see `agents.run_folder`.
        network: The network.
        policy: The same as arrays.
    """

    folder: Path
    network: PolicyNetwork
    policy: ExportedPolicy


def train_by_imitation(
    configuration: ImitationConfiguration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Imitated:
    """Train an agent; a run that was interrupted or killed goes on at its last checkpoint.

    Args:
        configuration: Of the agent.
        out: Folder of the run; made if it does not exist.
        report: Called now and then.

    Returns:
        The trained agent.

    Raises:
        SceneError: If the scene cannot be loaded.
        DemonstrationsError: If the demonstrations cannot be made or read, or do not fit.
        ValueError: If they cannot be learned from: too few, or without gains that are asked for.
        RunFolderError: If the folder is for another configuration.
        CheckpointError: If a checkpoint is damaged.
        KeyboardInterrupt: If the user interrupts it; the last checkpoint remains.
    """
    scene = load_scene(configuration.scene)
    folder = RunFolder(Path(out), configuration)
    demonstrations = prepare_demonstrations(
        configuration.demonstrations,
        scene,
        folder.path / DEMONSTRATIONS,
        progress=lambda advance: report(Generating(advance)),
    )
    learned = _learn(configuration, scene, folder, demonstrations, report)
    spent, solves = learned.history[-1], sum(each.solves for each in learned.rounds)
    policy = learned.network.export(
        {
            "agent": configuration.name,
            "scene": scene.name,
            "scene_hash": scene.content_hash(),
            "configuration": configuration.model_dump(mode="json", exclude_none=True),
            "provenance": folder.provenance,
            "training": {
                "environment_steps": int(spent["environment_steps"]),
                "updates": int(spent["updates"]),
                "seconds": spent["seconds"] + expert_seconds(demonstrations),
                "expert_solves": demonstrations.settings["problems"] + solves,
                "demonstrations": len(demonstrations),
            },
        }
    )
    policy.save(folder.path / POLICY)
    return Imitated(folder.path, learned.network, policy)


class _Learned(NamedTuple):
    network: PolicyNetwork
    history: list[Record]
    rounds: list[Round]


def _learn(
    configuration: ImitationConfiguration,
    scene: Scene,
    folder: RunFolder,
    demonstrations: Demonstrations,
    report: Callable[[Advance], None],
) -> _Learned:
    """Clone, and if that is asked for, correct."""
    making = Making(configuration.network, configuration.seed, configuration.threads)
    algorithm, place = configuration.algorithm, folder.path / CHECKPOINTS
    with SummaryWriter(str(folder.path / TENSORBOARD)) as writer:
        watch = _Curve(configuration, scene, folder, expert_seconds(demonstrations), writer).look
        cloned = clone(
            demonstrations,
            configuration.cloning,
            place / "cloning",
            making=making,
            scene=scene,
            progress=report,
            watch=watch,
        )
        if not isinstance(algorithm, Dagger):
            return _Learned(cloned.network, cloned.history, [])
        corrected = aggregate(
            cloned, demonstrations, algorithm, place, making=making, progress=report, watch=watch
        )
    return _Learned(corrected.network, corrected.history, corrected.rounds)


class _Curve:
    """Lets the network fly now and then, and keeps the learning curve."""

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

    def look(self, network: PolicyNetwork, record: Record, is_last: bool) -> Record:
        """Fly if it is time to, add a line to the curve, and give what is new in it."""
        # A run that goes on at a checkpoint repeats what came after it.
        lines = [line for line in self._folder.evaluations() if line["updates"] < record["updates"]]
        flown = lines[-1]["updates"] if lines else 0.0
        found: Record = {}
        if is_last or record["updates"] - flown >= self._every:
            found = validate(network.export({}), self._scene, self._seeds)
            line = {**record, **found, "seconds": round(record["seconds"] + self._solved_in, 3)}
            self._folder.write_evaluations([*lines, line])
        for name, value in {**record, **found}.items():
            if name != "updates":
                self._writer.add_scalar(name, value, int(record["updates"]))
        return found
