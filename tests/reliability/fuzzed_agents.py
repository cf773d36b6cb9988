"""The readers of the agents, and of Minari data sets, each with good files."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env.common.worker_process import WorkerLostError
from dq_space_arm_env.scene import SceneError
from dq_space_arm_env.task.step_report import OBSERVATION_LIMIT
from experts import load_demonstrations
from experts.demonstrations import DemonstrationsError, export_to_minari
from tests.reliability.fuzzed_files import Subject, in_archive, in_hdf5, in_json, in_lines, in_yaml
from tests.reliability.fuzzed_subjects import small_scene, write_demonstrations, written


def policies(folder: Path) -> Subject:
    from agents.policies import ExportedPolicy
    from agents.policies.exported import PolicyFileError

    rng = np.random.default_rng(0)
    sizes, weights = (6, 5, 3), []
    for inputs, outputs in pairwise(sizes):
        weights.append(rng.normal(size=(inputs, outputs)).astype(np.float32))
    policy = ExportedPolicy(
        weights=tuple(weights),
        biases=tuple(np.zeros(size, dtype=np.float32) for size in sizes[1:]),
        activation="silu",
        mean=np.zeros(6),
        scale=np.ones(6),
        action_scale=np.ones(3),
        metadata={"agent": "a", "scene": "paper", "configuration": {"seed": 3}, "list": [1, 2.5]},
    )

    def use(found: ExportedPolicy) -> None:
        for value in (0.0, OBSERVATION_LIMIT, -OBSERVATION_LIMIT):
            with np.errstate(all="raise", under="ignore"):
                action = found(np.full(found.n_observation, value))
            assert (np.abs(action) <= 1.0).all()

    files = {"policy.npz": written(policy.save, folder)}
    mutations = {"policy.npz": (in_archive,)}
    return Subject(
        files, lambda place: ExportedPolicy.load(place / "policy.npz"), (PolicyFileError,), mutations, use=use
    )


def configurations() -> Subject:
    from agents.configuration import ConfigurationError, load_configuration

    root = Path(__file__).parents[2] / "configs" / "agents"
    names = ("ppo.yaml", "sac-with-demonstrations.yaml", "dagger.yaml", "residual.yaml")
    files = {name: (root / name).read_bytes() for name in names}

    def read(place: Path) -> Any:
        changed = [name for name in names if (place / name).read_bytes() != files[name]]
        return [load_configuration(place / name) for name in changed]

    def use(found: Any) -> None:
        for each in found:
            assert load_configuration(json.loads(json.dumps(each.model_dump(exclude_none=True)))) == each

    return Subject(files, read, (ConfigurationError,), dict.fromkeys(names, (in_yaml,)), use=use)


def runs(folder: Path) -> Subject:
    """A run's folder; provenance is not asked for again, as it starts processes."""
    from agents import run_folder
    from agents.configuration import ConfigurationError, load_configuration
    from agents.evaluation.training_runs import learning_curve
    from agents.run_folder import RunFolder, RunFolderError

    configuration = load_configuration("ppo")
    run_folder.provenance = lambda *peers: {"commit": None}
    RunFolder(folder / "run", configuration)
    point = {"environment_steps": 10, "seconds": 1.0, "success_rate": 0.5, "median_cost": 3.0}
    files = {
        "config.yaml": (folder / "run" / "config.yaml").read_bytes(),
        "provenance.json": (folder / "run" / "provenance.json").read_bytes(),
        "evaluations.jsonl": b"".join(json.dumps(point).encode() + b"\n" for _ in range(3)),
    }

    def read(place: Path) -> Any:
        opened = RunFolder(place, configuration)
        curve = opened.evaluations(until=20)
        learning_curve(place / "policy.npz")
        opened.checkpoint()
        return max(((line["success_rate"], -line["median_cost"]) for line in curve), default=None)

    mutations = {
        "config.yaml": (in_yaml,),
        "provenance.json": (in_json,),
        "evaluations.jsonl": (in_lines,),
    }
    kinds = (RunFolderError, ConfigurationError, SceneError)
    return Subject(files, read, kinds, mutations, repair=lambda place: None)


class _Spaces(gymnasium.Env[Any, Any]):
    """Spaces of a model."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (6,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,))


def models(folder: Path) -> Subject:
    """A model of Stable-Baselines3, read without trust."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from agents.zoo.model_archive import ModelArchiveError, read_model

    options = {
        "policy_kwargs": {"net_arch": [8, 8]},
        "n_steps": 4,
        "batch_size": 4,
        "device": "cpu",
        "seed": 0,
    }
    model = PPO("MlpPolicy", _Spaces(), **options)
    model.save(folder / "model.zip")
    files = {"model.zip": (folder / "model.zip").read_bytes()}

    def use(found: Any) -> None:
        with np.errstate(all="ignore"):
            found(np.zeros(found.n_observation))

    return Subject(
        files,
        lambda place: read_model(place / "model.zip"),
        (ModelArchiveError,),
        {"model.zip": (in_archive,)},
        use=use,
    )


def checkpoints(folder: Path) -> Subject:
    """A checkpoint of a learner with a replay buffer."""
    pytest.importorskip("sb3_contrib")
    from agents.configuration import load_configuration
    from agents.reinforcement.checkpoint import Progress, read_checkpoint, write_checkpoint
    from agents.reinforcement.reinforcement_training import make_environment, make_learner
    from agents.run_folder import RunFolderError

    small_scene().to_yaml(folder / "small.yaml")
    configuration = load_configuration(
        {
            "name": "small",
            "scene": str(folder / "small.yaml"),
            "environment": {"copies": 2, "action_repeat": 1},
            "network": {"hidden": [8], "activation": "relu"},
            "algorithm": {"name": "SAC", "batch_size": 4, "learning_starts": 4, "buffer_size": 32},
            "schedule": {"total_steps": 60, "evaluation_episodes": 1},
        }
    )
    environment = make_environment(configuration, small_scene())
    model = make_learner(configuration, environment)
    model.learn(12)
    made = folder / "made"
    made.mkdir()
    write_checkpoint(made, model, Progress(12))
    files = {path.name: path.read_bytes() for path in made.iterdir()}

    def use(found: Progress) -> None:
        with np.errstate(all="ignore"):
            environment.step(np.zeros((2, *environment.action_space.shape)))

    mutations = {"learner.pth": (in_archive,), "arrays.npz": (in_archive,), "state.json": (in_json,)}
    return Subject(files, lambda place: read_checkpoint(place, model), (RunFolderError,), mutations, use=use)


class _Fork:
    """What a worker process does, in a fork, which starts sooner."""

    def __init__(self, *, quiet: bool) -> None:
        self.close = lambda: None

    def assign(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._read, write = os.pipe()
        self._pid = os.fork()
        if self._pid:
            os.close(write)
            return
        status = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            with os.fdopen(write, "wb") as answer:
                try:
                    pickle.dump((function(*arguments), None), answer)
                except Exception as error:
                    pickle.dump((None, error), answer)
            status = 0
        finally:
            os._exit(status)

    def answer(self) -> Any:
        with os.fdopen(self._read, "rb") as pipe:
            content = pipe.read()
        _, status = os.waitpid(self._pid, 0)
        if status:
            raise WorkerLostError
        found, error = pickle.loads(content)
        if error is not None:
            raise error
        return found


def minari_data_sets(folder: Path) -> Subject:
    """Metadata and HDF5 of a data set, read as training does."""
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    from agents import minari_reading

    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    write_demonstrations(folder / "made")
    export_to_minari(load_demonstrations(folder / "made"), "a-v0")
    minari_reading.WorkerProcess = _Fork
    place = folder / "minari" / "a-v0" / "data"
    files = {f"a-v0/data/{path.name}": path.read_bytes() for path in place.iterdir()}

    def read(place: Path) -> Any:
        os.environ["MINARI_DATASETS_PATH"] = str(place)
        shutil.rmtree(place / "copy", ignore_errors=True)
        return minari_reading.read_from_minari("a-v0", place / "copy")

    def use(found: Any) -> None:
        assert len(list(found)) == len(found) > 0

    mutations = {"a-v0/data/metadata.json": (in_json,), "a-v0/data/main_data.hdf5": (in_hdf5,)}
    return Subject(files, read, (DemonstrationsError,), mutations, use=use)


AGENTS: dict[str, Callable[[Path], Subject]] = {
    "policies": policies,
    "agents' configurations": lambda folder: configurations(),
    "run folders": runs,
    "checkpoints": checkpoints,
    "Stable-Baselines3 models": models,
    "Minari data sets": minari_data_sets,
}
