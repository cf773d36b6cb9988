"""One training of many: what a process of this machine or of a cluster needs to know, and what it gives."""

from __future__ import annotations

import json
import math
import platform
import traceback
import warnings
from contextlib import chdir, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from agents.configuration import AgentConfiguration
from agents.evaluation.planned_flights import agents_source
from agents.run_folder import CONFIGURATION, EVALUATIONS, LOCK, DivergedError, RunFolderError, learned
from agents.training import is_trained, train
from dq_space_arm_env import DQSpaceArmVectorEnv, SceneError, load_scene
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.locks import locked
from dq_space_arm_env.common.progress import Advance, Status
from dq_space_arm_env.common.tables import Row
from experts.demonstrations import DemonstrationsError
from experts.demonstrations.settings import software

TRAINED, PRUNED, FAILED = "trained", "pruned", "failed"
"""Outcomes of a training; pruned ones were stopped early because others were better."""
PROGRESS = "progress.json"
"""File in a run folder, how far the training has come."""
PRUNE = "prune"
"""File in a run folder, whose existence stops the training."""
BETWEEN_NOTES, PATIENCE = 1.0, 10.0  # s
_PACKAGES = ("sb3-contrib", "stable-baselines3", "torch")
_EXPECTED = (DemonstrationsError, DivergedError, OSError, RunFolderError, ValueError)
_MEASURED = ("success_rate", "median_cost", "violating_episodes", "environment_steps", "seconds")


class _Pruned(Exception):  # noqa: N818 - an event, not a mistake
    """A training is stopped because others are better."""


class TrainingTask(NamedTuple):
    """A training in a folder, which all machines have to see under the same path."""

    configuration: AgentConfiguration
    folder: Path  # absolute
    place: Path  # working directory, which paths in the configuration are relative to

    @property
    def label(self) -> str:
        return f"{self.configuration.name}, seed {self.configuration.seed}"

    def prepare(self) -> None:
        """Compile the environment."""
        with suppress(OSError, SceneError), chdir(self.place):  # `run` says it
            scene = load_scene(self.configuration.scene)
            DQSpaceArmVectorEnv(1, scene).reset(seed=0)

    def run(self) -> Row:
        """Train, or find the trained policy.

        An error is a result: the other trainings do not depend on this one. ImportError is raised.
        """
        try:
            if self.folder.is_file():
                raise RunFolderError(f"{self.folder} is a file, it should be a folder: rename it")
            if not self.folder.is_dir() or not self.place.is_dir():
                raise RunFolderError(
                    f"machine {platform.node()} does not see {self.folder} and {self.place}: trainings on a "
                    "cluster need a file system that all of its machines share"
                )
            with chdir(self.place):
                if not is_trained(self.configuration, self.folder):
                    self._train()
            if not learned(self.folder):
                raise RunFolderError(f"{self.folder / EVALUATIONS} is missing: train in another folder")
            return self.row(TRAINED)
        except _Pruned:
            return self.row(PRUNED)
        except ImportError:
            raise  # an extra is not installed: the others would fail likewise
        except _EXPECTED as error:
            return self.row(FAILED, failure=str(error))
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
            return self.row(FAILED, failure=found, traceback=traceback.format_exc())

    def lost(self, sentence: str) -> Row:
        """Give up this training; its last checkpoint remains."""
        return self.row(FAILED, failure=sentence)

    @staticmethod
    def software() -> dict[str, Any]:
        """Identify the code that trainings follow from."""
        found = software()
        for package in _PACKAGES:
            with suppress(PackageNotFoundError):
                found["versions"][package] = version(package)
        return {**found, "agents": agents_source((".",))}

    def progress(self) -> Status:
        """How far the training has come, as it was noted."""
        try:
            found = read_mapping(self.folder / PROGRESS)
            return Status(int(found["done"]), int(found["total"]), str(found["line"]))
        except (UnreadableError, KeyError, TypeError, ValueError):
            return Status(0, 1, "not begun")

    def row(self, outcome: str, **facts: Any) -> Row:
        """The row of a table: outcome, and the last point of the learning curve."""
        with suppress(RunFolderError):
            points = learned(self.folder) if (self.folder / CONFIGURATION).is_file() else []
            facts |= {name: points[-1].get(name) for name in _MEASURED} if points else {}
        return {
            "agent": self.configuration.name,
            "seed": self.configuration.seed,
            "outcome": outcome,
            **dict.fromkeys(_MEASURED),
            **facts,
            "folder": str(self.folder),
        }

    def _train(self) -> None:
        last = -math.inf

        def report(advance: Advance) -> None:
            nonlocal last
            if monotonic() - last < BETWEEN_NOTES:
                return
            last = monotonic()
            if (self.folder / PRUNE).exists():
                raise _Pruned
            note = {"done": advance.done, "total": advance.total, "line": advance.describe()}
            with suppress(OSError):  # a full disk ends the training where it matters
                write_atomically(self.folder / PROGRESS, json.dumps(note))

        # The worker of a killed run notices within seconds that nobody waits for it.
        refusal = RunFolderError(
            f"another process trains in {self.folder}: wait for it, or use another folder"
        )
        with locked(self.folder / LOCK, refusal, seconds=PATIENCE):
            pass
        with warnings.catch_warnings():  # told once, where the trainings were asked for
            warnings.filterwarnings("ignore", "scene .* has no spread")
            train(self.configuration, self.folder, report=report)
        (self.folder / PROGRESS).unlink(missing_ok=True)
