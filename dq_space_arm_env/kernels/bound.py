"""A compiled program together with the shapes of its arrays, and arguments in the form that it takes."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dq_space_arm_env.compiler import native
from dq_space_arm_env.kernels.threads import run_shared

Array = NDArray[Any]


@dataclass(frozen=True)
class ArraySpec:
    """An array of a kernel.

    Attributes:
        name: Its name.
        stride: Numbers in a row.
        shared: Whether it has a single row that all rows read.
        dtype: Type of its elements.
        by_column: Whether its shape is (stride, rows) rather than (rows, stride).
    """

    name: str
    stride: int
    shared: bool
    dtype: str
    by_column: bool


class BoundKernel:
    """A compiled program with what is known about its arrays.

    Attributes:
        address: Address of the C function `void (int64 begin, int64 end, const int64 *buffers)`.
        inputs: Arrays that it reads.
        outputs: Arrays that it writes.
        operation_count: Arithmetic operations per row.
        indexed: Whether a list of rows (int64) comes before all other arrays.
    """

    def __init__(self, kernel: native.NativeKernel) -> None:
        """Read the notes that the compiler left."""
        self.native = kernel
        self.address = kernel.address
        self.inputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["inputs"])
        self.outputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["outputs"])
        self.operation_count: int = kernel.metadata["operations"]
        self.indexed: bool = kernel.metadata["indexed"]

    def __call__(self, arrays: Sequence[Array], rows: int, threads: int = 1) -> None:
        """Run on rows 0 .. rows - 1 of C-contiguous arrays, inputs first, none of them by column.

        Args:
            arrays: Inputs, then outputs, each of the element type that its `ArraySpec` says; the list of rows
                before them if the kernel is indexed.
            rows: Number of rows to work on.
            threads: Threads to share the work among.
        """
        buffers = np.array([array.ctypes.data for array in arrays], dtype=np.int64)
        run_shared(self.native.function, rows, buffers.ctypes.data, threads)

    def bind_one(self, arrays: Sequence[Array]) -> Callable[[], None]:
        """Fix the arrays of a call on a single row, for callers that make it again and again.

        Args:
            arrays: As for a call; they must stay alive, and where they are, as long as the result is used.

        Returns:
            A function that runs the kernel on row 0. It keeps the interpreter to itself: the work is shorter
            than handing the interpreter over.
        """
        specs = (*self.inputs, *self.outputs)
        addresses: list[int] = []
        for spec, array in zip(specs, arrays, strict=True):
            addresses += [array.ctypes.data, 1] if spec.by_column else [array.ctypes.data]
        buffers = (ctypes.c_int64 * len(addresses))(*addresses)
        prototype = ctypes.PYFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
        # Arguments that are converted beforehand; the buffers are kept alive by the pointer to them.
        pointer = ctypes.cast(buffers, ctypes.c_void_p)
        return partial(prototype(self.address), ctypes.c_int64(0), ctypes.c_int64(1), pointer)


def run_on_rows(kernel: BoundKernel, rows: NDArray[np.int64], arrays: Mapping[str, Array]) -> None:
    """Run an indexed kernel on some rows of arrays that are known by name.

    Args:
        kernel: An indexed kernel.
        rows: Numbers of the rows, shape (k,).
        arrays: C-contiguous arrays with the element types of the kernel, by the names in its `ArraySpec`s.
    """
    kernel([rows, *(arrays[spec.name] for spec in (*kernel.inputs, *kernel.outputs))], len(rows))


def rows_of(inputs: dict[str, ArrayLike | None], dtype: DTypeLike) -> tuple[int, bool, dict[str, Array]]:
    """Bring arguments that may be one row or a batch to a common form.

    Args:
        inputs: Arrays of shape (n,) or (B, n) by name; `h` is shared by all rows.
        dtype: Type of the elements to convert to.

    Returns:
        Number of rows, whether there is a batch axis, and every input as an array of that many rows.

    Raises:
        ValueError: If an array has another number of axes, or batches differ in length.
    """
    arrays = {name: np.asarray(value, dtype=dtype) for name, value in inputs.items()}
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
