"""The folder of a training run: what it is for, how far it has come, and what came of it.

| file | content |
|---|---|
| `config.yaml` | the resolved configuration; written first |
| `provenance.json` | commit, versions, machine and hash of the scene of each start of the run, a list |
| `evaluations.jsonl` | the learning curve: a line for each evaluation on validation seeds |
| `checkpoints/<steps>/` | all that the run needs to go on: model and optimizer, replay buffer, progress; \
of imitation, a folder for each part |
| `demonstrations/` | what was generated to learn from, if anything was |
| `tensorboard/` | curves for TensorBoard |
| `best.npz` | of reinforcement: the policy that was best in these evaluations, exported |
| `policy.npz`, `model.zip` | the policy at the end, exported, and the model; written last |
| `.lock` | empty; locked while a process trains here |

Files and checkpoints are written under another name and renamed: what has its proper name is whole.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from agents.configuration import AgentConfiguration, load_configuration
from dq_space_arm_env import load_scene
from dq_space_arm_env.validation import dump_yaml
from experts.demonstrations.settings import differences
from experts.files import write_atomically
from experts.report.provenance import provenance

CONFIGURATION, PROVENANCE, EVALUATIONS = "config.yaml", "provenance.json", "evaluations.jsonl"
CHECKPOINTS, TENSORBOARD, DEMONSTRATIONS = "checkpoints", "tensorboard", "demonstrations"
BEST, POLICY, MODEL = "best.npz", "policy.npz", "model.zip"

LOCK = ".lock"

_HEADER = "# The resolved configuration of this run.\n"
_DIGITS = 12
_PART = ".part"


class RunFolderError(RuntimeError):
    """A folder is for another run, or damaged."""


@contextmanager
def reserved(path: Path) -> Iterator[None]:
    """Keep other processes from training in a folder inside a `with` block.

    The system releases the lock when the process ends, however it does.

    Args:
        path: The folder; made if it does not exist.

    Raises:
        RunFolderError: If another process trains there.
        OSError: If it cannot be written.
    """
    path.mkdir(parents=True, exist_ok=True)
    with (path / LOCK).open("w") as file:
        try:
            # Not flock, whose lock would live on in the forked workers of a killed process.
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            raise RunFolderError(
                f"another process trains in {path}: wait for it, or take another folder"
            ) from error
        yield


class RunFolder:
    """A folder that a run writes into.

    Attributes:
        path: Where it is.
    """

    def __init__(self, path: Path, configuration: AgentConfiguration) -> None:
        """Make or find the folder.

        Args:
            path: Where it is, or will be.
            configuration: What it is for.

        Raises:
            RunFolderError: If it is for another configuration, its scene was another one, or a file of it is
                damaged.
            SceneError: If the scene cannot be loaded.
            OSError: If it cannot be written.
        """
        self.path = path
        (path / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
        here = configuration.model_dump(mode="json", exclude_none=True)
        file = path / CONFIGURATION
        if file.exists():
            there = load_configuration(file).model_dump(mode="json", exclude_none=True)
            # A run may be given more time than it was begun with; all else would make it another one.
            found = differences(_deciding(there), _deciding(here))
            if found:
                raise RunFolderError(
                    f"{path} was begun with another configuration: {'; '.join(found)}. Repeat it, or take "
                    "another folder"
                )
        # A configuration names its scene, and what lies in a file of that name may have changed.
        scene = load_scene(configuration.scene).content_hash()
        starts = self._starts()
        if any(start.get("scene_hash", scene) != scene for start in starts):
            raise RunFolderError(
                f"{path} was begun with another version of scene {configuration.scene!r}: take another folder"
            )
        write_atomically(file, dump_yaml(here, _HEADER), durable=True)
        origin = provenance("pyyaml", "sb3-contrib", "stable-baselines3", "torch")
        starts.append({**origin, "scene_hash": scene})
        write_atomically(path / PROVENANCE, json.dumps(starts, indent=2) + "\n")

    def _starts(self) -> list[dict[str, Any]]:
        file = self.path / PROVENANCE
        return list(_parsed(file, file.read_text(encoding="utf-8"))) if file.exists() else []

    @property
    def provenance(self) -> dict[str, Any]:
        """Commit, versions, machine and hash of the scene of the present start."""
        return self._starts()[-1]

    def checkpoint(self) -> Path | None:
        """Find the last whole checkpoint.

        Returns:
            Its folder, or None if there is none.
        """
        whole = [path for path in (self.path / CHECKPOINTS).iterdir() if path.name.isdigit()]
        return max(whole, key=lambda path: int(path.name), default=None)

    def add_checkpoint(self, steps: int, write: Callable[[Path], None]) -> None:
        """Write a checkpoint, and remove older ones.

        Args:
            steps: Environment steps at which it is.
            write: Writes the files into an empty folder.

        Raises:
            OSError: If that is impossible; the last checkpoint is still there.
        """
        folder = self.path / CHECKPOINTS
        temporary = folder / f".{os.getpid()}{_PART}"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        write(temporary)
        final = folder / f"{steps:0{_DIGITS}d}"
        shutil.rmtree(final, ignore_errors=True)
        temporary.rename(final)
        for other in folder.iterdir():
            if other != final and (other.name.isdigit() or other.suffix == _PART):
                shutil.rmtree(other, ignore_errors=True)

    def evaluations(self, until: int | None = None) -> list[dict[str, Any]]:
        """Read the learning curve.

        Args:
            until: Environment steps beyond which lines are left out; None for all.

        Returns:
            The lines.

        Raises:
            RunFolderError: If the file is damaged.
        """
        file = self.path / EVALUATIONS
        if not file.exists():
            return []
        lines = [_parsed(file, line) for line in file.read_text(encoding="utf-8").splitlines()]
        return [line for line in lines if until is None or line["environment_steps"] <= until]

    def write_evaluations(self, lines: list[dict[str, Any]]) -> None:
        """Write the learning curve.

        Args:
            lines: JSON values.
        """
        text = "".join(json.dumps(line) + "\n" for line in lines)
        write_atomically(self.path / EVALUATIONS, text)


def _parsed(file: Path, text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise RunFolderError(f"{file} is damaged ({error}): mend it, or take another folder") from error


def _deciding(configuration: dict[str, Any]) -> dict[str, Any]:
    """All but the description, and how long the training is; imitation's learning rates follow from that."""
    configuration = {name: value for name, value in configuration.items() if name != "description"}
    if "schedule" not in configuration:
        return configuration
    schedule = {
        name: value
        for name, value in configuration["schedule"].items()
        if name not in ("total_steps", "minutes")
    }
    return configuration | {"schedule": schedule}
