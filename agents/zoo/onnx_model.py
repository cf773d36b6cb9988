"""Policies in ONNX files, which other learners export: flown by ONNX Runtime, on one thread.

A file holds operators and numbers, no code.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


# And the length of the name that follows, seven bits a byte, the lowest first.
_PLACE = re.compile(rb"\x08location\x12([\x80-\xff]?)([\x01-\x7f])", re.DOTALL)


class OnnxModelError(ValueError):
    """Not a policy; the message says what would be right."""


class OnnxModel:
    """A network from observations, shape (B, n_obs), to actions, shape (B, n_u).

    Attributes:
        sizes: Numbers of observations and actions; None if the file leaves one open.
    """

    def __init__(self, path: Path) -> None:
        """Read a file.

        Args:
            path: Its path.

        Raises:
            OnnxModelError: If it cannot be read, or is not such a network.
            ImportError: If the extra `onnx` is not installed.
        """
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise ImportError(f'{path} needs ONNX Runtime: pip install "dq-space-arm[onnx]"') from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what matters is raised
        try:
            self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its errors have no class in common
            raise OnnxModelError(f"{path}: cannot be read as ONNX: {str(error).splitlines()[0]}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or not outputs:
            names = ", ".join(each.name for each in inputs) or "none"
            raise OnnxModelError(f"{path}: has the inputs {names}, should have one, the observations")
        seen, acts = inputs[0], outputs[0]
        if any(each.type not in _TYPES or len(each.shape) != 2 for each in (seen, acts)):
            found = " to ".join(f"{each.type} of shape {each.shape}" for each in (seen, acts))
            raise OnnxModelError(
                f"{path}: maps {found}, should map floats of shape (B, n_obs) to floats of shape (B, n_u)"
            )
        self._path, self._name, self._dtype, self._batch = path, seen.name, _TYPES[seen.type], seen.shape[0]
        widths = seen.shape[1], acts.shape[1]
        self.sizes = widths if all(isinstance(each, int) for each in widths) else None

    def __call__(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Actions, the first output, for a batch of observations; OnnxModelError if it fails on them."""
        given = np.ascontiguousarray(observations, self._dtype)
        if not isinstance(self._batch, int) or self._batch == len(given):
            return self._acted(given)
        # A file whose batch is fixed, mostly to 1.
        short = -len(given) % self._batch
        padded = np.concatenate([given, given[:1].repeat(short, axis=0)]) if short else given
        parts = padded.reshape(-1, self._batch, given.shape[1])
        return np.concatenate([self._acted(part) for part in parts])[: len(given)]

    def _acted(self, given: NDArray[Any]) -> NDArray[Any]:
        try:
            return np.asarray(self._session.run(None, {self._name: given})[0])
        except Exception as error:  # its errors have no class in common
            sentence = f"{self._path}: fails on observations of shape {given.shape}"
            raise OnnxModelError(f"{sentence}: {str(error).splitlines()[0]}") from error


def tensor_files(path: Path) -> list[Path]:
    """Files that hold tensors of a network outside of its own, as PyTorch writes them; sorted."""
    content = path.read_bytes()
    names = {content[each.end() : each.end() + _length(*each.groups())] for each in _PLACE.finditer(content)}
    places = (path.parent / os.fsdecode(name) for name in names if b"\0" not in name)
    return sorted(place for place in places if os.path.isfile(place))  # noqa: PTH113 - False for any name


def _length(low: bytes, high: bytes) -> int:
    return (low[0] & 0x7F) + 128 * high[0] if low else high[0]
