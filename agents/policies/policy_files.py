"""Files of exported policies: arrays and JSON in one `.npz`, of which nothing is executed."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.bounded_formats import read_arrays
from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.shown_text import shortened

FORMAT = 1  # version of the files
MOST_BYTES = 256 * 2**20  # 33 million weights; twice as many as configurations allow between layers


class PolicyFileError(ValueError):
    """A file is not a policy that this version can read."""


def metadata_text(metadata: Mapping[str, Any]) -> NDArray[Any]:
    """Metadata as an array, for `write_policy`; TypeError for what is no JSON value."""
    try:
        return np.array(json.dumps(dict(metadata), sort_keys=True))
    except TypeError as error:
        raise TypeError(f"metadata: {error}; should be JSON values, with texts as keys") from error


def write_policy(path: str | os.PathLike[str], kind: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the version of a kind of files, and arrays, atomically; PolicyFileError if they are too large."""
    content, versioned = io.BytesIO(), {kind: np.array(FORMAT), **arrays}
    size = sum(array.size * max(array.itemsize, 8) for array in versioned.values())
    if size > MOST_BYTES:
        raise PolicyFileError(
            f"{path} would have {size:,} bytes, 8 per number, at most {MOST_BYTES:,} are read: make the "
            "network smaller"
        )
    np.savez_compressed(content, allow_pickle=False, **versioned)
    write_atomically(Path(path), content.getvalue())


def policy_arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file; PolicyFileError if it is missing or damaged."""
    try:
        return read_arrays(path, most=MOST_BYTES)
    except UnreadableError as error:
        raise PolicyFileError(f"{path} cannot be read as a policy ({error})") from error


def check_version(path: str | os.PathLike[str], kind: str, found: NDArray[Any]) -> None:
    """Refuse another version of a kind of files."""
    if found.shape != () or found != FORMAT:
        raise PolicyFileError(
            f"{path} has {kind} {shortened(found.tolist())}, this version reads {FORMAT}: "
            "export the policy again"
        )


def read_metadata(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The metadata among the arrays of a file; KeyError or ValueError if there are none."""
    metadata = parse_json(str(arrays["metadata"]), "metadata")
    if not isinstance(metadata, dict):
        raise ValueError("metadata: should be a mapping")
    return metadata


def noted_effort(metadata: Mapping[str, Any]) -> dict[str, float]:
    """Numbers that a policy's metadata has on its training; others may have noted anything there."""
    training = metadata.get("training")
    found = training.items() if isinstance(training, Mapping) else ()
    return {
        name: value for name, value in found if isinstance(value, int | float) and not isinstance(value, bool)
    }


@contextmanager
def building(path: str | os.PathLike[str]) -> Iterator[None]:
    """Name the file where what it holds makes no policy."""
    try:
        yield
    except KeyError as error:
        raise PolicyFileError(f"{path} is not a policy: it has no {error.args[0]}") from error
    except (ValueError, TypeError) as error:
        raise PolicyFileError(f"{path} is not a policy: {error}") from error
