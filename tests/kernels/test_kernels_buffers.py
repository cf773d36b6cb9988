import ctypes
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env.kernels.bound import buffer_table, run_kernel

SIGNATURE = ctypes.CFUNCTYPE(
    None, ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.POINTER(ctypes.c_double))
)


def test_kernel_gets_its_rows_and_buffers() -> None:
    def double(begin: int, end: int, buffers: Any) -> None:
        for k in range(begin, end):
            buffers[1][k] = 2.0 * buffers[0][k]

    callback = SIGNATURE(double)
    source, target = np.arange(5.0), np.zeros(5)
    address = ctypes.cast(callback, ctypes.c_void_p).value
    run_kernel(address, 1, 4, buffer_table(source, target))
    assert target.tolist() == [0.0, 2.0, 4.0, 6.0, 0.0]


@pytest.mark.parametrize("array", [np.zeros((4, 4))[:, :2], np.zeros(3, np.float32), np.zeros((3, 3)).T[:2]])
def test_buffers_that_kernels_cannot_read_are_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"buffer 1 .* C-contiguous float64"):
        buffer_table(np.zeros(3), array)
