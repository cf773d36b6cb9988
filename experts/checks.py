"""Checks of arguments, with messages that say what would be right."""

import numpy as np

from experts.problem import FloatArray


def check_array(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape, or with an entry that is not finite.

    Args:
        name: Name of the argument.
        array: Its value.
        shape: The shape that it should have.

    Raises:
        ValueError: If it is refused.
    """
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        position = ", ".join(map(str, wrong[0]))
        raise ValueError(f"{name}[{position}] is {array[tuple(wrong[0])]}; every entry must be finite")


def check_at_least(name: str, value: float, smallest: float) -> None:
    """Refuse a setting that is too small, or not a number.

    Args:
        name: Name of the setting.
        value: Its value.
        smallest: Smallest one allowed.

    Raises:
        ValueError: If it is refused.
    """
    if not value >= smallest:
        raise ValueError(f"{name} is {value}; it must be at least {smallest}")


def check_control_weights(luu: FloatArray) -> None:
    """Refuse a problem in which an input has no cost of its own: the damping is scaled by it.

    Args:
        luu: Hessian of the stage cost, control block, shape (N, n_u, n_u).

    Raises:
        ValueError: If it is refused.
    """
    weights = np.diagonal(luu, axis1=1, axis2=2)
    free = weights <= 0.0
    if np.any(free):
        k, i = (int(index[0]) for index in np.nonzero(free))
        raise ValueError(
            f"the cost has the second derivative {weights[k, i]} with respect to input {i} at stage {k}; "
            "every input needs a positive weight"
        )
