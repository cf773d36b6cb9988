"""How compiled solver loops call native kernels: a function pointer, a range of rows, a table of buffers.

A kernel is a C function ``void kernel(int64 begin, int64 end, const int64 *buffers)``. The table holds the
addresses of C-contiguous float64 arrays; for every row k in [begin, end) the kernel reads row k of its
inputs and writes row k of its outputs. Numba code receives the kernel as a plain int64 address, so one
compiled loop serves every robot and can be cached on disk.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from experts.compilation import compiled

BufferTable = NDArray[np.int64]


def _emit_call(typing_context: Any, address: Any, begin: Any, end: Any, buffers: Any) -> Any:
    """Emit the code of `call_kernel`."""
    signature = types.void(types.int64, types.int64, types.int64, types.Array(types.int64, 1, "C"))

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address_value, begin_value, end_value, table_value = arguments
        int64 = ir.IntType(64)
        table = context.make_array(signature.args[3])(context, builder, table_value)
        function_type = ir.FunctionType(ir.VoidType(), [int64, int64, int64.as_pointer()])
        function = builder.inttoptr(address_value, function_type.as_pointer())
        builder.call(function, [begin_value, end_value, builder.bitcast(table.data, int64.as_pointer())])
        return context.get_dummy_value()

    return signature, generate


call_kernel: Any = intrinsic(_emit_call)
"""Call a native kernel from compiled code: ``call_kernel(address, begin, end, buffers)``.

The address is an int64, the rows are [begin, end), and the buffers an int64 array with the addresses of the
kernel's arrays in its own order.
"""


def buffer_table(*arrays: NDArray[np.float64]) -> BufferTable:
    """Collect the addresses of arrays in the order in which a kernel expects them.

    The table does not keep the arrays alive: whoever holds the table must hold them as well.

    Args:
        *arrays: C-contiguous float64 arrays of any shape; the first axis counts rows.

    Returns:
        Addresses, int64, shape (n_arrays,).

    Raises:
        ValueError: If an array is not C-contiguous float64.
    """
    for position, array in enumerate(arrays):
        if array.dtype != np.float64 or not array.flags.c_contiguous:
            raise ValueError(
                f"buffer {position} has dtype {array.dtype} and strides {array.strides}; "
                "a kernel needs C-contiguous float64"
            )
    return np.array([array.ctypes.data for array in arrays], dtype=np.int64)


@compiled
def run_kernel(address: int, begin: int, end: int, buffers: BufferTable) -> None:
    """Call a native kernel from Python.

    Args:
        address: Address of the kernel.
        begin: First row.
        end: One past the last row.
        buffers: Addresses of the kernel's arrays in its own order, shape (n_buffers,).
    """
    call_kernel(address, begin, end, buffers)
