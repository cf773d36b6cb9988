"""What the solver asks of a problem: sizes, bounds, an initial state, and native kernels by name.

The solver knows no robot. It sees states x of n_x stored numbers, whose differences live in n_t tangent
coordinates (a pose stores 8 numbers and has 6 directions), controls u of n_u inputs with bounds, and six
kernels. Every kernel works on rows, see `native_call`; its buffers, each with the shape of one row:

| kernel | buffers, outputs last |
|---|---|
| `difference` | x_reference (n_x), x (n_x); dx = x (-) x_reference (n_t) |
| `step_with_cost` | x (n_x), u (n_u), h (one scalar for all rows); x_next (n_x), cost (1) |
| `terminal_cost` | x (n_x); cost (1) |
| `linearize` | x (n_x), u (n_u), h (one scalar for all rows); A (n_t, n_t), B (n_t, n_u) |
| `cost_derivatives` | x (n_x), u (n_u); lx (n_t), lu (n_u), lxx (n_t, n_t), luu (n_u, n_u) |
| `terminal_cost_derivatives` | x (n_x); lx (n_t), lxx (n_t, n_t) |
| `lagrangian_hessian` | x, u, multiplier (n_t), h; Lxx (n_t, n_t), Lux (n_u, n_t), Luu (n_u, n_u) |
| `terminal_cost_hessian` | x (n_x); Lxx (n_t, n_t) |
| `retract` | x (n_x), dx (n_t); x_next = x (+) dx (n_x) |

The three kernels of the terminal cost read the arrays of `terminal_inputs`, a row each, after the state.

Output arrays of the derivative kernels start as zeros and nobody else writes to them, so that a kernel may
leave entries out that are always zero. The mixed derivative lux of the stage cost is taken to be zero.

lxx and luu may be approximations, as long as they are convex: Gauss-Newton's. The next two kernels give exact
second derivatives, and only problems with `has_second_order` need to have them: Lxx, Lux and Luu are those of
the stage cost + multiplier . (step(x (+) z, u) (-) step(x, u)) with respect to tangent state z and control u.
The last kernel, the inverse of `difference`, takes rounding errors out of a pose; it serves guesses of the
states, and only problems with `has_retraction` need to have it.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

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


class Kernel(Protocol):
    """A native function over rows; whoever holds the object keeps its code loaded."""

    @property
    def address(self) -> int:
        """Address of the function."""


@runtime_checkable
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
    def control_lower(self) -> FloatArray:
        """Lower bounds of the inputs, -inf where there is none, shape (n_u,)."""

    @property
    def control_upper(self) -> FloatArray:
        """Upper bounds of the inputs, +inf where there is none, shape (n_u,)."""

    @property
    def initial_state(self) -> FloatArray:
        """State at stage 0 unless `solve` is given another, shape (n_x,)."""

    @property
    def terminal_inputs(self) -> tuple[FloatArray, ...]:
        """What the terminal cost reads besides the state: contiguous arrays; their numbers may change."""

    @property
    def has_second_order(self) -> bool:
        """Whether there are the kernels of `SECOND_ORDER_KERNEL_NAMES`."""

    @property
    def has_retraction(self) -> bool:
        """Whether there is the kernel `RETRACTION_KERNEL_NAME`."""

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return one of the kernels.

        Args:
            name: One of `KERNEL_NAMES`, or one of `SECOND_ORDER_KERNEL_NAMES` or `RETRACTION_KERNEL_NAME` if
                the problem has those.
            batched: Whether it will work on many rows at once, and not on one after another; which code is
                best may depend on that, what it computes may not.

        Returns:
            The kernel.
        """
        ...


def as_problem(scene_or_problem: Any) -> ShootingProblem:
    """Turn a scene into a problem; a problem is returned as it is.

    Args:
        scene_or_problem: A `ShootingProblem`, or anything that `ArmProblem` accepts.

    Returns:
        The problem, its sizes and bounds checked.

    Raises:
        ValueError: If sizes, bounds and time step of the problem contradict one another.
    """
    if isinstance(scene_or_problem, ShootingProblem):
        problem = scene_or_problem
    else:
        from experts.arm_problem import ArmProblem

        problem = ArmProblem(scene_or_problem)
    _check(problem)
    return problem


def _check(problem: ShootingProblem) -> None:
    """Raise ValueError if the attributes of a problem contradict one another."""
    for name in ("n_states", "n_tangent", "n_controls", "horizon"):
        if getattr(problem, name) < 1:
            raise ValueError(f"{name} is {getattr(problem, name)}; a problem needs at least 1")
    if not (np.isfinite(problem.time_step) and problem.time_step > 0.0):
        raise ValueError(f"time_step is {problem.time_step}; it must be a positive number of seconds")
    for name in ("control_lower", "control_upper"):
        bound = np.asarray(getattr(problem, name))
        if bound.shape != (problem.n_controls,):
            raise ValueError(f"{name} has shape {bound.shape}; expected ({problem.n_controls},)")
    crossed = ~(np.asarray(problem.control_lower) <= np.asarray(problem.control_upper))
    if np.any(crossed):
        i = int(np.argmax(crossed))
        raise ValueError(
            f"input {i} has bounds [{problem.control_lower[i]}, {problem.control_upper[i]}]; "
            "the lower one must not exceed the upper one"
        )
