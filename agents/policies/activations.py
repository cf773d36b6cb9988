"""Activation functions of exported networks, in place on arrays."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def tanh(values: Array, spare: Array) -> None:
    """Hyperbolic tangent.

    Args:
        values: Shape (...,), dimensionless; replaced by the result.
        spare: Shape (...,); not used.
    """
    np.tanh(values, out=values)


def silu(values: Array, spare: Array) -> None:
    """Sigmoid-weighted z, z / (1 + exp(-z)), in a form that does not overflow: z / 2 (1 + tanh(z / 2)).

    Args:
        values: z, shape (...,), dimensionless; replaced by the result.
        spare: Shape (...,); overwritten.
    """
    values *= 0.5
    np.tanh(values, out=spare)
    spare += 1.0
    values *= spare


def relu(values: Array, spare: Array) -> None:
    """The larger of z and 0.

    Args:
        values: z, shape (...,), dimensionless; replaced by the result.
        spare: Shape (...,); not used.
    """
    np.maximum(values, 0.0, out=values)


def clip(values: Array, spare: Array) -> None:
    """The nearest number in [-1, 1].

    Args:
        values: Shape (...,), dimensionless; replaced by the result.
        spare: Shape (...,); not used.
    """
    # numpy.clip does the same and takes several times as long for a few numbers.
    np.maximum(values, -1.0, out=values)
    np.minimum(values, 1.0, out=values)


ACTIVATIONS: Mapping[str, Callable[[Array, Array], None]] = {"tanh": tanh, "silu": silu, "relu": relu}
"""Functions between layers, by name."""
SMOOTH = ("tanh", "silu")
"""Those with a derivative everywhere, as matching gains needs it."""
SQUASHES: Mapping[str, Callable[[Array, Array], None]] = {"clip": clip, "tanh": tanh}
"""Functions that bring the last layer's outputs into [-1, 1], by name."""
