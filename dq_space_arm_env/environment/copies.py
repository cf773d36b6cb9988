"""Many copies of an environment: their states, and the calls that begin, observe and move them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.compiler.random_draws import draws_kernel, generator_states
from dq_space_arm_env.environment.results import ResultArrays, StepResult
from dq_space_arm_env.environment.start_options import GivenStart
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall
from dq_space_arm_env.kernels.report import FLAGS, MEMORY
from dq_space_arm_env.scene.start import number_of_draws

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_TERMINATED, _DIVERGED = FLAGS.index("terminated"), FLAGS.index("diverged")


class Copies:
    """States of copies, and what happens to them.

    A step reads one set of states and writes another; then the two change places. So a step that is refused
    has changed nothing.

    Attributes:
        count: Number of copies.
        x: States, shape (count, n_x).
        parameters: What each copy's episode has drawn besides the state, shape (count, n_p).
    """

    def __init__(self, kernels: Kernels, count: int) -> None:
        """Make room for the copies.

        Args:
            kernels: Functions of the scene.
            count: Number of copies.
        """
        self.count, self._kernels = count, kernels
        start, observe = kernels.kernel("environment_start"), kernels.kernel("environment_observe")
        sizes = {spec.name: spec.stride for spec in (*start.outputs, *observe.outputs)}
        self.x, self._x_next = (np.zeros((count, kernels.n_x), kernels.dtype) for _ in range(2))
        self._memory, self._memory_next = (np.zeros((count, len(MEMORY)), kernels.dtype) for _ in range(2))
        self.parameters = np.zeros((count, sizes.get("parameters", 0)), kernels.dtype)
        self._draws = np.zeros((count, number_of_draws(kernels.scene)))
        self._generators = np.zeros((count, 4), dtype=np.uint64)
        self._results = ResultArrays((count, sizes["observation"]), kernels.dtype)
        self._action_shape = (count, kernels.n_u)

        drawing = BoundKernel(draws_kernel(self._draws.shape[1]))
        self._draw = KernelCall(drawing, {"states": self._generators, "draws": self._draws})
        constant = {"draws": self._draws, "parameters": self.parameters}
        self._start = KernelCall(start, constant)
        self._observe = KernelCall(observe, constant | self._results.fresh()._asdict())
        self._steps = self._step_calls(kernels)
        self._swap()
        self._steps_next = self._step_calls(kernels)
        self._swap()

    def _step_calls(self, kernels: Kernels) -> dict[type, KernelCall]:
        """The step by the type of the actions, from the present arrays of states to the others."""
        arrays = {"x": self.x, "x_kept": self._x_next, "parameters": self.parameters}
        arrays |= {"memory": self._memory, "memory_kept": self._memory_next}
        arrays |= self._results.fresh()._asdict()
        names = {np.float64: "environment_step", np.float32: "environment_step_float32_actions"}
        return {kind: KernelCall(kernels.kernel(name), arrays) for kind, name in names.items()}

    def _swap(self) -> None:
        """Let the two sets of states change places."""
        self.x, self._x_next = self._x_next, self.x
        self._memory, self._memory_next = self._memory_next, self._memory

    def seed(self, rows: Rows, seeds: Sequence[int | None]) -> None:
        """Renew random generators.

        Args:
            rows: Numbers of the copies.
            seeds: Seed of each of them; None for an unpredictable one.

        Raises:
            ValueError: If a seed is negative.
        """
        self._generators[rows] = generator_states(seeds)

    def begin(self, rows: Rows, given: GivenStart | None = None) -> None:
        """Put copies at the start of an episode.

        Args:
            rows: Numbers of the copies.
            given: What is not to be drawn, by each copy from its own generator, of their starts; None to draw
                all of it.
        """
        if given is None or given.state is None:
            self._draw.on_rows(rows)
        else:
            self._draws[rows] = 0.0
        self._start.place(x=self.x, memory=self._memory)
        self._start.on_rows(rows)
        if given is not None:
            x, parameters = self.x[rows], self.parameters[rows]
            given.apply(self._kernels, x, parameters)
            self.x[rows], self.parameters[rows] = x, parameters

    def observe(self, rows: Rows, result: StepResult | None = None) -> StepResult:
        """Find out what copies see, without a step.

        Args:
            rows: Numbers of the copies.
            result: Where to put it; None for arrays that hold nothing of use for other copies.

        Returns:
            What they see and report: no costs, and no end of an episode.
        """
        seen = self._results.fresh() if result is None else result
        self._observe.place(x=self.x, memory=self._memory, memory_kept=self._memory, **seen._asdict())
        self._observe.on_rows(rows)
        return seen

    def step(self, actions: ArrayLike, ignored: Rows) -> StepResult:
        """Move all copies.

        Args:
            actions: Inputs as fractions of their limits, shape (count, n_u).
            ignored: Copies that are about to begin anew: their actions do not matter, whatever they are.

        Returns:
            What they see and report.

        Raises:
            ValueError: If the actions have a wrong shape, or NaN where they matter; nothing has changed then.
        """
        values = np.asarray(actions)
        if values.shape != self._action_shape:
            raise ValueError(f"actions: shape {values.shape}, should be {self._action_shape}")
        values = np.ascontiguousarray(values, np.float32 if values.dtype == np.float32 else np.float64)
        result, call = self._results.take(), self._steps[values.dtype.type]
        observation, report, flags = result
        call.place(action=values, observation=observation, report=report, flags=flags)
        call(self.count, self._kernels.threads)
        # What has diverged is over, and hardly anything ever is: one look is enough.
        if np.count_nonzero(flags[_TERMINATED]) and flags[_DIVERGED].any():
            _refuse_nan(values, ignored)
        self._swap()
        self._steps, self._steps_next = self._steps_next, self._steps
        return result


def _refuse_nan(actions: Array, ignored: Rows) -> None:
    """Raise ValueError if diverged states are the work of actions that are not numbers."""
    missing: Mask = np.asarray(np.isnan(actions).any(axis=1))
    missing[ignored] = False
    if missing.any():
        copies = np.flatnonzero(missing).tolist()
        raise ValueError(f"actions: NaN for copies {copies}, should be numbers in [-1, 1]")
