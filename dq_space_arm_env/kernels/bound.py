"""Native calls: compiled programs with the shapes of their arrays, and tables of the arrays' addresses."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.compiler import native
from dq_space_arm_env.kernels.threads import run_shared

Array = NDArray[Any]


@dataclass(frozen=True)
class ArraySpec:
    """An array of a kernel."""

    name: str
    stride: int  # numbers in a row
    shared: bool  # has a single row that all rows read
    dtype: str
    by_column: bool  # has shape (stride, rows) rather than (rows, stride)


class BoundKernel:
    """A compiled program and its arrays.

    `address` is that of the C function `void (int64 begin, int64 end, const int64 *buffers)`; `inputs` and
    `outputs` are in the order of `buffers`; if `indexed`, a list of rows (int64) comes first.
    """

    def __init__(self, kernel: native.NativeKernel) -> None:
        self.native = kernel
        self.address = kernel.address
        self.inputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["inputs"])
        self.outputs = tuple(ArraySpec(*spec) for spec in kernel.metadata["outputs"])
        self.operation_count: int = kernel.metadata["operations"]
        self.indexed: bool = kernel.metadata["indexed"]

    def __call__(self, arrays: Sequence[Array], rows: int, threads: int = 1) -> None:
        """Run on rows 0 .. rows - 1 of C-contiguous arrays, inputs then outputs, as in their `ArraySpec`s."""
        names = (spec.name for spec in (*self.inputs, *self.outputs))
        KernelCall(self, dict(zip(names, arrays, strict=True)))(rows, threads)


class KernelCall:
    """A kernel with the addresses of its arrays, for repeated calls.

    Arrays given once are kept alive; others take their place before a call. All must have the shape and
    element type of the kernel's `ArraySpec`s, and be C-contiguous; only columns of arrays by column may be
    apart. A call without all of them is a ValueError: the code would read and write at address 0.
    """

    def __init__(self, kernel: BoundKernel, arrays: Mapping[str, Array]) -> None:
        """Note the addresses of arrays by name; names unknown to the kernel are ignored."""
        self._kernel, self._function = kernel, kernel.native.function
        self._slots: dict[str, int] = {}
        position = 1 if kernel.indexed else 0
        for spec in (*kernel.inputs, *kernel.outputs):
            self._slots[spec.name] = position
            # That of an array by column is followed by the columns' distance.
            position += 2 if spec.by_column else 1
        self._missing = set(self._slots)
        self._buffers = (ctypes.c_int64 * position)()
        self._pointer = ctypes.addressof(self._buffers)
        self._kept = [array for name, array in arrays.items() if name in self._slots]
        for spec in (*kernel.inputs, *kernel.outputs):
            if spec.name in arrays:
                array = arrays[spec.name]
                self.place(**{spec.name: array})
                if spec.by_column:  # the columns of a single row are numbers
                    self._buffers[self._slots[spec.name] + 1] = array.strides[0] // array.itemsize

    def place(self, **arrays: Array) -> None:
        """Replace arrays by others of the same shape, which the caller keeps alive."""
        for name, array in arrays.items():
            self._buffers[self._slots[name]] = address_of(array)
        if self._missing:
            self._missing.difference_update(arrays)

    def place_at(self, addresses: Mapping[str, int]) -> None:
        """Replace arrays, see `place`, by those at addresses found before, see `address_of`."""
        for name, address in addresses.items():
            self._buffers[self._slots[name]] = address

    def _require_arrays(self) -> None:
        if self._missing:
            raise ValueError(f"the kernel has no array for {', '.join(sorted(self._missing))}")

    def __call__(self, rows: int, threads: int = 1) -> None:
        """Run on rows 0 .. rows - 1."""
        self._require_arrays()
        run_shared(self._function, rows, self._pointer, threads)

    def on_rows(self, rows: NDArray[np.int64]) -> None:
        """Run an indexed kernel on the rows of a list, shape (k,)."""
        self._require_arrays()
        self._buffers[0] = address_of(rows)
        self._function(0, len(rows), self._pointer)

    def of_one_row(self) -> Callable[[], None]:
        """Make a function that runs the kernel on row 0, see `one_row_call`; it keeps the arrays alive."""
        self._require_arrays()
        call = one_row_call(self._kernel.address, self._pointer)
        function: Any = call.func
        function.call = self  # keeps code and arrays alive
        return call


class SingleRowCalls:
    """Calls of a kernel for one row, with arrays prepared beforehand: they cost little more than their work.

    Every call takes a set of arrays from a pool and puts it back: threads never share one.
    """

    def __init__(self, kernel: BoundKernel, constant: Mapping[str, Array]) -> None:
        """Take a kernel whose code works on one row at a time, and inputs that are the same in every call."""
        self._kernel, self._constant = kernel, constant
        self._idle: list[_PreparedCall] = []

    def results(self, given: Mapping[str, ArrayLike]) -> tuple[Array, ...] | None:
        """Run on inputs by name; None unless each is an array of exactly its shape and element type."""
        try:  # `pop` and `append` are atomic
            call = self._idle.pop()
        except IndexError:
            call = self._prepare()
        inputs, copies, run = call
        try:
            for name, view in inputs:
                value = given[name]
                if type(value) is not _ARRAY:
                    return None
                view[:] = value  # copies; ValueError if shape or element type differ
            run()
            return (copies[0](),) if len(copies) == 1 else tuple([copy() for copy in copies])
        except ValueError:
            return None
        finally:
            self._idle.append(call)

    def _prepare(self) -> _PreparedCall:
        kernel = self._kernel
        specs = (*kernel.inputs, *kernel.outputs)
        arrays: dict[str, Any] = {spec.name: np.zeros(spec.stride, spec.dtype) for spec in specs}
        inputs: list[tuple[str, Any]] = []
        for spec in kernel.inputs:
            if spec.name in self._constant:
                arrays[spec.name][:] = self._constant[spec.name]
            else:
                inputs.append((spec.name, memoryview(arrays[spec.name])))
        copies = [arrays[spec.name].copy for spec in kernel.outputs]
        return inputs, copies, KernelCall(kernel, arrays).of_one_row()


# Views of the inputs by name, functions that copy the outputs, and the one that computes these from those.
_PreparedCall = tuple[list[tuple[str, Any]], list[Callable[[], Array]], Callable[[], None]]
_ARRAY = np.ndarray

_ONE_ROW = ctypes.PYFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)


def one_row_call(address: int, buffers: int) -> partial[None]:
    """Make a function that runs the kernel at an address on row 0, given the address of its table of arrays.

    It holds on to the interpreter: the work is shorter than releasing it. Arguments are converted beforehand,
    so they cost nothing.
    """
    return partial(_ONE_ROW(address), ctypes.c_int64(0), ctypes.c_int64(1), ctypes.c_void_p(buffers))


def address_of(array: Array) -> int:
    """Address of the first element of a contiguous array."""
    buffer: Any = array
    try:  # four times as fast as the other way, but not for what is read-only or empty
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    except (TypeError, ValueError):
        return array.ctypes.data


def buffer_table(*arrays: Array) -> NDArray[np.int64]:
    """Addresses of C-contiguous float64 arrays, for a kernel called from compiled loops.

    The table does not keep the arrays alive.
    """
    for position, array in enumerate(arrays):
        if array.dtype != np.float64 or not array.flags.c_contiguous:
            raise ValueError(
                f"buffer {position} has dtype {array.dtype} and strides {array.strides}; "
                "a kernel needs C-contiguous float64"
            )
    return np.array([address_of(array) for array in arrays], dtype=np.int64)


def run_kernel(address: int, begin: int, end: int, buffers: NDArray[np.int64]) -> None:
    """Run the kernel at an address on rows begin .. end - 1 of the arrays of a `buffer_table`."""
    _function_at(address)(begin, end, address_of(buffers))


_function_at = cache(native.KernelFunction)


def rows_of(inputs: Mapping[str, ArrayLike], dtype: DTypeLike) -> tuple[int, bool, dict[str, Array]]:
    """Broadcast inputs, (n,) or (B, n) by name, to rows; `h` is shared by all of them.

    Returns the number of rows, whether there is a batch axis, and the arrays.
    """
    arrays = {name: real_array(name, value, dtype) for name, value in inputs.items()}
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


_ROWS = 256  # steps at a time: their states stay in a near cache


def walk(
    kernel: BoundKernel,
    start: Array,
    handed_on: Mapping[str, Array],
    inputs: Mapping[str, Array],
    steps: int,
    h: Array | None = None,
    every: int = 1,
) -> Array:
    """Take many steps in a row; machine code walks down rows that it has just written.

    The inputs are arrays with a row for each step. What a kernel hands on besides the state is given by its
    name, as it is at the start. Returns the start, and the states after every so many steps, shape (steps //
    every + 1, n_x).
    """
    rows, dtype = min(steps, _ROWS), start.dtype
    moving = {name: np.empty((rows + 1, len(first)), dtype) for name, first in handed_on.items()}
    states = moving["x"] = np.empty((rows + 1, len(start)), dtype)
    for name, first in {**handed_on, "x": start}.items():
        moving[name][0] = first
    held = {name: np.empty((rows, array.shape[1]), dtype) for name, array in inputs.items()}
    # Each row's successor is the row below it.
    arrays = {**moving, **{f"{name}_next": array[1:] for name, array in moving.items()}, **held}
    if h is not None:
        arrays["h"] = h
    call = KernelCall(kernel, arrays)
    result = np.empty((steps // every + 1, len(start)), dtype)
    result[0] = start
    for done in range(0, steps, rows):
        count = min(rows, steps - done)
        for name, array in inputs.items():
            held[name][:count] = array[done : done + count]
        call(count)
        kept = np.arange(done // every + 1, (done + count) // every + 1)
        result[kept] = states[kept * every - done]
        for array in moving.values():
            array[0] = array[count]
    return result
