"""Kernels written in Python, behind the native calling convention of `compilation`.

Native code cannot pass an exception on. A kernel therefore keeps it, answers NaN without calling anything
from then on, and whoever called the native code raises it: see `PythonKernels.native_calls`.
"""

import ctypes
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Shape = tuple[int, ...]
RowFunction = Callable[..., Sequence[Any]]

_SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)


class PythonKernel:
    """A kernel that calls a function for each row.

    `function` takes an array per input and returns a value per output; `skipped` further inputs, which it
    does not take, stand between both in the table of buffers.
    """

    def __init__(
        self,
        function: RowFunction,
        inputs: Sequence[Shape],
        outputs: Sequence[Shape],
        skipped: int,
        failures: list[BaseException],
    ) -> None:
        self._function, self._inputs, self._outputs = function, inputs, outputs
        self._skipped, self._failures = skipped, failures
        self._callback = _SIGNATURE(self._run)
        address = ctypes.cast(self._callback, ctypes.c_void_p).value
        assert address is not None
        self.address: int = address

    def _run(self, begin: int, end: int, table: int) -> None:
        try:
            if not self._failures:
                self._evaluate(begin, end, table)
        except BaseException as error:
            self._failures.append(error)
        if self._failures:
            for output in self._results(begin, end, table):
                output[...] = np.nan

    def _evaluate(self, begin: int, end: int, table: int) -> None:
        # Copies, for the function may keep its arguments.
        given = [read_only(rows) for rows in _rows(begin, end, table, 0, self._inputs)]
        results = self._results(begin, end, table)
        for k in range(end - begin):
            values = self._function(*(rows[k] for rows in given))
            for rows, shape, value in zip(results, self._outputs, values, strict=True):
                if np.shape(value) != shape:  # it would be spread over the whole array
                    raise ValueError(
                        f"a function returns an array of shape {np.shape(value)}; expected {shape}"
                    )
                rows[k] = value

    def _results(self, begin: int, end: int, table: int) -> list[NDArray[np.float64]]:
        return _rows(begin, end, table, len(self._inputs) + self._skipped, self._outputs)


def read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """A copy that refuses changes."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def _rows(begin: int, end: int, table: int, first: int, shapes: Sequence[Shape]) -> list[NDArray[np.float64]]:
    """Rows begin .. end - 1 of the arrays at positions of a table of addresses."""
    addresses = (ctypes.c_int64 * len(shapes)).from_address(table + 8 * first)
    found = []
    for address, shape in zip(addresses, shapes, strict=True):
        size = int(np.prod(shape))
        memory: Any = (ctypes.c_double * (size * (end - begin))).from_address(address + 8 * size * begin)
        found.append(np.frombuffer(memory).reshape(end - begin, *shape))
    return found


class PythonKernels:
    """Makes kernels that share what failed.

    Attributes:
        failures: Exceptions not raised yet.
    """

    def __init__(self) -> None:
        self.failures: list[BaseException] = []

    def make(
        self, function: RowFunction, inputs: Sequence[Shape], outputs: Sequence[Shape], skipped: int = 0
    ) -> PythonKernel:
        return PythonKernel(function, inputs, outputs, skipped, self.failures)

    @contextmanager
    def native_calls(self) -> Iterator[None]:
        """Surround native code that calls the kernels: raise the first exception after it.

        Ctrl-C on the way into a kernel, where nothing can catch it, is kept as well.
        """
        handled = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        try:
            if handled:
                signal.signal(signal.SIGINT, self._interrupt)
            yield
        finally:
            if handled:
                signal.signal(signal.SIGINT, signal.default_int_handler)
            failures, self.failures[:] = self.failures.copy(), []
        if failures:
            raise failures[0]

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        on_the_way = frame is not None and frame.f_code is PythonKernel._run.__code__
        if not (on_the_way or self.failures):
            raise KeyboardInterrupt
        self.failures.append(KeyboardInterrupt())
