"""The result of a solve: trajectory, gains, stop reason and history; and the feedback policy around it."""

import json
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.bounded_formats import read_arrays
from dq_space_arm_env.common.bounded_reading import parse_json
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.kernels.bound import address_of, buffer_table, one_row_call
from experts.ddp.augmented_lagrangian import ConstraintReport
from experts.problems.arm_problem import as_problem
from experts.problems.shooting_problem import (
    FloatArray,
    ShootingProblem,
    rate_limits,
    stage_bounds,
    within_rates,
)

Policy = Callable[[FloatArray, int], FloatArray]


class StopReason(StrEnum):
    """Why a solve ended."""

    CONVERGED = "converged"
    """The predicted reduction of an unregularized step is within the tolerance."""
    MAX_ITERATIONS = "max_iterations"
    """The iterations are used up."""
    PLATEAU = "plateau"
    """Many consecutive iterations hardly reduced the cost, although the model predicts a reduction."""
    REGULARIZATION_LIMIT = "regularization_limit"
    """No step reduces the cost, however short."""
    DIVERGED = "diverged"
    """The first rollout, or a derivative along the trajectory, is not finite."""
    INFEASIBLE = "infeasible"
    """A constraint stays violated however large its penalty."""
    INTERRUPTED = "interrupted"
    """The user interrupted the solve."""


class IterationRecord(NamedTuple):
    """One iteration in numbers; a row of `Solution.history`.

    Attributes:
        iteration: Counts from 1.
        cost: Cost after the iteration, with the penalties of constraints, which may be violated; while gaps
            are open, of a trajectory that is not feasible.
        alpha: Accepted step length, 0 if none was accepted.
        exact: Whether the update used exact second derivatives, or else Gauss-Newton's.
        regularization: mu, in multiples of the control weights.
        expected_decrease: Predicted reduction of the cost by the full step; negative where closing gaps costs
            more than the step gains.
        optimality: That reduction relative to the cost; too small under strong regularization. inf for steps
            from a trajectory with gaps.
        clamped_share: Share of the inputs, over all stages, held at a bound; 0 to 1.
        seconds: Wall-clock time, s.
        derivative_seconds: Part of it spent on derivatives, s.
        sweep_seconds: Part of it spent on backward passes, s.
        rollout_seconds: Part of it spent on rollouts, s.
        gap: Largest norm of a gap step(x_k, u_k) (-) x_k+1 after the iteration, in tangent coordinates; 0
            unless the solve began with a guess of the states.
    """

    iteration: int
    cost: float
    alpha: float
    exact: bool
    regularization: float
    expected_decrease: float
    optimality: float
    clamped_share: float
    seconds: float
    derivative_seconds: float
    sweep_seconds: float
    rollout_seconds: float
    gap: float


Callback = Callable[[IterationRecord], None]


class Stop(NamedTuple):
    """Why a solve ends, and the same in words."""

    reason: StopReason
    message: str


_FIELD_TYPES = {"iteration": np.int64, "exact": np.bool_}
HISTORY_DTYPE = np.dtype([(name, _FIELD_TYPES.get(name, np.float64)) for name in IterationRecord._fields])


@dataclass(eq=False)
class Solution:
    """The best trajectory that a solve found, with feedback gains around it.

    Attributes:
        states: Shape (N + 1, n_x).
        controls: Shape (N, n_u).
        feedback_gains: K of u = u_k + K_k (x (-) x_k), zero in the rows of inputs at a bound, and 1 at the
            previous input where it bounds their rate; shape (N, n_u, n_t).
        cost: Total cost; inf if the first rollout diverged.
        stop_reason: Why the solve ended.
        message: The reason in one sentence, with its numbers.
        optimality: Predicted reduction of an unregularized step, relative to the cost; inf where unknown.
        iterations: Number of iterations.
        history: One row per iteration, fields as in `IterationRecord`.
        parameters: What varies, at every stage and the end, shape (N + 1, n_p).
        multipliers: Those of the constraints along the path, the last row of those at the end, shape
            (N + 1, m), see `StageConstraints`; empty without constraints.
        constraints: How the trajectory keeps to its constraints; None without.
        metadata: JSON values to be saved along, for example the resolved scene.
        problem: The problem solved; None after `load`, in deep copies and in other processes.
    """

    states: FloatArray
    controls: FloatArray
    feedback_gains: FloatArray
    cost: float
    stop_reason: StopReason
    message: str
    optimality: float
    iterations: int
    history: NDArray[np.void]
    parameters: FloatArray
    multipliers: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    constraints: ConstraintReport | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    problem: ShootingProblem | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the problem, as files do: its machine code belongs to this process."""
        return {**self.__dict__, "problem": None}

    def __copy__(self) -> Self:
        return replace(self)

    @property
    def converged(self) -> bool:
        """Whether the solve ended at a minimum, to the solver's tolerance."""
        return self.stop_reason is StopReason.CONVERGED

    def policy(self, problem: Any = None) -> Policy:
        """Make the feedback policy u = clip(u_k + K_k (x (-) x_k)).

        Args:
            problem: Problem or scene, for the difference of states and the bounds; needed where the solution
                has none.

        Returns:
            Function of a state, shape (n_x,), and a stage k in [0, N); it returns a control, shape (n_u,).

        Raises:
            ValueError: If no problem is known, or its sizes are not those of the solution.
        """
        given = self.problem if problem is None else as_problem(problem)
        if given is None:
            raise ValueError(
                "a loaded, copied or unpickled solution has no problem: call policy(problem) or policy(scene)"
            )
        return FeedbackPolicy(self, given)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the solution to a file, atomically.

        Args:
            path: File in NumPy's npz format; its folder must exist.
        """
        write_atomically(Path(path), self.to_bytes())

    def to_bytes(self) -> bytes:
        """The content of the file that `save` writes.

        Returns:
            An archive in NumPy's npz format.
        """
        facts = {
            "cost": self.cost,
            "stop_reason": self.stop_reason.value,
            "message": self.message,
            "optimality": self.optimality,
            "iterations": self.iterations,
            "metadata": self.metadata,
            **({} if self.constraints is None else {"constraints": self.constraints._asdict()}),
            "versions": {
                "python": platform.python_version(),
                **{package: version(package) for package in ("numpy", "numba", "llvmlite")},
            },
        }
        multipliers = {} if self.constraints is None else {"multipliers": self.multipliers}
        content = BytesIO()
        np.savez(
            content,
            states=self.states,
            controls=self.controls,
            feedback_gains=self.feedback_gains,
            history=self.history,
            parameters=self.parameters,
            facts=np.array(json.dumps(facts)),
            **multipliers,  # type: ignore[arg-type]  # numpy types them as its options
        )
        return content.getvalue()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a solution that `save` wrote.

        Args:
            path: The file.

        Returns:
            The solution, without its problem.

        Raises:
            ValueError: If the file does not hold a solution.
        """
        return cls.from_arrays(read_arrays(path, (*_ARRAYS, *_OPTIONAL_ARRAYS)), os.fspath(path))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], where: str) -> Self:
        """Make a solution of the arrays of a file.

        Args:
            arrays: Those that `save` writes, by name, shapes as of the attributes.
            where: Name of the file, for errors.

        Returns:
            The solution, without its problem.

        Raises:
            ValueError: If the arrays are no solution.
        """
        found: dict[str, Any] = dict(arrays)
        if "parameters" not in found and np.ndim(found.get("states", ())) == 2:  # of a version without them
            found["parameters"] = np.zeros((len(found["states"]), 0))
        missing = set(_ARRAYS) - set(found)
        if missing:
            raise ValueError(f"{where} is not a solution: it lacks {', '.join(sorted(missing))}")
        facts = parse_json(str(found.pop("facts")), f"{where}: facts")
        _check(found, facts, where)
        report = facts.get("constraints")
        return cls(
            **found,
            cost=facts["cost"],
            stop_reason=StopReason(facts["stop_reason"]),
            message=facts["message"],
            optimality=facts["optimality"],
            iterations=facts["iterations"],
            metadata=facts["metadata"],
            constraints=None if report is None else ConstraintReport(**report),
        )


_ARRAYS = ("states", "controls", "feedback_gains", "history", "parameters", "facts")
_OPTIONAL_ARRAYS = ("multipliers",)
_FACTS: Mapping[str, tuple[Any, str]] = {
    "cost": (float | int, "a number"),
    "stop_reason": (str, "text"),
    "message": (str, "text"),
    "optimality": (float | int, "a number"),
    "iterations": (int, "a whole number"),
    "metadata": (dict, "a mapping"),
}


def _check(arrays: Mapping[str, NDArray[Any]], facts: Any, where: str) -> None:
    """Raise ValueError where a file holds other arrays or facts than `Solution.save` writes."""
    if not isinstance(facts, dict):
        raise ValueError(f"{where}: facts are {shortened(facts, 40)}, they should be a mapping")
    for name, (kind, wanted) in _FACTS.items():
        value = facts.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{where}: facts: {name} is {shortened(value)}, it should be {wanted}")
    if facts["stop_reason"] not in list(StopReason):
        reasons = ", ".join(StopReason)
        raise ValueError(
            f"{where}: facts: stop_reason is {shortened(facts['stop_reason'])}, it should be one of {reasons}"
        )
    report = facts.get("constraints")
    if report is not None and (not isinstance(report, dict) or set(report) != set(ConstraintReport._fields)):
        wanted = ", ".join(ConstraintReport._fields)
        raise ValueError(f"{where}: facts: constraints is {shortened(report)}, it should have {wanted}")
    steps, axes = (
        len(np.atleast_1d(arrays["controls"])),
        {"states": 2, "controls": 2, "feedback_gains": 3, "parameters": 2, "multipliers": 2},
    )
    for name, count in axes.items():
        if name in _OPTIONAL_ARRAYS and name not in arrays:
            continue
        array, rows = arrays[name], steps + (name not in ("controls", "feedback_gains"))
        if array.ndim != count or array.dtype.kind not in "iuf" or len(array) != rows:
            raise ValueError(
                f"{where}: {name} has shape {array.shape} of {array.dtype}, it should have {count} axes of "
                f"numbers and {rows} rows"
            )
    if arrays["history"].dtype != HISTORY_DTYPE or arrays["history"].ndim != 1:
        raise ValueError(f"{where}: history has other columns, they should be those of IterationRecord")


def uninterrupted(solution: Solution) -> Solution:
    """The solution; KeyboardInterrupt if the user interrupted the solve."""
    if solution.stop_reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    return solution


def as_interrupted(solution: Solution) -> Solution:
    """The solution as what is there when the user interrupts, even if its own solve had ended."""
    if solution.stop_reason is StopReason.INTERRUPTED:
        return solution
    return replace(solution, stop_reason=StopReason.INTERRUPTED, message="interrupted by the user")


class FeedbackPolicy:
    """The feedback policy of a solution; it owns its buffers, so give each thread its own."""

    def __init__(self, solution: Solution, problem: ShootingProblem) -> None:
        horizon = problem.horizon
        expected = (horizon, problem.n_controls, problem.n_tangent)
        if solution.feedback_gains.shape != expected or solution.states.shape[1] != problem.n_states:
            raise ValueError(
                f"the solution has gains {solution.feedback_gains.shape} and states {solution.states.shape}, "
                f"the problem needs gains {expected} and states ({horizon + 1}, {problem.n_states})"
            )
        self._solution, self._problem = solution, problem
        # Limits may be among the parameters; one that has others was made with constants in their place.
        same = solution.parameters.shape == problem.parameters.rows.shape
        with problem.parameters.being(solution.parameters if same else None):
            self._lower, self._upper = stage_bounds(problem)
        self._rates = rate_limits(problem)
        self._difference = problem.kernel("difference")
        self._reference = np.zeros((1, problem.n_states))
        self._state = np.zeros((1, problem.n_states))
        self._deviation = np.zeros((1, problem.n_tangent))
        self._buffers = buffer_table(self._reference, self._state, self._deviation)
        self._find_deviation = one_row_call(self._difference.address, address_of(self._buffers))

    def __copy__(self) -> Self:
        """Make another one, with its own buffers."""
        return type(self)(self._solution, self._problem)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.__copy__()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a feedback policy cannot be pickled, its machine code belongs to this process: pickle or save "
            "its solution, and call policy(problem) of that"
        )

    def __call__(self, state: FloatArray, k: int) -> FloatArray:
        """Compute the control, shape (n_u,), at a state, shape (n_x,), and a stage; NaN where the state is.

        Raises IndexError for a stage that there is not, and ValueError for a state of another shape.
        """
        horizon = self._solution.controls.shape[0]
        if not 0 <= k < horizon:
            raise IndexError(f"stage {k} is outside the trajectory, which has stages 0 to {horizon - 1}")
        given = np.asarray(state)
        if given.shape != self._state[0].shape:  # it would be spread over the whole state
            raise ValueError(f"state has shape {given.shape}; expected {self._state[0].shape}")
        self._reference[0] = self._solution.states[k]
        self._state[0] = given
        self._find_deviation()
        control = self._solution.controls[k] + self._solution.feedback_gains[k] @ self._deviation[0]
        # Twice as fast as np.clip.
        control = np.asarray(np.minimum(np.maximum(control, self._lower[k]), self._upper[k]))
        if self._rates.change.size:
            within_rates(control, given[self._rates.states], self._rates)
        return control
