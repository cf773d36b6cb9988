"""A compiled program together with the shapes of its arrays, and arguments in the form that it takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.compiler import native

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArraySpec:
    """An array of a kernel: its name, the scalars in a row, and whether all rows share one."""

    name: str
    stride: int
    shared: bool


class BoundKernel:
    """A compiled program with what is known about its arrays.

    Attributes:
        address: Address of the C function `void (int64 begin, int64 end, const int64 *buffers)`.
        inputs: Arrays that it reads.
        outputs: Arrays that it writes.
        operation_count: Arithmetic operations per row.
    """

    def __init__(self, kernel: native.NativeKernel) -> None:
        """Read the notes that the compiler left."""
        self.native = kernel
        self.address = kernel.address
        self.inputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["inputs"])
        self.outputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["outputs"])
        self.operation_count: int = kernel.metadata["operations"]

    def __call__(self, arrays: Sequence[Array], rows: int) -> None:
        """Run on rows 0 .. rows - 1 of C-contiguous float64 arrays, inputs first."""
        buffers = np.array([array.ctypes.data for array in arrays], dtype=np.int64)
        self.native.function(0, rows, buffers.ctypes.data)


def rows_of(inputs: dict[str, ArrayLike | None]) -> tuple[int, bool, dict[str, Array]]:
    """Bring arguments that may be one row or a batch to a common form.

    Args:
        inputs: Arrays of shape (n,) or (B, n) by name; `h` is shared by all rows.

    Returns:
        Number of rows, whether there is a batch axis, and every input as an array of that many rows.

    Raises:
        ValueError: If an array has another number of axes, or batches differ in length.
    """
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in inputs.items()}
    shared = {name: arrays.pop(name) for name in ("h",) if name in arrays}
    batches = {name: array.shape[0] for name, array in arrays.items() if array.ndim == 2}
    for name, array in arrays.items():
        if array.ndim not in (1, 2):
            raise ValueError(f"{name}: shape {array.shape}, should be (n,) or (B, n)")
    if len(set(batches.values())) > 1:
        raise ValueError(f"batches differ in length: {batches}")
    rows = next(iter(batches.values()), 1)
    for name, array in arrays.items():
        arrays[name] = np.broadcast_to(array, (rows, array.shape[-1]))
    return rows, bool(batches), {**arrays, **shared}
