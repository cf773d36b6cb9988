"""The folder of a training run: what it is for, how far it has come, and what came of it.

| file | content |
|---|---|
| `config.yaml` | the resolved configuration; written first |
| `provenance.json` | commit, versions and machine of each start of the run, a list |
| `evaluations.jsonl` | the learning curve: a line for each evaluation on validation seeds |
| `checkpoints/<steps>/` | all that the run needs to go on: model and optimizer, replay buffer, progress; \
of imitation, a folder for each part |
| `demonstrations/` | what was generated to learn from, if anything was |
| `tensorboard/` | curves for TensorBoard |
| `best.npz` | the policy that was best in these evaluations, exported |
| `policy.npz`, `model.zip` | the policy at the end, exported, and the model; written last |

Files and checkpoints are written under another name and renamed: what has its proper name is whole.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.configuration import AgentConfiguration, load_configuration
from dq_space_arm_env.validation import dump_yaml
from experts.demonstrations.settings import differences
from experts.files import write_atomically
from experts.report.provenance import provenance

CONFIGURATION, PROVENANCE, EVALUATIONS = "config.yaml", "provenance.json", "evaluations.jsonl"
CHECKPOINTS, TENSORBOARD, DEMONSTRATIONS = "checkpoints", "tensorboard", "demonstrations"
BEST, POLICY, MODEL = "best.npz", "policy.npz", "model.zip"

_HEADER = "# The resolved configuration of this run.\n"
_DIGITS = 12


class RunFolderError(RuntimeError):
    """A folder is for another run, or damaged."""


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
            RunFolderError: If it is for another configuration.
            OSError: If it cannot be written.
        """
        self.path = path
        (path / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
        here = configuration.model_dump(mode="json", exclude_none=True)
        file = path / CONFIGURATION
        if file.exists():
            there = load_configuration(file).model_dump(mode="json", exclude_none=True)
            # A run may be given more time than it was begun with; all else would make it another one.
            found = differences(_without_budget(there), _without_budget(here))
            if found:
                raise RunFolderError(
                    f"{path} was begun with another configuration: {'; '.join(found)}. Repeat it, or take "
                    "another folder"
                )
        write_atomically(file, dump_yaml(here, _HEADER), durable=True)
        self._add_provenance()

    def _add_provenance(self) -> None:
        file = self.path / PROVENANCE
        starts = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
        starts.append(provenance("pyyaml", "sb3-contrib", "stable-baselines3", "torch"))
        write_atomically(file, json.dumps(starts, indent=2) + "\n")

    @property
    def provenance(self) -> dict[str, Any]:
        """Commit, versions and machine of the present start."""
        starts = json.loads((self.path / PROVENANCE).read_text(encoding="utf-8"))
        return dict(starts[-1])

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
        temporary = folder / f".{os.getpid()}.part"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        write(temporary)
        final = folder / f"{steps:0{_DIGITS}d}"
        shutil.rmtree(final, ignore_errors=True)
        temporary.rename(final)
        for other in folder.iterdir():
            if other != final:
                shutil.rmtree(other, ignore_errors=True)

    def evaluations(self, until: int | None = None) -> list[dict[str, Any]]:
        """Read the learning curve.

        Args:
            until: Environment steps beyond which lines are left out; None for all.

        Returns:
            The lines.
        """
        file = self.path / EVALUATIONS
        if not file.exists():
            return []
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        return [line for line in lines if until is None or line["environment_steps"] <= until]

    def write_evaluations(self, lines: list[dict[str, Any]]) -> None:
        """Write the learning curve.

        Args:
            lines: JSON values.
        """
        text = "".join(json.dumps(line) + "\n" for line in lines)
        write_atomically(self.path / EVALUATIONS, text)


def _without_budget(configuration: dict[str, Any]) -> dict[str, Any]:
    """All but how long the training is; of imitation, whose learning rates follow from that, all."""
    if "schedule" not in configuration:
        return configuration
    schedule = {
        name: value
        for name, value in configuration["schedule"].items()
        if name not in ("total_steps", "minutes")
    }
    return configuration | {"schedule": schedule}
