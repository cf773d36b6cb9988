"""Read demonstrations from a Minari data set, as `demonstrations export` writes them, into a folder."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.common.bounded_reading import read_text, reason_of
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.kernels import Kernels
from experts.ddp.solution import StopReason
from experts.demonstrations import Demonstrations, DemonstrationsError, load_demonstrations
from experts.demonstrations.folder import MANIFEST, SETTINGS, SHARDS
from experts.demonstrations.outcomes import GUESSES, REASONS
from experts.demonstrations.settings import FORMAT, SHARD_SIZE
from experts.demonstrations.shard import NOTES
from experts.demonstrations.tensors import pack

GAINS = "feedback_gains"


def read_from_minari(dataset_id: str, folder: Path) -> Demonstrations:
    """Copy a Minari data set of demonstrations into a folder, unless it is there already.

    Gains are zero if the data set was exported without them; the weight on the final pose, which Minari does
    not keep, is NaN.
    """
    dataset = _open(dataset_id)
    with _damage_named(dataset_id):
        settings = _settings(dataset, dataset_id)
    text = json.dumps(settings, indent=2) + "\n"
    if (folder / MANIFEST).is_file():
        if read_text(folder / SETTINGS) != text:
            raise DemonstrationsError(f"{folder} holds other demonstrations: use another folder")
        return load_demonstrations(folder, verify=True)
    shutil.rmtree(folder / SHARDS, ignore_errors=True)  # of an interrupted run
    (folder / SHARDS).mkdir(parents=True)
    kernels = Demonstrations(folder, settings, {"shards": [], "demonstrations": 0}).kernels
    shards = []
    episodes = dataset.episode_indices.tolist()
    for number, first in enumerate(range(0, len(episodes), SHARD_SIZE)):
        indices = episodes[first : first + SHARD_SIZE]
        with _damage_named(dataset_id):
            content = pack(_arrays(dataset, indices, kernels), NOTES)
        digest = hashlib.sha256(content).hexdigest()
        name = f"{number:06d}-{digest}.safetensors"
        write_atomically(folder / SHARDS / name, content)
        shards.append(
            {
                "file": name,
                "sha256": digest,
                "bytes": len(content),
                "demonstrations": len(indices),
                "failures": 0,
            }
        )
    write_atomically(folder / SETTINGS, text)
    manifest = {
        "settings_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "demonstrations": int(dataset.total_episodes),
        "failures": {},
        "shards": shards,
    }
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=2) + "\n")
    return load_demonstrations(folder)


@contextmanager
def _damage_named(dataset_id: str) -> Iterator[None]:
    """Turn what damaged metadata and HDF5 files raise into a sentence."""
    try:
        yield
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        if isinstance(error, DemonstrationsError):
            raise
        raise DemonstrationsError(
            f"the Minari data set {dataset_id} is damaged ({reason_of(error)}): export or download it again"
        ) from error


def _open(dataset_id: str) -> Any:
    try:
        import h5py  # noqa: F401
        import minari
    except ModuleNotFoundError as error:
        raise DemonstrationsError(
            f'this needs Minari: pip install "dq-space-arm[minari]" ({error.name} is missing)'
        ) from error
    try:
        return minari.load_dataset(dataset_id)
    except FileNotFoundError as error:
        raise DemonstrationsError(f"Minari has no data set {dataset_id} here: {error}") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        raise DemonstrationsError(
            f"Minari cannot read the data set {dataset_id}: {reason_of(error)}"
        ) from error


def _settings(dataset: Any, dataset_id: str) -> dict[str, Any]:
    """Settings of the demonstrations, from the data set's metadata."""
    noted = dataset.storage.metadata.get("demonstrations")
    scene = dataset.spec.env_spec.kwargs.get("scene") if dataset.spec.env_spec is not None else None
    if noted is None or scene is None:
        raise DemonstrationsError(
            f"the Minari data set {dataset_id} holds no demonstrations: it was not written by "
            "`dq-space-arm demonstrations export`"
        )
    resolved = Scene.model_validate(scene).model_dump(mode="json", exclude_none=True)
    return {**noted, "format": FORMAT, "scene": resolved, "minari": dataset_id}


def _arrays(dataset: Any, indices: Sequence[int], kernels: Kernels) -> dict[str, NDArray[Any]]:
    """The arrays of a shard, see `experts.demonstrations.shard`."""
    episodes = list(dataset.iterate_episodes(indices))
    facts = list(dataset.storage.get_episode_metadata(indices))
    states = np.array([episode.infos["state"] for episode in episodes])
    shape = (len(episodes), states.shape[1] - 1, kernels.n_u, kernels.n_t)
    gains = np.zeros(shape, dtype=np.float32)
    if GAINS in episodes[0].infos:
        gains[:] = [episode.infos[GAINS][:-1] for episode in episodes]
    count = len(episodes)
    return {
        "states": states,
        "observations": np.array([episode.observations for episode in episodes]),
        "actions": np.array([episode.actions for episode in episodes]),
        "rewards": np.array([episode.rewards for episode in episodes]),
        GAINS: gains,
        "index": np.array([each["problem"] for each in facts], dtype=np.int64),
        "seed": np.array([each["seed"] for each in facts], dtype=np.int64),
        "cost": np.array([each["cost"] for each in facts], dtype=np.float64),
        "iterations": np.array([each["iterations"] for each in facts], dtype=np.int64),
        "stop_reason": np.full(count, REASONS.index(StopReason.CONVERGED.value), dtype=np.uint8),
        "guess": np.array([GUESSES.index(each["guess"]) for each in facts], dtype=np.uint8),
        "emphasis": np.full(count, np.nan),
        **{
            f"{when}_errors": np.array(
                [[each[f"{when}_{what}_error"] for what in ("attitude", "position")] for each in facts]
            )
            for when in ("start", "final")
        },
        "clamped_share": np.array([each["clamped_share"] for each in facts], dtype=np.float64),
        **_no_failures(states.shape[2]),
    }


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
