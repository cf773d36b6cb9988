"""The folder of a training run: configuration, provenance, learning curve, checkpoints and policy.

| file | content |
|---|---|
| `config.yaml` | the resolved configuration; written first |
| `provenance.json` | commit, versions, machine and hash of the scene of each start of the run, a list |
| `evaluations.jsonl` | the learning curve: a line for each evaluation on validation seeds |
| `checkpoints/<steps>/` | all that resuming takes: model and optimizer, replay buffer, progress; \
of imitation, a folder for each part |
| `demonstrations/` | what was generated to learn from, if anything was |
| `tensorboard/` | curves for TensorBoard |
| `progress.json` | how far the training has come, where it is one of several |
| `best.npz` | of reinforcement: the policy that was best in these evaluations, exported |
| `model.zip`, `policy.npz` | the model at the end, and the policy, exported; written last, in this order |
| `.lock` | empty; locked while a process trains here |

Files and checkpoints are written under a temporary name and renamed: under their own name they are complete.
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from agents.configuration import AgentConfiguration, load_configuration
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json, read_text
from dq_space_arm_env.common.files import (
    differences,
    flush,
    remove_leftovers,
    temporary_name,
    write_atomically,
)
from dq_space_arm_env.common.locks import locked
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.environment.rollouts import Policy, StateFeedback, rollout
from dq_space_arm_env.validation import dump_yaml

CONFIGURATION, PROVENANCE, EVALUATIONS = "config.yaml", "provenance.json", "evaluations.jsonl"
CHECKPOINTS, TENSORBOARD, DEMONSTRATIONS = "checkpoints", "tensorboard", "demonstrations"
BEST, POLICY, MODEL = "best.npz", "policy.npz", "model.zip"
LOCK = ".lock"
VALIDATION_SEED = 1

_HEADER = "# The resolved configuration of this run.\n"
_DIGITS = 12
_PART = ".part"
_POINT = ("environment_steps", "seconds", "success_rate", "median_cost")  # of learning curves
_REMEDY = "repair it, or use another folder"


class RunFolderError(RuntimeError):
    """A folder is for another run, or damaged."""


class DivergedError(RuntimeError):
    """Training diverged: the network yields what is not finite, or flies ever worse."""


@contextmanager
def reserved(path: Path) -> Iterator[None]:
    """Lock a folder against other training processes; the system releases the lock when the process ends."""
    path.mkdir(parents=True, exist_ok=True)
    refusal = RunFolderError(f"another process trains in {path}: wait for it, or use another folder")
    with locked(path / LOCK, refusal):
        remove_leftovers(path)
        yield


class RunFolder:
    """A run's folder at `path`, created or reopened for a configuration.

    Raises `RunFolderError` if it was started with another configuration or another version of the scene, and
    holds something since; what ended before, as a wrong value does, leaves no run.
    """

    def __init__(self, path: Path, configuration: AgentConfiguration) -> None:
        self.path = path
        (path / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
        here = configuration.resolved().model_dump(mode="json", exclude_none=True)
        file, found, has_begun = path / CONFIGURATION, [], self._has_begun()
        if file.exists():
            there = load_configuration(file).resolved().model_dump(mode="json", exclude_none=True)
            found = differences(_identity(there), _identity(here))
            if found and has_begun:
                raise RunFolderError(
                    f"{path} was started with another configuration: {'; '.join(found)}. Use that one, or "
                    "use another folder (--out)"
                )
            before, now = (each.get("schedule", {}).get("total_steps", 0) for each in (there, here))
            if now < before and has_begun:
                raise RunFolderError(
                    f"{path} was started with schedule.total_steps: {before}, which may become larger, not "
                    f"{now}: use another folder (--out)"
                )
        # A configuration only names its scene; the file of that name may have changed.
        scene = load_scene(configuration.scene).content_hash()
        starts = self._starts()
        is_other = any(start.get("scene_hash", scene) != scene for start in starts)
        if is_other and has_begun:
            raise RunFolderError(
                f"{path} was started with another version of scene {configuration.scene!r}: use another "
                "folder (--out)"
            )
        if found or is_other:
            starts = []
        write_atomically(file, dump_yaml(here, _HEADER), durable=True)
        origin = provenance("ruamel.yaml", "sb3-contrib", "stable-baselines3", "torch")
        starts.append({**origin, "scene_hash": scene})
        write_atomically(path / PROVENANCE, json.dumps(starts, indent=2) + "\n")

    def _has_begun(self) -> bool:
        """Whether something was made here that belongs to a configuration and a scene."""
        made = (EVALUATIONS, TENSORBOARD, DEMONSTRATIONS, BEST, POLICY, MODEL)
        return any((self.path / name).exists() for name in made) or any((self.path / CHECKPOINTS).iterdir())

    def _starts(self) -> list[dict[str, Any]]:
        file = self.path / PROVENANCE
        if not file.exists():
            return []
        starts = _parsed(file, _text(file))
        if not isinstance(starts, list) or not all(isinstance(start, dict) for start in starts):
            raise RunFolderError(f"{file} is damaged (it should be a list of mappings): {_REMEDY}")
        return starts

    def metadata(
        self, configuration: AgentConfiguration, scene: Scene, training: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Metadata of a policy trained here: agent, scene, configuration, provenance, and training effort."""
        return {
            "agent": configuration.name,
            "scene": scene.name,
            "scene_hash": scene.content_hash(),
            "configuration": configuration.resolved().model_dump(mode="json", exclude_none=True),
            "provenance": self._starts()[-1],
            "training": dict(training),
        }

    def checkpoint(self) -> Path | None:
        """Folder of the last complete checkpoint, if any."""
        complete = [path for path in (self.path / CHECKPOINTS).iterdir() if _is_complete(path)]
        return max(complete, key=lambda path: int(path.name), default=None)

    def add_checkpoint(self, steps: int, write: Callable[[Path], None]) -> None:
        """Have `write` fill an empty folder, then let it replace the last checkpoint, of fewer steps."""
        folder = self.path / CHECKPOINTS
        final = folder / f"{steps:0{_DIGITS}d}"
        if final.exists():  # to replace it, it would have to be removed first
            return
        temporary = folder / temporary_name(final.name)
        temporary.mkdir()
        write(temporary)
        flush(temporary)
        temporary.rename(final)
        flush(folder)
        for other in folder.iterdir():
            if other != final and (_is_complete(other) or other.suffix == _PART):
                shutil.rmtree(other, ignore_errors=True)

    def evaluations(self, until: int | None = None, names: Sequence[str] = ()) -> list[dict[str, Any]]:
        """Lines of the learning curve, up to a number of environment steps, with numbers of these names."""
        lines = learned(self.path, names)
        return [line for line in lines if until is None or line["environment_steps"] <= until]

    def write_evaluations(self, lines: list[dict[str, Any]]) -> None:
        text = "".join(json.dumps(line) + "\n" for line in lines)
        write_atomically(self.path / EVALUATIONS, text)


def learned(path: Path, names: Sequence[str] = ()) -> list[dict[str, Any]]:
    """The learning curve in a run's folder, its lines in order; RunFolderError if it is damaged.

    Lines have steps, seconds, success and cost; `names` are those of further numbers.
    """
    file, needed = path / EVALUATIONS, (*_POINT, *names)
    return [_point(file, line, needed) for line in _text(file).splitlines()] if file.exists() else []


def validation_seeds(episodes: int) -> list[int]:
    """Seeds of the flights for the learning curve, always the same; evaluation starts are others."""
    return [int(seed) for seed in np.random.SeedSequence(VALIDATION_SEED).generate_state(episodes)]


def starts_alike(scene: Scene) -> bool:
    """Whether all episodes of a scene start alike, since nothing is drawn."""
    return not any(scene.spread.model_dump(exclude={"observed"}).values())


def validate(policy: Policy | StateFeedback, scene: Scene, seeds: Sequence[int]) -> dict[str, float]:
    """Fly a policy for the learning curve: success rate, and medians of cost and final errors (deg, m).

    In scenes with constraints also the share of flights that violate them.
    """
    flights = rollout(policy, scene, seeds)
    shares = flights.constraint_violations
    return {
        "success_rate": float(np.mean(flights.is_success)),
        "median_cost": float(np.median(flights.cost)),
        "attitude_error": float(np.median(flights.attitude_error)),
        "position_error": float(np.median(flights.position_error)),
        **({} if shares is None else {"violating_episodes": float(np.mean(shares > 0.0))}),
    }


def _is_complete(checkpoint: Path) -> bool:
    return re.fullmatch(r"[0-9]{1,20}", checkpoint.name) is not None


def _text(file: Path) -> str:
    try:
        return read_text(file)
    except UnreadableError as error:
        raise RunFolderError(f"{error}: {_REMEDY}") from error


def _parsed(file: Path, text: str) -> Any:
    try:
        return parse_json(text, "JSON")
    except UnreadableError as error:
        raise RunFolderError(f"{file} is damaged ({error}): {_REMEDY}") from error


def _point(file: Path, line: str, needed: Sequence[str]) -> dict[str, Any]:
    """A point of the learning curve."""
    point = _parsed(file, line)
    numbers = [point.get(name) for name in needed] if isinstance(point, dict) else [None]
    if not all(isinstance(number, int | float) for number in numbers):
        raise RunFolderError(
            f"{file} is damaged ({shortened(point)} lacks a number of {', '.join(needed)}): {_REMEDY}"
        )
    return dict(point)


def _identity(configuration: dict[str, Any]) -> dict[str, Any]:
    """A configuration without its description and the length of the training, which may be extended.

    The updates of imitation stay: its learning rates follow from them.
    """
    kept = {name: value for name, value in configuration.items() if name != "description"}
    if "schedule" in kept:
        lengths = ("total_steps", "minutes")
        kept["schedule"] = {name: value for name, value in kept["schedule"].items() if name not in lengths}
    return kept
