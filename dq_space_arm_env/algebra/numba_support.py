"""Lets numba compile the algebra: after `register()`, `@njit` code calls these functions as Python code does.

The package names `register` in its entry point `numba_extensions`, so that numba calls it before it first
compiles anything; nothing here imports numba earlier.
"""

import functools
import inspect
import math
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from dq_space_arm_env.algebra import (
    _series,
    dual_matrices,
    dual_quaternion,
    dual_vectors,
    poses,
    quaternion,
    rotations,
    scalars,
    screw,
    vectors,
)

__all__ = ["register"]

_MODULES = (
    _series,
    vectors,
    quaternion,
    rotations,
    dual_quaternion,
    dual_matrices,
    dual_vectors,
    poses,
    screw,
)


def _functions(module: ModuleType) -> list[FunctionType]:
    """Return the functions that a module defines, private ones too."""
    functions = [member for _, member in inspect.getmembers(module, inspect.isfunction)]
    return [function for function in functions if function.__module__ == module.__name__]


def _register_scalars() -> None:
    """Give numba its own versions of the functions that look at the type of their argument."""
    from numba.extending import overload, register_jitable

    def replace(function: Callable[..., Any], implementation: Callable[..., Any]) -> None:
        overload(function, strict=False)(lambda *arguments: implementation)

    replace(scalars.sin, lambda x: math.sin(x))
    replace(scalars.cos, lambda x: math.cos(x))
    replace(scalars.sqrt, lambda x: math.sqrt(x))
    replace(scalars.arctan2, lambda y, x: math.atan2(y, x))
    replace(scalars.select, lambda condition, if_true, if_false: if_true if condition else if_false)
    register_jitable(scalars.safe_sqrt)
    register_jitable(scalars.maximum)


@functools.cache
def register() -> None:
    """Make every function of the algebra callable from numba's nopython mode; doing it again changes nothing.

    Raises:
        ImportError: numba is not installed.
    """
    from numba.extending import register_jitable

    _register_scalars()
    for module in _MODULES:
        for function in _functions(module):
            register_jitable(function)
