"""The readers of environment and expert, each with good files small enough to be read thousands of times."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line.simulated_episode import read_state
from dq_space_arm_env.environment.reset_options import check_scene
from dq_space_arm_env.interoperability.urdf_import import scene_from_urdf
from dq_space_arm_env.scene import Scene, SceneError, StateLayout, draw_initial_state
from dq_space_arm_env.scene.loading import scenes_directory
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
        parameters=np.zeros((4, 0)),
        metadata={"scene": scene.model_dump(mode="json")},
    )


def written(save: Callable[[Path], Any], folder: Path) -> bytes:
    save(folder / "written")
    content = (folder / "written").read_bytes()
    (folder / "written").unlink()
    return content


def solutions(folder: Path) -> Subject:
    files = {"solution.npz": written(_solution().save, folder)}

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

    files = {"flight.npz": written(flight.save, folder)}
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


def write_demonstrations(made: Path) -> str:
    """Write a folder of two demonstrations of random numbers; return the name of its shard."""
    shard = _shard(small_scene())
    name = f"shards/000000-{hashlib.sha256(shard).hexdigest()}.safetensors"
    (made / "shards").mkdir(parents=True, exist_ok=True)
    (made / name).write_bytes(shard)
    (made / "settings.json").write_text(Settings(small_scene(), 3, 0, 32).to_json())
    (made / "manifest.json").write_text(manifest_text(manifest_of(made / "settings.json", [made / name])))
    return name


def demonstrations(folder: Path, *, verify: bool) -> Subject:
    """A folder; without `verify`, names and manifest are made to fit whatever is in the shard."""
    made = folder / "made"
    name = write_demonstrations(made)
    shard, manifest = (made / name).read_bytes(), (made / "manifest.json").read_bytes()
    digest = hashlib.sha256(shard).hexdigest()
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


SUBJECTS: dict[str, Callable[[Path], Subject]] = {
    "scenes": lambda folder: scenes(),
    "URDF": lambda folder: robots(),
    "solutions": solutions,
    "flights": flights,
    "starts": starts,
    "shards": partial(demonstrations, verify=False),
    "verified demonstrations": partial(demonstrations, verify=True),
}
