"""Arrays of real numbers from what callers give."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

SINGLE, DOUBLE = np.dtype(np.float32), np.dtype(np.float64)


def real_array(name: str, values: ArrayLike, dtype: DTypeLike | None = None) -> NDArray[Any]:
    """Take values as an array of real numbers, without a copy where that is possible.

    NumPy alone would drop imaginary parts and masks, count dates in nanoseconds, and read text as numbers.

    Args:
        name: What they are, for the message.
        values: Real numbers, any shape.
        dtype: Type of the result; that of the values by default.

    Returns:
        The array, of the same shape.

    Raises:
        TypeError: If the values are masked, or anything but real numbers.
        ValueError: If the rows differ in length.
    """
    if isinstance(values, np.ma.MaskedArray):
        raise TypeError(f"{name}: a masked array, should be real numbers without a mask; fill it first")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name}: rows that differ in length, should be an array of real numbers") from error
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name}: of type {array.dtype}, should be real numbers")
    return array if dtype is None else array.astype(dtype, copy=False)
