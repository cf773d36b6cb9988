"""Where an episode begins, as options say: at the scene's own start, at a drawn one, or at a given state."""

from __future__ import annotations

import json
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import DQSpaceArmEnv, Scene
from dq_space_arm_env.scene import StateLayout

FILES = (".npy", ".json", ".npz")
"""Endings of files that a state is read from."""


_UNREADABLE = (TypeError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading numbers from a text or a file raises."""
_PARTS_OF_SCENE = ("target", "base_mass", "base_inertia", "link_", "payload")


class Start(NamedTuple):
    """The beginning of an episode.

    Attributes:
        state: Shape (n_x,), units of the state.
        scene: The scene; with the target and the masses of this episode if they are drawn.
        title: What tables call it.
    """

    state: NDArray[np.float64]
    scene: Scene
    title: str


def begin(scene: Scene, seed: int | None, given: str | None) -> Start:
    """Begin an episode.

    Args:
        scene: The scene.
        seed: Draws the start as `env.reset(seed=seed)` does; None for the scene's own start.
        given: State in place of a drawn one, see `read_state`; None for none.

    Returns:
        The start.

    Raises:
        ValueError: If the state is none of this scene, or both are given.
    """
    if seed is not None and given is not None:
        raise ValueError("--seed and --start exclude each other: a start is drawn, or given")
    if seed is not None and seed < 0:
        raise ValueError(f"--seed is {seed}; it must be at least 0")
    # Masses, inertias and targets, unlike states, are part of the scene that an expert solves.
    draws_scene = any(
        width for name, width in scene.spread.model_dump().items() if name.startswith(_PARTS_OF_SCENE)
    )
    if seed is None and given is None and not draws_scene:
        return Start(np.array(StateLayout.of(scene).initial_state), scene, "the scene's own")
    env = DQSpaceArmEnv(scene)
    if seed is not None:
        env.reset(seed=seed)
        title = f"drawn with seed {seed}"
    elif given is not None:
        env.reset(options={"initial_state": read_state(given, env.kernels.n_x)})
        title = "given"
    else:
        env.reset(options={"nominal": True})
        title = "the scene's own"
    # Where nothing of the scene is drawn, the scene itself: its machine code is in the cache.
    return Start(np.asarray(env.state, dtype=np.float64), env.episode_scene if draws_scene else scene, title)


def read_state(text: str, size: int) -> NDArray[np.float64]:
    """Read a state.

    Args:
        text: Numbers with commas between them; or a file: .npy, .json with a list, or .npz with `states`,
            whose first row counts.
        size: How many numbers it must have.

    Returns:
        Shape (size,), units of the state.

    Raises:
        ValueError: If it is no state.
        OSError: If the file cannot be read.
    """
    path = Path(text)
    if path.suffix in FILES and not path.is_file():
        raise ValueError(f"--start {text}: there is no such file")
    try:
        values = np.asarray(_from_file(path) if path.suffix in FILES else text.split(","), dtype=np.float64)
    except _UNREADABLE as error:
        raise ValueError(
            f"--start {text}: should be {size} numbers with commas between, or a file ({', '.join(FILES)})"
        ) from error
    if values.shape != (size,):
        raise ValueError(f"--start: has shape {values.shape}, should be the scene's ({size},)")
    return values


def _from_file(path: Path) -> Any:
    if path.suffix == ".json":
        return json.loads(path.read_text(encoding="utf-8"))
    # Read first: of a file that is no archive, NumPy would leave the descriptor open.
    content = np.load(BytesIO(path.read_bytes()), allow_pickle=False)
    return content["states"][0] if path.suffix == ".npz" else content
