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
        """Run on rows 0 .. rows - 1 of C-contiguous arrays.

        Args:
            arrays: Inputs, then outputs, each of the shape and element type that its `ArraySpec` says.
            rows: Number of rows to work on.
            threads: Threads to share the work among.
        """
        names = (spec.name for spec in (*self.inputs, *self.outputs))
        KernelCall(self, dict(zip(names, arrays, strict=True)))(rows, threads)


class KernelCall:
    """A kernel with the addresses of its arrays, for callers that call it again and again.

    Arrays that stay are handed over once, and kept alive; others take their place before a call. All of them
    must be C-contiguous, of the shape and element type that the kernel's `ArraySpec`s say.
    """

    def __init__(self, kernel: BoundKernel, arrays: Mapping[str, Array]) -> None:
        """Note the addresses of arrays.

        Args:
            kernel: The kernel.
            arrays: Arrays by name; those of names that the kernel does not know are left out.
        """
        self._kernel, self._function = kernel, kernel.native.function
        self._slots: dict[str, int] = {}
        position = 1 if kernel.indexed else 0
        for spec in (*kernel.inputs, *kernel.outputs):
            self._slots[spec.name] = position
            # That of an array by column is followed by the columns' distance.
            position += 2 if spec.by_column else 1
        self._buffers = (ctypes.c_int64 * position)()
        self._pointer = ctypes.addressof(self._buffers)
        self._kept = [array for name, array in arrays.items() if name in self._slots]
        for spec in (*kernel.inputs, *kernel.outputs):
            if spec.name in arrays:
                array = arrays[spec.name]
                self.place(**{spec.name: array})
                if spec.by_column:  # the columns of a single row are numbers
                    self._buffers[self._slots[spec.name] + 1] = array.shape[1] if array.ndim == 2 else 1

    def place(self, **arrays: Array) -> None:
        """Take arrays in place of those of their names; each has the shape of the one before.

        Args:
            arrays: Arrays by name; the caller keeps them alive.
        """
        for name, array in arrays.items():
            self._buffers[self._slots[name]] = address_of(array)

    def __call__(self, rows: int, threads: int = 1) -> None:
        """Run on rows 0 .. rows - 1.

        Args:
            rows: Number of rows to work on.
            threads: Threads to share the work among.
        """
        run_shared(self._function, rows, self._pointer, threads)

    def on_rows(self, rows: NDArray[np.int64]) -> None:
        """Run an indexed kernel on some rows.

        Args:
            rows: Numbers of the rows, shape (k,).
        """
        self._buffers[0] = address_of(rows)
        self._function(0, len(rows), self._pointer)

    def of_one_row(self) -> Callable[[], None]:
        """A function that runs the kernel on row 0.

        It keeps the interpreter to itself: the work is shorter than handing the interpreter over.
        """
        prototype = ctypes.PYFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
        function: Any = prototype(self._kernel.address)
        function.call = self  # keeps code and arrays alive
        # Converted beforehand, arguments cost nothing.
        return partial(function, ctypes.c_int64(0), ctypes.c_int64(1), ctypes.c_void_p(self._pointer))


def address_of(array: Array) -> int:
    """Address of a contiguous array.

    Args:
        array: The array.

    Returns:
        The address of its first element.
    """
    buffer: Any = array
    try:  # four times as fast as the other way, but not for what is read-only or empty
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    except (TypeError, ValueError):
        return array.ctypes.data


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
