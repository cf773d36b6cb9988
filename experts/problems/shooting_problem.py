"""The interface of a problem: sizes, bounds, an initial state, and native kernels by name.

The solver knows no robot. It sees states x of n_x stored numbers, whose differences live in n_t tangent
coordinates (a pose stores 8 numbers and has 6 directions), controls u of n_u inputs with bounds, and six
kernels. Every kernel works on rows (`experts.native.compilation`); its buffers, each with its row's shape:

| kernel | buffers, outputs last |
|---|---|
| `difference` | x_reference (n_x), x (n_x); dx = x (-) x_reference (n_t) |
| `step_with_cost` | x (n_x), u (n_u), h (one scalar for all rows); x_next (n_x), cost (1) |
| `terminal_cost` | x (n_x); cost (1) |
| `linearize` | x (n_x), u (n_u), h (one scalar for all rows); A (n_t, n_t), B (n_t, n_u) |
| `cost_derivatives` | x (n_x), u (n_u); lx (n_t), lu (n_u), lxx (n_t, n_t), luu (n_u, n_u), lux (n_u, n_t) |
| `terminal_cost_derivatives` | x (n_x); lx (n_t), lxx (n_t, n_t) |
| `lagrangian_hessian` | x, u, multiplier (n_t), h; Lxx (n_t, n_t), Lux (n_u, n_t), Luu (n_u, n_u) |
| `terminal_cost_hessian` | x (n_x); Lxx (n_t, n_t) |
| `retract` | x (n_x), dx (n_t); x_next = x (+) dx (n_x) |

What varies between solves, or from stage to stage, is an input as well: `step_with_cost`, `linearize`,
`cost_derivatives` and `lagrangian_hessian` read the parameters of their stage, if the problem has any, right
after the state. The three kernels of the terminal cost read the arrays of `terminal_inputs`, a row each,
there.

Output arrays of the derivative kernels start as zeros, and only the kernels write to them, so a kernel may
skip entries that are always zero. Only problems with `has_mixed_cost` have the mixed derivative lux of the
stage cost; the others' is zero, and their kernel has no such buffer.

lxx, luu and lux may be convex approximations: Gauss-Newton's. `lagrangian_hessian` and
`terminal_cost_hessian` give exact second derivatives, and only problems with `has_second_order` need them:
Lxx, Lux and Luu are those of the stage cost + multiplier . (step(x (+) z, u) (-) step(x, u)) with respect to
tangent state z and control u. `retract`, the inverse of `difference`, removes rounding errors from a pose; it
serves guesses of the states, and only problems with `has_retraction` need it.

A problem may have these attributes besides those of `ShootingProblem`:

| attribute | without it |
|---|---|
| `constraints`, a `StageConstraints` or None; kernels read `parameters.more` | nothing constrains it |
| `rate_limits`, see `RateLimits` | controls may jump |
| `is_success(states, controls)`, whether a trajectory fulfills its task | whatever converges does |
| `check_state(name, x)`, raises ValueError where (n_x,) or a row of (M, n_x) is no state | all are states |
| `native_calls()`, see `native_calls` | kernels raise nothing |
| `compiling_aside(kernels, before)`, see `compiling_aside` | kernels compile when they are asked for |
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened

FloatArray = NDArray[np.float64]

KERNEL_NAMES = (
    "difference",
    "step_with_cost",
    "terminal_cost",
    "linearize",
    "cost_derivatives",
    "terminal_cost_derivatives",
)

SECOND_ORDER_KERNEL_NAMES = ("lagrangian_hessian", "terminal_cost_hessian")

RETRACTION_KERNEL_NAME = "retract"


class StageParameters:
    """Parameters of the stages of a problem, as its kernels read them.

    Attributes:
        nominal: Values of a solve that is given none, shape (n_p,).
        rows: Present values, shape (N + 1, n_p); the last row is that of the terminal cost.
        more: Further numbers of each stage that only the solver changes, multipliers for example.
        inputs: Rows and further numbers side by side, an array to be read after the state; nothing for a
            problem without either.
    """

    def __init__(
        self,
        horizon: int,
        nominal: ArrayLike = (),
        in_stages: Callable[[FloatArray], FloatArray] | None = None,
        n_more: int = 0,
        check: Callable[[FloatArray], object] | None = None,
    ) -> None:
        """Begin with nominal values.

        `in_stages` gives the rows (N + 1, n_p) that follow from the first, and `check` raises ValueError for
        values at the start, (n_p,), that mean nothing.
        """
        self.nominal: FloatArray = np.array(nominal, dtype=np.float64)
        self._whole: FloatArray = np.zeros((horizon + 1, self.nominal.size + n_more))
        self.rows, self.more = np.split(self._whole, [self.nominal.size], axis=1)
        self._in_stages, self._check = in_stages, check
        self.inputs: tuple[FloatArray, ...] = (self._whole,) if self._whole.size else ()
        self.set(None)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a problem's parameters cannot be copied or pickled, kernels read them where they are: make "
            "another problem of the same scene"
        )

    def checked(self, parameters: ArrayLike | None) -> FloatArray:
        """Return parameters as rows, (N + 1, n_p).

        Args:
            parameters: Those at the start, shape (n_p,), which hold for all stages unless the problem knows
                how they change; or one row per stage, (N + 1, n_p); None for the nominal ones.

        Raises:
            ValueError: If they have another shape or are not finite, or those at the start mean nothing, as a
                negative mass.
        """
        given = self.nominal if parameters is None else real_array("parameters", parameters, np.float64)
        if given.shape not in (self.nominal.shape, self.rows.shape):
            raise ValueError(
                f"parameters have shape {given.shape}; expected {self.nominal.shape}, or {self.rows.shape} "
                "with a row for each stage"
            )
        check_array("parameters", given, given.shape)
        if self._check is not None and parameters is not None and given.ndim == 1 and given.size:
            self._check(given)
        if self._in_stages is not None and given.ndim == 1:
            return self._in_stages(given)
        return np.broadcast_to(given, self.rows.shape)

    def set(self, parameters: ArrayLike | None) -> None:
        """Change the present values; see `checked`."""
        self.rows[:] = self.checked(parameters)

    @contextmanager
    def being(self, parameters: ArrayLike | None) -> Iterator[None]:
        """Change the present values inside a `with` block; see `checked`."""
        present = self.rows.copy()
        self.set(parameters)
        try:
            yield
        finally:
            self.rows[:] = present


class RateLimits(NamedTuple):
    """Limits of how much m of the controls change from stage to stage: |u - x| <= change, x in the state.

    A problem with such limits has an attribute `rate_limits`, and keeps a control in its state for a stage.
    """

    controls: NDArray[np.int64]  # their indices, shape (m,)
    states: NDArray[np.int64]  # indices of their previous values in the state, shape (m,)
    tangents: NDArray[np.int64]  # the same in tangent coordinates, in which they are flat, shape (m,)
    change: FloatArray  # largest change, units of the controls, shape (m,)


def rate_limits(problem: "ShootingProblem") -> RateLimits:
    """Limits of a problem; of no control where it has none."""
    none = np.zeros(0, np.int64)
    found: RateLimits = getattr(problem, "rate_limits", RateLimits(none, none, none, np.zeros(0)))
    return found


class Kernel(Protocol):
    """A native function over rows; the object keeps its code loaded."""

    @property
    def address(self) -> int:
        """Address of the function."""


class ShootingProblem(Protocol):
    """An optimal control problem over N stages with box-limited controls."""

    @property
    def n_states(self) -> int:
        """Numbers n_x in a stored state."""

    @property
    def n_tangent(self) -> int:
        """Directions n_t in which a state can move."""

    @property
    def n_controls(self) -> int:
        """Number n_u of inputs."""

    @property
    def horizon(self) -> int:
        """Number N of stages; a trajectory has N controls and N + 1 states."""

    @property
    def time_step(self) -> float:
        """Duration of a stage, s."""

    @property
    def parameters(self) -> StageParameters:
        """What varies; `StageParameters(horizon)` if nothing does."""

    @property
    def control_lower(self) -> FloatArray:
        """Lower bounds of the inputs, -inf where there is none, shape (n_u,) or (N, n_u)."""

    @property
    def control_upper(self) -> FloatArray:
        """Upper bounds of the inputs, +inf where there is none, shape (n_u,) or (N, n_u)."""

    @property
    def initial_state(self) -> FloatArray:
        """State at stage 0 unless `solve` is given another, shape (n_x,)."""

    @property
    def terminal_inputs(self) -> tuple[FloatArray, ...]:
        """Further inputs of the terminal cost: contiguous arrays whose numbers may change."""

    @property
    def has_second_order(self) -> bool:
        """Whether the problem has the kernels `SECOND_ORDER_KERNEL_NAMES`."""

    @property
    def has_mixed_cost(self) -> bool:
        """Whether `cost_derivatives` writes lux."""

    @property
    def has_retraction(self) -> bool:
        """Whether the problem has the kernel `RETRACTION_KERNEL_NAME`."""

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return one of the kernels.

        Args:
            name: One of `KERNEL_NAMES`, or one of `SECOND_ORDER_KERNEL_NAMES` or `RETRACTION_KERNEL_NAME` if
                the problem has those.
            batched: Whether it will work on many rows at once rather than one by one; the result must not
                depend on it, the code may.

        Returns:
            The kernel.
        """
        ...


def native_calls(problem: ShootingProblem) -> AbstractContextManager[None]:
    """Surround native calls: a kernel written in Python raises after them what native code cannot pass on."""
    surround: AbstractContextManager[None] = getattr(problem, "native_calls", nullcontext)()
    return surround


def compiling_aside(
    problem: ShootingProblem, wanted: Sequence[tuple[str, bool]], before: Callable[[], None] | None
) -> AbstractContextManager[None]:
    """Surround other work while kernels, given by name and whether batched, are compiled by another process.

    For problems that know how; those that take longest come first. The process calls a function before.
    """
    surround: Callable[..., AbstractContextManager[None]] | None = getattr(problem, "compiling_aside", None)
    return nullcontext() if surround is None else surround(wanted, before)


def check_interface(candidate: Any) -> None:
    """Raise TypeError if an object is no `ShootingProblem`, and say what would be one."""
    required = [name for name in vars(ShootingProblem) if not name.startswith("_")]
    missing = [name for name in required if not hasattr(candidate, name)]
    if not (missing or isinstance(candidate, type)):
        return
    reason = ""
    if isinstance(candidate, type):
        reason = "; it is a class, give an object of it"
    elif hasattr(candidate, "kernel"):
        reason = f"; it lacks {', '.join(missing)}"
    raise TypeError(
        f"{shortened(candidate)} is neither a scene nor a problem{reason}. Give a scene or its name, a "
        "CasadiProblem or PythonProblem of your own functions, or whatever has all of ShootingProblem"
    )


def check_problem(problem: ShootingProblem) -> None:
    """Raise ValueError if the attributes of a problem contradict each other."""
    for name in ("n_states", "n_tangent", "n_controls", "horizon"):
        if getattr(problem, name) < 1:
            raise ValueError(f"{name} is {getattr(problem, name)}; a problem needs at least 1")
    check_duration("time_step", problem.time_step)
    for name in ("control_lower", "control_upper"):
        bound = np.asarray(getattr(problem, name))
        if bound.shape not in ((problem.n_controls,), (problem.horizon, problem.n_controls)):
            raise ValueError(
                f"{name} has shape {bound.shape}; expected ({problem.n_controls},), or "
                f"({problem.horizon}, {problem.n_controls}) with a row for each stage"
            )
    lower, upper = stage_bounds(problem)
    closed = np.argwhere((lower == np.inf) | (upper == -np.inf))
    if len(closed):
        k, i = closed[0]
        raise ValueError(
            f"input {i} has bounds [{lower[k, i]}, {upper[k, i]}]; no finite number is within them, "
            "-inf and inf stand for none"
        )
    crossed = np.argwhere(~(lower <= upper))
    if len(crossed):
        k, i = crossed[0]
        raise ValueError(
            f"input {i} has bounds [{lower[k, i]}, {upper[k, i]}]; "
            "the lower one must not exceed the upper one"
        )


def stage_bounds(problem: ShootingProblem) -> tuple[FloatArray, FloatArray]:
    """Lower and upper bounds of every stage, shape (N, n_u) each."""
    shape = problem.horizon, problem.n_controls
    bounds = (problem.control_lower, problem.control_upper)
    # Of one order for all problems: loops are compiled for each.
    lower, upper = (np.array(np.broadcast_to(bound, shape), np.float64, order="C") for bound in bounds)
    return lower, upper


def within_rates(control: FloatArray, previous: FloatArray, limits: RateLimits) -> FloatArray:
    """Move a control, (n_u,), in place to where its previous values, (m,), let it be; return its own."""
    near = np.clip(control[limits.controls], previous - limits.change, previous + limits.change)
    control[limits.controls] = near
    return near


def check_array(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape, or with entries that are not finite."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        position = ", ".join(map(str, wrong[0]))
        raise ValueError(f"{name}[{position}] is {array[tuple(wrong[0])]}; every entry must be finite")


def check_state(problem: ShootingProblem, name: str, state: FloatArray) -> None:
    """Refuse what is no state, (n_x,) or a row of (M, n_x): rotations that are no unit quaternions."""
    check: Callable[[str, FloatArray], None] | None = getattr(problem, "check_state", None)
    if check is not None:
        check(name, state)


def check_at_least(name: str, value: float, smallest: float) -> None:
    """Refuse a setting that is no number, too small, infinite or NaN."""
    if not (_is_number(value) and smallest <= value < np.inf):
        raise ValueError(f"{name} is {shortened(value)}; it must be a finite number, at least {smallest}")


def check_duration(name: str, seconds: float) -> None:
    """Refuse a duration that is no positive, finite number."""
    if not (_is_number(seconds) and 0.0 < seconds < np.inf):
        raise ValueError(f"{name} is {shortened(seconds)}; it must be a positive number of seconds")


def _is_number(value: object) -> bool:
    return isinstance(value, float | int | np.floating | np.integer) and not isinstance(value, bool)


def check_whole(name: str, value: int, smallest: int) -> None:
    """Refuse a setting that is no whole number, or too small."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < smallest:
        raise ValueError(f"{name} is {value!r}; it must be a whole number, at least {smallest}")


def check_control_weights(luu: FloatArray) -> None:
    """Refuse a problem in which an input has no cost of its own, luu of shape (N, n_u, n_u): mu scales it."""
    weights = np.diagonal(luu, axis1=1, axis2=2)
    free = weights <= 0.0
    if np.any(free):
        k, i = (int(index[0]) for index in np.nonzero(free))
        raise ValueError(
            f"the cost has the second derivative {weights[k, i]} with respect to input {i} at stage {k}; "
            "every input needs a positive weight"
        )
