"""Read demonstrations from a Minari data set, as `demonstrations export` writes them, into a folder.

The files are read without Minari: it makes the environment that a data set names, whatever that is, where
the data set lacks a space. HDF5 may crash on a damaged file: a process of its own reads it.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.common.bounded_reading import (
    ANY_SIZE,
    UnreadableError,
    open_regular,
    parse_json,
    read_mapping,
    read_text,
    reason_of,
)
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.worker_process import WorkerLostError, WorkerProcess
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.task.step_report import n_observations
from experts.ddp.solution import StopReason
from experts.demonstrations import Demonstrations, DemonstrationsError, load_demonstrations
from experts.demonstrations.folder import MANIFEST, SETTINGS, SHARDS, manifest_of, manifest_text
from experts.demonstrations.minari_export import MINARI_MISSING, check_dataset_id
from experts.demonstrations.outcomes import GUESSES, REASONS
from experts.demonstrations.settings import FORMAT, SHARD_SIZE
from experts.demonstrations.shard import NOTES, PARAMETERS
from experts.demonstrations.tensors import pack

GAINS = "feedback_gains"
Shapes = dict[str, tuple[int, ...]]
_CHUNK = 2**26  # bytes of an array that HDF5 unpacks at a time


def read_from_minari(dataset_id: str, folder: Path) -> Demonstrations:
    """Copy a Minari data set of demonstrations into a folder, unless it is there already.

    Gains are zero if the data set was exported without them; the weight on the final pose, which Minari does
    not keep, is NaN.
    """
    place = _place(dataset_id)
    with _damage_named(dataset_id):
        settings, count = _settings(place, dataset_id)
    text = json.dumps(settings, indent=2) + "\n"
    if (folder / MANIFEST).is_file():
        if read_text(folder / SETTINGS) != text:
            raise DemonstrationsError(f"{folder} holds other demonstrations: use another folder")
        return load_demonstrations(folder, verify=True)
    shutil.rmtree(folder / SHARDS, ignore_errors=True)  # of an interrupted run
    (folder / SHARDS).mkdir(parents=True)
    kernels = Demonstrations(folder, settings, {"shards": [], "demonstrations": 0}).kernels
    shapes = _shapes(kernels), (*kernels.parameters.moving, *kernels.parameters.staged)
    paths = []
    with closing(WorkerProcess(quiet=True)) as worker:
        for number, first in enumerate(range(0, count, SHARD_SIZE)):
            episodes = range(first, min(first + SHARD_SIZE, count))
            worker.assign(packed_episodes, place / "main_data.hdf5", episodes, *shapes)
            with _damage_named(dataset_id):
                content = worker.answer()
            name = f"{number:06d}-{hashlib.sha256(content).hexdigest()}.safetensors"
            paths.append(folder / SHARDS / name)
            write_atomically(paths[-1], content)
    write_atomically(folder / SETTINGS, text)
    write_atomically(folder / MANIFEST, manifest_text(manifest_of(folder / SETTINGS, paths)))
    return load_demonstrations(folder)


@contextmanager
def _damage_named(dataset_id: str) -> Iterator[None]:
    """Turn what damaged metadata and HDF5 files raise into a sentence."""
    try:
        yield
    except DemonstrationsError:
        raise
    except Exception as error:  # damaged bytes make HDF5 raise anything
        reason = "HDF5 crashes on it" if isinstance(error, WorkerLostError) else reason_of(error)
        raise DemonstrationsError(
            f"the Minari data set {dataset_id} is damaged ({reason}): export or download it again"
        ) from error


def _place(dataset_id: str) -> Path:
    """Folder of a data set's files."""
    try:
        import h5py  # noqa: F401
        from minari.storage import get_dataset_path
    except ModuleNotFoundError as error:
        raise DemonstrationsError(MINARI_MISSING.format(error.name)) from error
    try:
        check_dataset_id(dataset_id)
    except ValueError as error:
        raise DemonstrationsError(str(error)) from error
    place = Path(get_dataset_path(dataset_id)) / "data"
    if not place.is_dir():
        raise DemonstrationsError(f"Minari has no data set {dataset_id} here: {place} is no folder")
    return place


def _settings(place: Path, dataset_id: str) -> tuple[dict[str, Any], int]:
    """Settings of the demonstrations, from the data set's metadata, and their number."""
    metadata = read_mapping(place / "metadata.json")
    noted, count = metadata.get("demonstrations"), metadata.get("total_episodes")
    made = parse_json(str(metadata.get("env_spec", "{}")), "env_spec")
    if not isinstance(noted, dict) or not isinstance(made, dict) or "scene" not in made.get("kwargs", {}):
        raise DemonstrationsError(
            f"the Minari data set {dataset_id} holds no demonstrations: it was not written by "
            "`dq-space-arm demonstrations export`"
        )
    if not isinstance(count, int) or not 0 < count < 2**31:
        raise UnreadableError(f"total_episodes: {shortened(count)}, should be a positive number")
    resolved = Scene.model_validate(made["kwargs"]["scene"]).model_dump(mode="json", exclude_none=True)
    return {**noted, "format": FORMAT, "scene": resolved, "minari": dataset_id}, count


def _shapes(kernels: Kernels) -> Shapes:
    """Shapes of an episode's arrays: what is not of them is not read."""
    n, n_u = kernels.scene.simulation.steps, kernels.n_u
    varied = {f"infos/{PARAMETERS}": (n + 1, kernels.n_p)} if kernels.n_p else {}
    return {
        **varied,
        "observations": (n + 1, n_observations(kernels.scene)),
        "actions": (n, n_u),
        "rewards": (n,),
        "infos/state": (n + 1, kernels.n_x),
        f"infos/{GAINS}": (n + 1, n_u, kernels.n_t),
    }


def packed_episodes(path: Path, episodes: Sequence[int], shapes: Shapes, moving: tuple[int, ...]) -> bytes:
    """Read episodes of an HDF5 file, and pack them as a shard, see `experts.demonstrations.shard`.

    The parameters `moving` change from row to row; those of the first row are kept.
    """
    import h5py

    open_regular(path, ANY_SIZE).close()
    with h5py.File(path, "r") as file:
        groups = [_member(file, f"episode_{episode}", h5py.Group) for episode in episodes]
        facts = [dict(group.attrs) for group in groups]
        arrays = {
            name: np.array([_array(group, name, shape) for group in groups])
            for name, shape in shapes.items()
            if name != f"infos/{GAINS}" or GAINS in _member(groups[0], "infos", h5py.Group)
        }
    count, (_, n_x) = len(facts), shapes["infos/state"]
    gains = arrays.pop(f"infos/{GAINS}", np.zeros((count, *shapes[f"infos/{GAINS}"])))
    errors = {
        f"{when}_errors": np.array(
            [[_number(each, f"{when}_{what}_error") for what in ("attitude", "position")] for each in facts]
        )
        for when in ("start", "final")
    }
    content = {
        "states": arrays.pop("infos/state"),
        **_varied(arrays.pop(f"infos/{PARAMETERS}", None), moving),
        **arrays,
        GAINS: gains[:, :-1].astype(np.float32),
        "index": np.array([_number(each, "problem") for each in facts], dtype=np.int64),
        "seed": np.array([_number(each, "seed") for each in facts], dtype=np.int64),
        "cost": np.array([_number(each, "cost") for each in facts], dtype=np.float64),
        "iterations": np.array([_number(each, "iterations") for each in facts], dtype=np.int64),
        "stop_reason": np.full(count, REASONS.index(StopReason.CONVERGED.value), dtype=np.uint8),
        "guess": np.array([GUESSES.index(each["guess"]) for each in facts], dtype=np.uint8),
        **errors,
        "clamped_share": np.array([_number(each, "clamped_share") for each in facts], dtype=np.float64),
        **_no_failures(n_x),
    }
    return pack(content, NOTES)


def _member(group: Any, name: str, kind: type) -> Any:
    """A member of a group that lies in the same file; HDF5 has links to others."""
    import h5py

    for part in name.split("/"):
        if not isinstance(group.get(part, getlink=True), h5py.HardLink):
            raise UnreadableError(f"{group.name}: has no {part}")
        group = group[part]
    if not isinstance(group, kind):
        raise UnreadableError(f"{group.name}: should be a {kind.__name__.lower()}")
    return group


def _array(episode: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """A finite array, if it has its shape before it is unpacked, and its numbers are in the file."""
    import h5py

    found = _member(episode, name, h5py.Dataset)
    if found.shape != shape or found.dtype.kind not in "fiu" or found.is_virtual or found.external:
        raise UnreadableError(f"{found.name}: is {found.dtype} of shape {found.shape}, should be {shape}")
    if math.prod(found.chunks or ()) * found.dtype.itemsize > _CHUNK:
        raise UnreadableError(f"{found.name}: is in chunks of {found.chunks}, they should be smaller")
    array = np.asarray(found[()], dtype=np.float64)
    if not np.isfinite(array).all():
        raise UnreadableError(f"{found.name}: should be finite")
    return array


def _number(facts: dict[str, Any], name: str) -> np.number[Any]:
    value = facts[name]
    if not isinstance(value, np.number) or not np.isfinite(value):
        raise UnreadableError(f"{name}: {shortened(value)}, should be a number")
    return value


def _varied(parameters: NDArray[np.float64] | None, moving: tuple[int, ...]) -> dict[str, NDArray[Any]]:
    """Parameters of episodes at their start, (M, n_p), from (M, N + 1, n_p), and none of failures."""
    if parameters is None:
        return {}
    constant = np.delete(parameters, moving, axis=2)
    if not (constant == constant[:, :1]).all():
        raise UnreadableError("infos/parameters: should be the same in every row of an episode")
    return {PARAMETERS: parameters[:, 0], f"failures.{PARAMETERS}": np.zeros((0, parameters.shape[-1]))}


def _no_failures(n_x: int) -> dict[str, NDArray[Any]]:
    empty: dict[str, NDArray[Any]] = {
        "index": np.zeros(0, dtype=np.int64),
        "seed": np.zeros(0, dtype=np.int64),
        "stop_reason": np.zeros(0, dtype=np.uint8),
        "cost": np.zeros(0),
        "start": np.zeros((0, n_x)),
        "final_errors": np.zeros((0, 2)),
    }
    return {f"failures.{name}": array for name, array in empty.items()}
