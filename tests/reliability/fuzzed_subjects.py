"""The readers of this project, each with good files small enough to be read thousands of times."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line.simulated_episode import read_state
from dq_space_arm_env.environment.reset_options import check_scene
from dq_space_arm_env.interoperability.urdf_import import scene_from_urdf
from dq_space_arm_env.scene import Scene, SceneError, StateLayout, draw_initial_state
from dq_space_arm_env.scene.loading import scenes_directory
from dq_space_arm_env.task.step_report import OBSERVATION_LIMIT
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.replay import replay_page
from experts import Solution, load_demonstrations
from experts.ddp.solution import HISTORY_DTYPE, StopReason
from experts.demonstrations import DemonstrationsError
from experts.demonstrations.facts import read_log
from experts.demonstrations.folder import manifest_of, manifest_text
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import FAILURES, NOTES
from experts.demonstrations.tensors import pack
from tests.reliability.fuzzed_files import (
    Subject,
    in_archive,
    in_json,
    in_lines,
    in_tensors,
    in_xml,
    in_yaml,
)

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"><inertial><origin xyz="0 0 0.1" rpy="0 0.1 0"/><mass value="40"/>
    <inertia ixx="3" ixy="0.1" ixz="0" iyy="3" iyz="0" izz="2"/></inertial></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0.3 0 0.2" rpy="0 1 0"/><axis xyz="0 1 0"/>
    <limit effort="5" lower="-1" upper="2" velocity="1"/><dynamics damping="0.1"/></joint>
  <link name="arm"><inertial><mass value="4"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <joint name="j2" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="0 0 0.5"/></joint>
  <link name="hand"/>
</robot>
"""


def small_scene() -> Scene:
    """A planar scene of three steps."""
    return load_scene("planar").replace(name="small", simulation={"dt": 0.1, "steps": 3})


def use_scene(scene: Scene) -> None:
    """What all users of a scene do before they compile it."""
    layout = StateLayout.of(scene)
    check_scene(scene)
    assert np.isfinite(draw_initial_state(scene, np.random.default_rng(0))).all()
    assert np.isfinite(layout.control_weight).all()
    assert load_scene(json.loads(json.dumps(scene.model_dump()))).content_hash() == scene.content_hash()
    scene.to_yaml().encode()


def scenes() -> Subject:
    name = "six-joint.yaml"
    files = {name: (scenes_directory() / name).read_bytes()}
    kinds = (SceneError, ValueError)  # of the environment, which limits starts and lengths
    return Subject(files, lambda folder: load_scene(folder / name), kinds, {name: (in_yaml,)}, use=use_scene)


def robots() -> Subject:
    def read(folder: Path) -> Scene:
        return scene_from_urdf(folder / "robot.urdf", "hand")

    kinds = (SceneError, ValueError)
    return Subject({"robot.urdf": URDF.encode()}, read, kinds, {"robot.urdf": (in_xml,)}, use=use_scene)


def _solution() -> Solution:
    scene, rng = small_scene(), np.random.default_rng(0)
    layout = StateLayout.of(scene)
    return Solution(
        states=rng.normal(size=(4, layout.n_x)),
        controls=rng.normal(size=(3, layout.n_u)),
        feedback_gains=rng.normal(size=(3, layout.n_u, layout.n_t)),
        cost=3.5,
        stop_reason=StopReason.CONVERGED,
        message="converged",
        optimality=1e-9,
        iterations=2,
        history=np.zeros(2, dtype=HISTORY_DTYPE),
        metadata={"scene": scene.model_dump(mode="json"), "emphasis": 1.0},
    )


def _written(save: Callable[[Path], Any], folder: Path) -> bytes:
    save(folder / "written")
    content = (folder / "written").read_bytes()
    (folder / "written").unlink()
    return content


def solutions(folder: Path) -> Subject:
    files = {"solution.npz": _written(_solution().save, folder)}

    def read(place: Path) -> Any:
        Trajectory.load(place / "solution.npz")  # as a flight, too
        return Solution.load(place / "solution.npz")

    return Subject(files, read, (ValueError,), {"solution.npz": (in_archive,)})


def flights(folder: Path) -> Subject:
    scene, rng = small_scene(), np.random.default_rng(0)
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (4, 1))
    flight = Trajectory(
        "flight",
        states,
        rng.normal(size=(3, layout.n_u)),
        noise=rng.normal(size=(3, layout.n_u)),
        rewards=rng.normal(size=3),
        target=np.array(scene.target.pose.dual_quaternion),
        scene=scene,
        seed=3,
        attitude_error=1.0,
    )

    def use(found: Trajectory) -> None:
        _ = found.cost, found.facts()
        if found.scene is not None:
            replay_page([found], found.scene)

    files = {"flight.npz": _written(flight.save, folder)}
    mutations = {"flight.npz": (in_archive,)}
    return Subject(
        files, lambda place: Trajectory.load(place / "flight.npz"), (ValueError,), mutations, use=use
    )


def starts(folder: Path) -> Subject:
    state = np.arange(4.0)
    stream, archive = io.BytesIO(), io.BytesIO()
    np.save(stream, state)
    np.savez(archive, states=state[None])
    files = {"start.json": b"[1, 2.5, 3, 4]", "start.npy": stream.getvalue(), "start.npz": archive.getvalue()}

    def read(place: Path) -> Any:
        return [read_state(str(place / name), 4) for name in files]

    mutations = {"start.json": (in_json,), "start.npz": (in_archive,)}
    return Subject(files, read, (ValueError,), mutations)


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

    files = {"policy.npz": _written(policy.save, folder)}
    mutations = {"policy.npz": (in_archive,)}
    return Subject(
        files, lambda place: ExportedPolicy.load(place / "policy.npz"), (PolicyFileError,), mutations, use=use
    )


def _shard(scene: Scene) -> bytes:
    layout, n, count = StateLayout.of(scene), scene.simulation.steps, 2
    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "states": rng.normal(size=(count, n + 1, layout.n_x)),
        "observations": rng.normal(size=(count, n + 1, layout.n_x + 1)),
        "actions": rng.uniform(-1.0, 1.0, size=(count, n, layout.n_u)),
        "rewards": rng.normal(size=(count, n)),
        "feedback_gains": rng.normal(size=(count, n, layout.n_u, layout.n_t)).astype(np.float32),
        "index": np.arange(count),
        "seed": np.arange(count),
        "cost": rng.normal(size=count),
        "iterations": np.ones(count, dtype=np.int64),
        "stop_reason": np.zeros(count, dtype=np.uint8),
        "guess": np.zeros(count, dtype=np.uint8),
        "emphasis": np.ones(count),
        "start_errors": np.ones((count, 2)),
        "final_errors": np.ones((count, 2)),
        "clamped_share": np.zeros(count),
    }
    failures = (
        np.array([2]),
        np.array([2]),
        np.ones(1, dtype=np.uint8),
        np.ones(1),
        np.zeros((1, layout.n_x)),
        np.ones((1, 2)),
    )
    arrays |= {f"failures.{name}": array for name, array in zip(FAILURES, failures, strict=True)}
    return pack(arrays, NOTES)


def demonstrations(folder: Path, *, verify: bool) -> Subject:
    """A folder; without `verify`, names and manifest are made to fit whatever is in the shard."""
    shard = _shard(small_scene())
    digest = hashlib.sha256(shard).hexdigest()
    name = f"shards/000000-{digest}.safetensors"
    made = folder / "made"
    (made / "shards").mkdir(parents=True, exist_ok=True)
    (made / name).write_bytes(shard)
    (made / "settings.json").write_text(Settings(small_scene(), 3, 0, 32).to_json())
    manifest = manifest_text(manifest_of(made / "settings.json", [made / name])).encode()
    entry = {"host": "h", "shard": 0, "seconds": {"solves": 1.0}, "solve_seconds": [0.5, 0.5]}
    run = {"run": {"machine": {"processor_name": "p"}}, "host": "h"}
    log = b"".join(json.dumps(line).encode() + b"\n" for line in (run, entry))
    files = {
        name: shard,
        "settings.json": (made / "settings.json").read_bytes(),
        "manifest.json": manifest,
        "log/part-1-of-1.jsonl": log,
    }

    def read(place: Path) -> Any:
        return load_demonstrations(place, verify=verify)

    def repair(place: Path) -> None:
        content = (place / name).read_bytes()
        if verify or content == shard:
            return
        for other in (place / "shards").iterdir():
            other.unlink()
        actual = hashlib.sha256(content).hexdigest()
        (place / "shards" / f"000000-{actual}.safetensors").write_bytes(content)
        text = (
            manifest.decode()
            .replace(digest, actual)
            .replace(f'"bytes": {len(shard)}', f'"bytes": {len(content)}')
        )
        (place / "manifest.json").write_text(text)

    def use(found: Any) -> None:
        if verify:  # nothing but the log may have changed
            assert found.manifest == json.loads(manifest)
        read_log(found)
        _ = [found[position] for position in range(len(found))], found.column("cost"), found.failures()
        _ = list(found.batches(2, seed=0)), found.split(0.5)

    mutations = {
        name: (in_tensors,),
        "settings.json": (in_json,),
        "manifest.json": (in_json,),
        "log/part-1-of-1.jsonl": (in_lines,),
    }
    return Subject(files, read, (DemonstrationsError,), mutations, repair, use)


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


SUBJECTS: dict[str, Callable[[Path], Subject]] = {
    "scenes": lambda folder: scenes(),
    "URDF": lambda folder: robots(),
    "solutions": solutions,
    "flights": flights,
    "starts": starts,
    "policies": policies,
    "shards": partial(demonstrations, verify=False),
    "verified demonstrations": partial(demonstrations, verify=True),
    "agents' configurations": lambda folder: configurations(),
    "run folders": runs,
    "Stable-Baselines3 models": models,
}
