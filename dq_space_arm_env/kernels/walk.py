"""Many steps in a row: machine code walks down rows that it has just written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall

if TYPE_CHECKING:
    from dq_space_arm_env.kernels.kernels import Kernels

Array = NDArray[Any]

_ROWS = 256  # steps at a time: their states stay in a near cache


def walk(
    kernels: Kernels, kernel: BoundKernel, start: Array, inputs: Array, h: Array, steps: int, every: int
) -> Array:
    """Take steps.

    Args:
        kernels: Functions of the scene.
        kernel: Its program `walk`, for one lane.
        start: State, shape (n_x,).
        inputs: Shape (n_u,), or (steps, n_u).
        h: Time step, shape (1,), s.
        steps: How many.
        every: Which states to keep.

    Returns:
        Start, and the states after every so many steps, shape (steps // every + 1, n_x).
    """
    rows, dtype = min(steps, _ROWS), kernels.dtype
    states, momenta = np.empty((rows + 1, kernels.n_x), dtype), np.empty((rows + 1, 6), dtype)
    states[0], held = start, np.empty((rows, kernels.n_u), dtype)
    # Each row's successor is the row below it.
    arrays = {"x": states, "x_next": states[1:], "u": held, "h": h}
    if any(spec.name == "momentum" for spec in kernel.inputs):
        momenta[0] = kernels.momentum(start)
        arrays |= {"momentum": momenta, "momentum_next": momenta[1:]}
    call = KernelCall(kernel, arrays)
    result = np.empty((steps // every + 1, kernels.n_x), dtype)
    result[0] = start
    for done in range(0, steps, rows):
        count = min(rows, steps - done)
        held[:count] = inputs if inputs.ndim == 1 else inputs[done : done + count]
        call(count)
        kept = np.arange(done // every + 1, (done + count) // every + 1)
        result[kept] = states[kept * every - done]
        states[0], momenta[0] = states[count], momenta[count]
    return result
