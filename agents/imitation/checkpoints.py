"""Checkpoints of a training: all that it needs to go on as if nothing had happened."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from agents.run_folder import RunFolderError
from experts.demonstrations.settings import differences
from experts.files import write_atomically

CHECKPOINT = "checkpoint.pt"


class CheckpointError(RunFolderError):
    """A checkpoint cannot be used."""


def save_checkpoint(folder: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint, complete or not at all.

    Args:
        folder: Made if it does not exist.
        content: Tensors, numbers, texts, and lists and dictionaries of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stream = io.BytesIO()
    torch.save(content, stream)
    write_atomically(folder / CHECKPOINT, stream.getvalue())


def load_checkpoint(folder: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """Read a checkpoint, if there is one; nothing in it is executed.

    Args:
        folder: Where it would be.
        identity: What the training follows from; the checkpoint must say the same under "identity".

    Returns:
        Its content, or None.

    Raises:
        CheckpointError: If it cannot be read, or is that of another training.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        content = torch.load(path, weights_only=True)
        there = content["identity"]
    except Exception as error:  # whatever its bytes make the reader raise
        raise CheckpointError(
            f"{path} cannot be read ({error}); remove it to begin the training anew"
        ) from error
    found = differences(there, identity)
    if found:
        raise CheckpointError(f"{path} is that of another training: {'; '.join(found)}. Take another folder")
    return dict(content)
