"""The compiled step of many copies: where their states are, and the one call that moves all of them."""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.bound import ArraySpec, BoundKernel
from dq_space_arm_env.kernels.report import FLAGS, MEMORY, REPORT
from dq_space_arm_env.kernels.threads import run_shared

Array = NDArray[Any]
Mask = NDArray[np.bool_]


class StepResult(NamedTuple):
    """What a step returns, in arrays that are the caller's.

    Attributes:
        observations: Shape (num_envs, n_obs).
        report: A row for each name in `REPORT`, shape (len(REPORT), num_envs).
        flags: A row for each name in `FLAGS`, shape (len(FLAGS), num_envs).
    """

    observations: Array
    report: Array
    flags: Mask


class VectorStep:
    """States of copies, and their step.

    A step reads one set of states and writes another; then the two change places. So a step that is refused
    has changed nothing.

    Attributes:
        x: States, shape (num_envs, n_x).
        memory: What steps hand on, an entry for each name in `MEMORY`, shape (num_envs, len(MEMORY)).
        parameters: What each copy's episode has drawn besides the state, shape (num_envs, n_p).
    """

    def __init__(self, kernels: Kernels, num_envs: int) -> None:
        """Make room for the copies.

        Args:
            kernels: Functions of the scene.
            num_envs: Number of copies.
        """
        self._kernels, self._num_envs = kernels, num_envs
        start = {spec.name: spec.stride for spec in kernels.kernel("environment_start").outputs}
        self.parameters = np.zeros((num_envs, start.get("parameters", 0)), kernels.dtype)
        self.x, self._x_next = (np.zeros((num_envs, kernels.n_x), kernels.dtype) for _ in range(2))
        self.memory, self._memory_next = (np.zeros((num_envs, len(MEMORY)), kernels.dtype) for _ in range(2))
        kernel = self._kernel(np.dtype(np.float64))
        observation = next(spec for spec in kernel.outputs if spec.name == "observation")
        self._observation_shape = (num_envs, observation.stride)
        self._action_shape = (num_envs, kernels.n_u)
        self._slots = _slots((*kernel.inputs, *kernel.outputs))
        self._buffers, self._buffers_next = self._addresses(), self._addresses(swapped=True)

    def _kernel(self, dtype: np.dtype[Any]) -> BoundKernel:
        """The step for actions of a type."""
        name = "environment_step_float32_actions" if dtype == np.float32 else "environment_step"
        return self._kernels.kernel(name)

    def _addresses(self, *, swapped: bool = False) -> Any:
        """Addresses of all arrays in the order of the kernel; those of a step's own are filled in by it."""
        now, after = (self.x, self.memory), (self._x_next, self._memory_next)
        if swapped:
            now, after = after, now
        arrays = {"x": now[0], "memory": now[1], "x_kept": after[0], "memory_kept": after[1]}
        arrays["parameters"] = self.parameters
        buffers = (ctypes.c_int64 * (max(self._slots.values()) + 2))()
        for name, slot in self._slots.items():
            if name in arrays:
                buffers[slot] = arrays[name].ctypes.data
        for name in ("report", "flags"):
            buffers[self._slots[name] + 1] = self._num_envs  # from one column to the next
        return buffers

    def empty_result(self) -> StepResult:
        """Fresh arrays of the shapes that a step returns, with arbitrary contents."""
        return StepResult(
            np.empty(self._observation_shape, self._kernels.dtype),
            np.empty((len(REPORT), self._num_envs)),
            np.empty((len(FLAGS), self._num_envs), np.bool_),
        )

    def __call__(self, actions: ArrayLike, ignored: NDArray[np.int64]) -> StepResult:
        """Move all copies.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u).
            ignored: Copies that are about to be reset: their actions do not matter, whatever they are.

        Returns:
            What the copies see and report.

        Raises:
            ValueError: If the actions have a wrong shape, or NaN where they matter; nothing has changed then.
        """
        values = np.asarray(actions)
        if values.shape != self._action_shape:
            raise ValueError(f"actions: shape {values.shape}, should be {self._action_shape}")
        values = np.ascontiguousarray(values, np.float32 if values.dtype == np.float32 else np.float64)
        result, slots, buffers = self.empty_result(), self._slots, self._buffers
        buffers[slots["action"]] = _address(values)
        buffers[slots["observation"]] = _address(result.observations)
        buffers[slots["report"]] = _address(result.report)
        buffers[slots["flags"]] = _address(result.flags)
        function = self._kernel(values.dtype).native.function
        run_shared(function, self._num_envs, ctypes.addressof(buffers), self._kernels.threads)
        if np.count_nonzero(result.flags[_DIVERGED]):
            _refuse_nan(values, ignored)
        self.x, self._x_next = self._x_next, self.x
        self.memory, self._memory_next = self._memory_next, self.memory
        self._buffers, self._buffers_next = self._buffers_next, self._buffers
        return result


_DIVERGED = FLAGS.index("diverged")


def _slots(specs: tuple[ArraySpec, ...]) -> dict[str, int]:
    """Where each array's address stands; that of an array by column is followed by the columns' distance."""
    slots, position = {}, 0
    for spec in specs:
        slots[spec.name] = position
        position += 2 if spec.by_column else 1
    return slots


def _address(array: Array) -> int:
    """Address of a contiguous array."""
    if array.flags.writeable:  # three times as fast as the other way
        buffer: Any = array
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    return array.ctypes.data


def _refuse_nan(actions: Array, ignored: NDArray[np.int64]) -> None:
    """Raise ValueError if diverged states are the work of actions that are not numbers."""
    missing: Mask = np.asarray(np.isnan(actions).any(axis=1))
    missing[ignored] = False
    if missing.any():
        copies = np.flatnonzero(missing).tolist()
        raise ValueError(f"actions: NaN for copies {copies}, should be numbers in [-1, 1]")
