"""Pickles read without executing them: numbers, text, containers and arrays; everything else stays inert.

Unpickling calls whatever a pickle names. Here nothing is called: what a pickle would make is kept as an
`Inert` that records name, arguments and state, and arrays are rebuilt from their bytes.
"""

from __future__ import annotations

import io
import math
import pickle
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

_ARRAYS = {
    f"{package}.{name}"
    for package in ("numpy.core", "numpy._core")
    for name in ("numeric._frombuffer", "multiarray._reconstruct")
}
_KINDS = {"f4", "f8"}


class PickledError(ValueError):
    """Not a pickle, or damaged, or of a kind that is not read."""


class _Named:
    """A class or function that a pickle names; calling it makes an `Inert`."""

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, *arguments: Any) -> Inert:
        return Inert(self.name, arguments)


class Inert:
    """An object that a pickle would make: its class or function, arguments, and state."""

    __slots__ = ("arguments", "name", "state")

    def __init__(self, name: str, arguments: tuple[Any, ...]) -> None:
        self.name, self.arguments = name, arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Reader(pickle._Unpickler):
    """Python's own unpickler, without the instructions that call, share memory, or hash what they read."""

    stack: list[Any]
    append: Any  # of the stack
    read: Any  # of the pickle
    pop_mark: Any
    dispatch: ClassVar[dict[int, Any]] = {
        code: handle
        for code, handle in pickle._Unpickler.dispatch.items()
        if code
        not in b"".join(
            (
                pickle.PERSID,
                pickle.BINPERSID,
                pickle.INST,
                pickle.OBJ,
                pickle.NEWOBJ_EX,
                pickle.EXT1,
                pickle.EXT2,
                pickle.EXT4,
                pickle.NEXT_BUFFER,
                pickle.READONLY_BUFFER,
                pickle.EMPTY_SET,
                pickle.FROZENSET,
                pickle.ADDITEMS,
                pickle.DICT,
            )
        )
    }

    def find_class(self, module_name: str, global_name: str) -> Any:
        return _Named(f"{module_name}.{global_name}")

    def _make(self) -> None:
        arguments, kind = self.stack.pop(), self.stack.pop()
        if not isinstance(kind, _Named) or not isinstance(arguments, tuple):
            raise PickledError("calls what is no name")
        # Observations by name are ordered dictionaries in `DummyVecEnv`; made empty, filled like others.
        is_mapping = kind.name == "collections.OrderedDict" and not arguments
        self.append({} if is_mapping else kind(*arguments))

    def _set_items(self) -> None:
        items = self.pop_mark()
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._set(key, value)

    def _set_item(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set(key, value)

    def _set(self, key: Any, value: Any) -> None:
        # Hashing nested tuples could take for ever.
        if not isinstance(key, str | int) or not isinstance(self.stack[-1], dict):
            raise PickledError("has a key that is no text")
        self.stack[-1][key] = value

    def _append_bytes(self) -> None:
        # Python's own allocates what the pickle claims before it reads what there is.
        size = int.from_bytes(self.read(8), "little")
        content = self.read(size)
        if len(content) < size:
            raise PickledError("claims more bytes than it has")
        self.append(bytearray(content))

    dispatch |= {
        pickle.BYTEARRAY8[0]: _append_bytes,
        pickle.REDUCE[0]: _make,
        pickle.NEWOBJ[0]: _make,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
    }


def read_pickled(content: bytes) -> Any:
    """Read a pickle; nothing in it is executed.

    Args:
        content: Its bytes.

    Returns:
        Numbers, text, lists, tuples and dictionaries; `Inert` in place of all other objects.

    Raises:
        PickledError: If it is damaged, or of an unusual kind.
    """
    try:
        return _Reader(io.BytesIO(content)).load()
    except PickledError:
        raise
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        EOFError,
        LookupError,
        MemoryError,
        RecursionError,
        TypeError,
        ValueError,
        pickle.UnpicklingError,
    ) as error:
        reason = str(error).partition("\n")[0][:80] or "it ends early"
        raise PickledError(f"damaged ({reason})") from error


def as_array(value: Any) -> NDArray[np.float64] | None:
    """An array of floats that `read_pickled` has found, or None if it is none."""
    try:
        return _rebuilt(value)
    except (AttributeError, LookupError, TypeError, ValueError):
        return None


def _rebuilt(value: Any) -> NDArray[np.float64] | None:
    """Rebuild an array from what NumPy pickles: `_frombuffer(bytes, dtype, shape, order)` or a state."""
    if not isinstance(value, Inert) or value.name not in _ARRAYS:
        return None
    if value.name.endswith("_frombuffer"):
        content, kind, shape, order = value.arguments
    else:
        _, shape, kind, is_fortran, content = value.state
        order = "F" if is_fortran else "C"
    if not isinstance(content, bytes | bytearray):  # of a number, `bytes` would make as many zeros
        return None
    if kind.arguments[0] not in _KINDS or kind.state[1] not in "<>":
        return None
    numbers = np.frombuffer(content, dtype=kind.state[1] + kind.arguments[0])
    if not all(isinstance(size, int) for size in shape) or math.prod(shape) != numbers.size:
        return None
    return numbers.reshape(shape, order=order).astype(np.float64)
