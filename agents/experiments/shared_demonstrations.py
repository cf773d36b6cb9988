"""Demonstrations that several trainings would generate alike: made once, by all workers, and linked."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from agents.configuration import SAC, AgentConfiguration, DemonstrationSource, ImitationConfiguration
from agents.configuration.residual import ResidualConfiguration
from agents.demonstrations import prepare_demonstrations
from agents.experiments.training_task import TrainingTask
from agents.run_folder import DEMONSTRATIONS
from agents.training import is_trained
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.files import temporary_name
from dq_space_arm_env.common.progress import Advance
from experts.demonstrations import DemonstrationsError
from experts.executors import Executor

_MANIFEST = "manifest.json"


class SharedDemonstrations:
    """Gives each run folder the demonstrations that its training would otherwise generate by itself."""

    def __init__(self, executor: Executor, report: Callable[[Advance], None]) -> None:
        self._executor, self._report = executor, report
        self._made: dict[str, Path] = {}

    def provided(self, task: TrainingTask) -> TrainingTask:
        """The task, once its folder exists with its demonstrations."""
        try:
            task.folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return task  # its training fails where it does not see the folder; others may not
        source, place = _generated(task.configuration.resolved()), task.folder / DEMONSTRATIONS
        if source is None:
            return task
        scene = load_scene(task.configuration.scene)
        key = _key(scene, source)
        if is_trained(task.configuration, task.folder):
            self._keep(key, place)
        elif key not in self._made:
            try:
                prepare_demonstrations(source, scene, place, executor=self._executor, progress=self._report)
            except (DemonstrationsError, ValueError):
                return task  # its training fails with this error; others may not
            self._made[key] = place
        elif not place.exists():
            with suppress(OSError):  # its training generates them, or fails likewise; others may not
                _link(self._made[key], place)
        return task

    def remember(self, task: TrainingTask) -> None:
        """Know the demonstrations of a training, if it is finished, for others that need the same."""
        source = _generated(task.configuration.resolved())
        if source is not None and is_trained(task.configuration, task.folder):
            self._keep(_key(load_scene(task.configuration.scene), source), task.folder / DEMONSTRATIONS)

    def _keep(self, key: str, place: Path) -> None:
        if (place / _MANIFEST).is_file():
            self._made.setdefault(key, place)


def _key(scene: Scene, source: DemonstrationSource) -> str:
    return json.dumps([scene.content_hash(), source.model_dump(mode="json")])


def _generated(configuration: AgentConfiguration) -> DemonstrationSource | None:
    """Demonstrations that a training generates; None if it needs none, or takes existing ones."""
    source = None
    if isinstance(configuration, ImitationConfiguration | ResidualConfiguration):
        source = configuration.demonstrations
    else:
        algorithm = getattr(configuration, "algorithm", None)
        if isinstance(algorithm, SAC) and algorithm.demonstrations is not None:
            source = algorithm.demonstrations.source
    return source if source is not None and source.folder is None and source.minari is None else None


def _link(source: Path, target: Path) -> None:
    """Copy a folder in one go; its shards, which nobody changes, by links where the disk has them."""

    def link(here: str, there: str) -> None:
        if here.endswith(".safetensors"):
            try:
                os.link(here, there)
                return
            except OSError:
                pass
        shutil.copy2(here, there)

    temporary = target.with_name(temporary_name(target.name))
    try:
        shutil.copytree(source, temporary, copy_function=link)
        temporary.rename(target)
    except OSError:
        if not target.exists():  # else another run into the same folders was faster
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
