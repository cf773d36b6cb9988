"""The one way in which the solver's loops are compiled by numba."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Loop = TypeVar("Loop", bound=Callable[..., Any])


def compiled(loop: Loop) -> Loop:
    """Compile a loop over arrays, and cache its code on disk.

    Only fused multiply-add may change rounding (``contract``). Numba's memory management is taken away
    (``_nrt``): a loop that allocates does not compile, and no time goes into counting references to arrays,
    which was a third of the backward sweep. The interpreter lock is released.

    Args:
        loop: Function in the part of Python that numba compiles.

    Returns:
        The compiled function.
    """
    return _compile(loop, in_place=False)


def inlined(loop: Loop) -> Loop:
    """Compile as `compiled` does, into the place of every call.

    A matrix is nine arguments, and a named tuple of arrays a hundred or more: passing them takes as long as
    the work of a small function.

    Args:
        loop: Function in the part of Python that numba compiles.

    Returns:
        The compiled function.
    """
    return _compile(loop, in_place=True)


def _compile(loop: Loop, *, in_place: bool) -> Loop:
    """Compile with the options that all loops share."""
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}
    options["forceinline"] = in_place
    return cast(Loop, njit(cache=True, nogil=True, boundscheck=False, **options)(loop))
