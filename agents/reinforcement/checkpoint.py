"""Checkpoints of reinforcement learning: all that the next update depends on, as numbers and text.

| file | content |
|---|---|
| `learner.pth` | parameters, optimizers, and the state of PyTorch's random generator |
| `arrays.npz` | running episodes with the last observations, and the replay buffer |
| `state.json` | progress of the run, counters, and the states of the other random generators |

A run that is killed and resumed ends with the weights of one that was not, bit for bit on one machine.

Nothing in these files is executed: a run folder that somebody else made can be resumed.
"""

import io
import json
import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from agents.policies.tensor_files import read_tensors
from agents.reinforcement.sac import DemonstrationBuffer
from agents.run_folder import RunFolderError
from dq_space_arm_env.common.bounded_formats import read_arrays
from dq_space_arm_env.common.bounded_reading import read_bytes, read_mapping

LEARNER, ARRAYS, STATE = "learner.pth", "arrays.npz", "state.json"
MOST_BYTES = 1 << 30
"""Largest parameters and optimizers that are read, beside those of the learner's networks."""
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "step_factor")
_COLUMNS = (
    "observations",
    "next_observations",
    "actions",
    "rewards",
    "dones",
    "timeouts",
    "ep_start",
    "ep_length",
)


class Progress(NamedTuple):
    """How far a run has come, and what it took."""

    environment_steps: int = 0  # of all copies together
    seconds: float = 0.0  # training time, over all starts of the run
    expert_solves: int = 0  # for demonstrations, or for the policy it started from
    seconds_before: float = 0.0  # time for these, and for training the policy it started from


def write_checkpoint(folder: Path, model: BaseAlgorithm, progress: Progress) -> None:
    """Write a learner between two rollouts into an empty folder."""
    parts = {
        "parameters": model.get_parameters(),
        "variables": {name: tensor.detach() for name, tensor in _variables(model).items()},
        "generator": torch.get_rng_state(),
    }
    content = io.BytesIO()  # a full disk makes PyTorch raise a RuntimeError
    torch.save(parts, content)
    (folder / LEARNER).write_bytes(content.getvalue())
    np.savez(folder / ARRAYS, allow_pickle=False, **_running(model), **_recorded(model))
    buffer = getattr(model, "replay_buffer", None)
    state = {
        "progress": progress._asdict(),
        "counters": {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)},
        "buffer": None if buffer is None else {"pos": int(buffer.pos), "full": bool(buffer.full)},
        "generators": _generators(model),
    }
    (folder / STATE).write_text(json.dumps(state), encoding="utf-8")


def read_checkpoint(folder: Path, model: BaseAlgorithm) -> Progress:
    """Put an untrained learner, and its environment, into the state of a checkpoint.

    Raises:
        RunFolderError: If the checkpoint is damaged, of another learner, or of an earlier version.
    """
    if not (folder / STATE).exists():
        raise RunFolderError(
            f"{folder} lacks {STATE}: it is damaged, or of an earlier version, whose pickles are not read: "
            "train in another folder"
        )
    try:
        state = read_mapping(folder / STATE)
        # Adam keeps two numbers beside each parameter.
        networks = 3 * sum(parameter.nbytes for parameter in model.policy.parameters())
        parts = read_tensors(read_bytes(folder / LEARNER, networks + MOST_BYTES))
        arrays = read_arrays(folder / ARRAYS, most=_claimed(folder / ARRAYS))
        return _restored(model, state, parts, arrays)
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).partition("\n")[0]
        raise RunFolderError(
            f"checkpoint {folder} is damaged ({reason}): remove it to begin anew, or use another folder"
        ) from error


def _restored(
    model: BaseAlgorithm, state: Mapping[str, Any], parts: Any, arrays: Mapping[str, NDArray[Any]]
) -> Progress:
    progress = Progress(**state["progress"])
    model.set_parameters(parts["parameters"], exact_match=True, device="cpu")
    for name, tensor in _variables(model).items():
        tensor.data.copy_(parts["variables"][name])
    for name, value in state["counters"].items():
        if name in _COUNTERS:
            setattr(model, name, type(getattr(model, name))(value))
    _fill(model, state["buffer"], arrays)
    environment: Any = model.get_env()
    environment.set_state(_part("environment.", arrays))
    model._last_obs = _part("last_observations.", arrays) or arrays["last_observations"]
    model._last_episode_starts = arrays["episode_starts"]
    _seed_again(model, state["generators"], parts["generator"])
    return progress


def _claimed(path: Path) -> int:
    """Bytes that an archive stands for at most: nothing in it is compressed, and a bool counts as 8 bytes."""
    return 8 * path.stat().st_size if path.exists() else 0


def _variables(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Tensors of a learner outside its networks: the weight of the entropy."""
    return {name: recursive_getattr(model, name) for name in model._get_torch_save_params()[1]}


# --- environment ---


def _running(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """The environment's running episodes, with what was last seen of them."""
    environment: Any = model.get_env()
    found = {f"environment.{name}": array for name, array in environment.get_state().items()}
    seen: Any = model._last_obs
    if isinstance(seen, dict):
        found |= {f"last_observations.{name}": part for name, part in seen.items()}
    else:
        found["last_observations"] = seen
    return {**found, "episode_starts": np.asarray(model._last_episode_starts)}


def _part(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


# --- replay buffer ---


def _columns(model: BaseAlgorithm) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays of the replay buffer with a row for each decision; those of goals part by part."""
    buffer = model.replay_buffer if isinstance(model, OffPolicyAlgorithm) else None
    for name in _COLUMNS if buffer is not None else ():
        column = getattr(buffer, name, None)
        if isinstance(column, dict):
            yield from ((f"buffer.{name}.{key}", part) for key, part in column.items())
        elif column is not None:
            yield f"buffer.{name}", column


def _recorded(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """The filled rows of the replay buffer, and what else it holds."""
    buffer: Any = getattr(model, "replay_buffer", None)
    found = {name: column if buffer.full else column[: buffer.pos] for name, column in _columns(model)}
    if isinstance(buffer, HerReplayBuffer):
        found["episodes.start"] = buffer._current_ep_start
    if isinstance(buffer, DemonstrationBuffer):
        found["demonstrated.share"] = np.array(buffer.share)
        found |= {f"demonstrated.{place}": column for place, column in enumerate(buffer._demonstrated)}
    return found


def _fill(model: BaseAlgorithm, place: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Fill an empty replay buffer."""
    buffer: Any = getattr(model, "replay_buffer", None)
    if buffer is None:
        return
    buffer.pos, buffer.full = place["pos"], place["full"]
    for name, column in _columns(model):
        rows = column if buffer.full else column[: buffer.pos]
        if arrays[name].shape != rows.shape or arrays[name].dtype != rows.dtype:
            raise ValueError(f"{name} has shape {arrays[name].shape}, should have {rows.shape}")
        rows[...] = arrays[name]
    if isinstance(buffer, HerReplayBuffer):
        buffer._current_ep_start = arrays["episodes.start"]
    if isinstance(buffer, DemonstrationBuffer):
        shown = _part("demonstrated.", arrays)
        buffer.share = float(shown.pop("share"))
        buffer._demonstrated = tuple(shown[str(place)] for place in range(len(shown)))


# --- random generators ---


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    """States of the generators that learners draw from, besides PyTorch's."""
    kind, key, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - that of SB3
    return {
        "python": random.getstate(),
        "numpy": [kind, np.asarray(key).tolist(), position, has_gauss, gauss],
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _seed_again(model: BaseAlgorithm, states: Mapping[str, Any], torch_state: torch.Tensor) -> None:
    version, numbers, gauss = states["python"]
    random.setstate((version, tuple(numbers), gauss))
    kind, key, *rest = states["numpy"]
    np.random.set_state((kind, np.array(key, dtype=np.uint32), *rest))  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = states["actions"]
    torch.set_rng_state(torch_state)
