"""The sub-environments of the vector environment: their states, and the compiled calls that move them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from sys import getrefcount
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.compiler.random_draws import draws_kernel, generator_states
from dq_space_arm_env.environment.reset_options import GivenStart
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall, address_of
from dq_space_arm_env.kernels.stages import present_parameters
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.path import PATH, given_path
from dq_space_arm_env.scene.start import number_of_draws
from dq_space_arm_env.task.step_report import FLAGS, MEMORY, memory_names, report_names

Array = NDArray[Any]
Rows = NDArray[np.int64]

_TERMINATED, _DIVERGED = FLAGS.index("terminated"), FLAGS.index("diverged")
_SPARES = 4  # a training loop holds the results of the last step or two
_PADDING = 8  # numbers between rows of a report; those of 1024 copies would fall on the same lines of a cache


class StepResult(NamedTuple):
    """Arrays that a step fills."""

    observation: Any  # shape (count, n_obs); of goal environments, such arrays by name
    report: NDArray[np.float64]  # a row for each of `report_names`, shape (len(report_names(scene)), count)
    flags: NDArray[np.bool_]  # a row for each name in FLAGS, shape (len(FLAGS), count)
    addresses: Mapping[str, int]  # of the arrays that compiled functions write, by their names


class _Calls:
    """Compiled functions, bound to one of two sets of states."""

    def __init__(self, kernels: Kernels, arrays: Mapping[str, Array], after: Mapping[str, Array]) -> None:
        """Bind them to arrays; a step writes `after` in place of some."""
        self._kernels, self._arrays = kernels, {**arrays, **after}
        self.start = KernelCall(kernels.kernel("environment_start"), arrays)
        self.observe = KernelCall(kernels.kernel("environment_observe"), arrays)
        self._steps: dict[type, KernelCall] = {}
        self.step(np.float32)  # the type of the action space; who has other actions waits at the first

    def step(self, kind: type) -> KernelCall:
        """The step for actions of a type."""
        if kind not in self._steps:
            name = "environment_step" if kind is np.float64 else "environment_step_float32_actions"
            self._steps[kind] = KernelCall(self._kernels.kernel(name), self._arrays)
        return self._steps[kind]


class SubEnvironments:
    """States of sub-environments, and what happens to them.

    A step reads one set of states and writes another, then the two swap; so a step that raises has changed
    nothing.
    """

    def __init__(self, kernels: Kernels, count: int) -> None:
        self.count, self._kernels = count, kernels
        start, observe = kernels.kernel("environment_start"), kernels.kernel("environment_observe")
        sizes = {spec.name: spec.stride for spec in (*start.outputs, *observe.outputs)}
        self.x, self._x_next = (np.zeros((count, kernels.n_x), kernels.dtype) for _ in range(2))
        size = len(memory_names(kernels.scene))
        self._memory, self._memory_next = (np.zeros((count, size), kernels.dtype) for _ in range(2))
        self.parameters = np.zeros((count, sizes.get("parameters", 0)), kernels.dtype)
        self._draws = np.zeros((count, number_of_draws(kernels.scene)))
        self._generators = np.zeros((count, 4), dtype=np.uint64)
        rows = len(report_names(kernels.scene))
        self._results = _ResultArrays((count, sizes["observation"]), rows, kernels.dtype)
        self._action_shape = (count, kernels.n_u)
        self._path: Array | None = None  # of a target that passes waypoints
        if isinstance(kernels.scene.target.motion, Waypoints):
            self._path = given_path(kernels.scene, kernels.scene.simulation.steps).astype(kernels.dtype)
        self._following = np.zeros((count, PATH), kernels.dtype)

        drawing = BoundKernel(draws_kernel(self._draws.shape[1]))
        self._draw = KernelCall(drawing, {"states": self._generators, "draws": self._draws})
        self._calls = self._calls_next = self._bound()
        self._swap()
        self._calls = self._bound()

    def _bound(self) -> _Calls:
        """Calls that read the present arrays of states; a step writes the others."""
        arrays = {"x": self.x, "memory": self._memory, "memory_kept": self._memory, "draws": self._draws}
        arrays |= {"parameters": self.parameters, "episode_parameters": self.parameters}
        arrays |= self._results.fresh()._asdict()
        after = {"x_kept": self._x_next, "memory_kept": self._memory_next, "following": self._following}
        return _Calls(self._kernels, arrays, after)

    def _swap(self) -> None:
        self.x, self._x_next = self._x_next, self.x
        self._memory, self._memory_next = self._memory_next, self._memory
        self._calls, self._calls_next = self._calls_next, self._calls

    def kept(self) -> dict[str, Array]:
        """Arrays that all later steps and resets depend on."""
        return {
            "x": self.x,
            "memory": self._memory,
            "parameters": self.parameters,
            "generator": self._generators,
        }

    def stage_parameters(self, rows: Rows | slice = slice(None)) -> Array:
        """Parameters with pose and velocity of moving targets as they are now, shape (k, n_p); a copy."""
        return present_parameters(self._kernels, self.parameters[rows], self._memory[rows])

    def seed(self, rows: Rows, seeds: Sequence[int | None]) -> None:
        """Seed random generators, unpredictably for None; a negative seed is a ValueError."""
        self._generators[rows] = generator_states(seeds)

    def begin(self, rows: Rows, given: GivenStart | None = None) -> None:
        """Put sub-environments at the start of an episode, drawn except for what is given."""
        if given is None or given.state is None:
            self._draw.on_rows(rows)
        else:
            self._draws[rows] = 0.0
        self._calls.start.on_rows(rows)
        if given is not None:
            x, parameters = self.x[rows], self.parameters[rows]
            given.apply(self._kernels, x, parameters)
            self.x[rows], self.parameters[rows] = x, parameters
            moving = list(self._kernels.parameters.moving)
            self._memory[rows, len(MEMORY) : len(MEMORY) + len(moving)] = parameters[:, moving]

    def observe(self, rows: Rows, result: StepResult | None = None) -> StepResult:
        """Observe without a step: no costs, no end of an episode.

        Without arrays for the result it takes new ones, whose other rows are arbitrary.
        """
        seen = self._results.fresh() if result is None else result
        self._calls.observe.place_at(seen.addresses)
        self._calls.observe.on_rows(rows)
        return seen

    def observe_states(self, x: Array) -> Any:
        """Observations of other states, shape (count, n_x), at the present times."""
        seen = self._results.fresh()
        x = np.ascontiguousarray(x, self.x.dtype)
        observe = self._calls.observe
        observe.place(x=x, memory_kept=self._memory_next)
        observe.place_at(seen.addresses)
        observe.on_rows(np.arange(self.count))
        observe.place(x=self.x, memory_kept=self._memory)
        return seen.observation

    def move(self, rows: Rows, x: Array) -> None:
        """Change states in mid-episode."""
        self.x[rows] = x
        self.observe(rows)  # the memory holds cost terms of the state

    def step(self, actions: ArrayLike, resetting: Rows) -> StepResult:
        """Step all sub-environments; actions of those about to be reset do not matter.

        Raises:
            TypeError: If the actions are masked, or not of real numbers.
            ValueError: If the actions have a wrong shape, or NaN where they matter; nothing has changed then.
        """
        values = real_array("actions", actions)
        if values.shape != self._action_shape:
            raise ValueError(f"actions: shape {values.shape}, should be {self._action_shape}")
        values = np.ascontiguousarray(values, np.float32 if values.dtype == np.float32 else np.float64)
        result, call = self._results.take(), self._calls.step(values.dtype.type)
        if self._path is not None:
            stages = np.minimum(self._memory[:, 0].astype(np.int64) + 1, len(self._path) - 1)
            np.take(self._path, stages, axis=0, out=self._following)
        call.place(action=values)
        call.place_at(result.addresses)
        call(self.count, self._kernels.threads)
        # NaN diverges, and hardly anything else does: looking for it after the step costs nothing.
        if np.count_nonzero(result.flags[_TERMINATED]) and result.flags[_DIVERGED].any():
            _refuse_nan(values, resetting)
        self._swap()
        return result


def _refuse_nan(actions: Array, resetting: Rows) -> None:
    """Raise ValueError if actions that are NaN made states diverge."""
    missing = np.asarray(np.isnan(actions).any(axis=1))
    missing[resetting] = False
    if missing.any():
        rows = np.flatnonzero(missing).tolist()
        raise ValueError(f"actions: NaN for sub-environments {rows}, should be numbers in [-1, 1]")


class _ResultArrays:
    """Hands out arrays for results to which no other reference, or view, is left.

    Fresh arrays of hundreds of kilobytes at every step would have the operating system map and clear pages
    at every step, which can take as long as the physics.
    """

    def __init__(self, observation_shape: tuple[int, int], rows: int, dtype: np.dtype[Any]) -> None:
        self._observation_shape, self._rows, self._dtype = observation_shape, rows, dtype
        self._spares: list[StepResult] = []
        self._holders_of_a_spare = _holders(self.fresh())
        self._next = 0

    def fresh(self) -> StepResult:
        """New arrays, contents arbitrary."""
        count = self._observation_shape[0]
        arrays: dict[str, Array] = {
            "observation": np.empty(self._observation_shape, self._dtype),
            "report": np.empty((self._rows, count + _PADDING))[:, :count],
            "flags": np.empty((len(FLAGS), count), np.bool_),
        }
        addresses = {name: address_of(array) for name, array in arrays.items()}
        return StepResult(**arrays, addresses=addresses)

    def take(self) -> StepResult:
        """Free arrays, used before if possible, contents arbitrary."""
        for spare in self._spares:
            if _holders(spare) == self._holders_of_a_spare:
                return spare
        result = self.fresh()
        if len(self._spares) < _SPARES:
            self._spares.append(result)
        else:
            self._spares[self._next] = result
            self._next = (self._next + 1) % _SPARES
        return result


def _holders(result: StepResult) -> int:
    """References to the arrays of a result; a view holds one to the array that owns the memory."""
    observation, report, flags, _ = result
    return sum(map(getrefcount, (observation, report, report.base, flags)))
