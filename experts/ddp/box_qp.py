"""The box-constrained quadratic program of a stage: minimize 1/2 x'Hx + g'x subject to lower <= x <= upper.

Projected Newton of Tassa, Mansard & Todorov, "Control-limited differential dynamic programming", ICRA 2014,
section IV and appendix. Before that, a few sets of components are tried: held at their bounds, the others
minimized over, and corrected where one leaves the box or the slope pulls one back. Starting from the set of a
neighboring stage, or none, the first or second is mostly right. The last factorization serves the feedback
gains too.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experts.native.compilation import part
from experts.native.padded_algebra import (
    FloatArray,
    factorize,
    padded,
    padded_in_loops,
    padded_zeros,
    substitute,
)
from experts.native.vector_tiles import copy_row, set_vector_sum

SOLVED = 0
"""The free part of the gradient vanishes, and the clamped part points out of the box."""
SMALL_IMPROVEMENT = 1
"""The last step improved the value by less than `RELATIVE_IMPROVEMENT`."""
ITERATION_LIMIT = 2
"""`MAX_ITERATIONS` were not enough; the best point is returned."""
STALLED = 3
"""No step along the Newton direction improved the value; the best point is returned."""
NOT_POSITIVE_DEFINITE = -1
"""The free block of the Hessian is not positive definite; there is no result."""

ACTIVE_SETS = 4
"""Sets of held components to try before the projected Newton method, which cannot cycle."""
MAX_ITERATIONS = 100
GRADIENT_TOLERANCE = 1e-8  # of the free gradient, relative to the norm of g
RELATIVE_IMPROVEMENT = 1e-8
STEP_FACTOR = 0.6
ARMIJO = 0.1
SMALLEST_STEP = 1e-22


class BoxQPWorkspace(NamedTuple):
    """Work arrays of `box_qp`; `system`, `inverse_pivots`, `free` and `sides` are results."""

    # Rows of the free components, in the order of `free`. In the first padded(n) columns U, with H_ff =
    # U' D^-1 U and D the diagonal of U, on and above the diagonal; then -H_ff^-1 G_f, G being m right sides,
    # and the Newton step; shape (n, padded(padded(n) + m + 1))
    system: FloatArray
    inverse_pivots: FloatArray  # 1 / U[i, i], shape (n,)
    # indices of the free components in rising order, the first n_free entries; shape (n,)
    free: NDArray[np.int64]
    sides: NDArray[np.int64]  # -1 where a component is held at its lower bound, +1 at its upper, else 0
    step: FloatArray  # Newton step -H_ff^-1 slope_f, a column of the system, shape (n,)
    slope: FloatArray  # gradient at the last point evaluated, shape (padded(n),)
    trial: FloatArray  # candidate point, shape (n,)


def box_qp_workspace(size: int, right_sides: int = 0) -> BoxQPWorkspace:
    """Allocate the work arrays of `box_qp`."""
    begin = padded(size) + right_sides
    system = padded_zeros(size, begin + 1)
    return BoxQPWorkspace(
        system=system,
        inverse_pivots=np.zeros(size),
        free=np.zeros(size, dtype=np.int64),
        sides=np.zeros(size, dtype=np.int64),
        step=system[:, begin],
        slope=padded_zeros(size),
        trial=np.zeros(size),
    )


@part
def box_qp(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    minimizer: FloatArray,
    work: BoxQPWorkspace,
) -> tuple[int, int]:
    """Minimize 1/2 x'Hx + g'x over lower <= x <= upper; return a status and the number of free components.

    Rows of H are padded; after padded(n) columns follow right sides G, whose systems with the free block are
    solved on the way. Components that the last call held at bounds that are zero now are a first guess. Where
    it fails the minimizer array is one. Where H is positive definite only on the free components, the
    search starts at zero instead, and the minimum is local.
    """
    size, n_held = gradient.shape[0], 0
    for i in range(size):
        if (lower[i] if work.sides[i] < 0 else upper[i]) != 0.0:
            # H must be convex where a component moves to its bound: the whole of it is tried first.
            work.sides[i] = 0
        n_held += work.sides[i] != 0
    n_free = -1
    for attempt in range(ACTIVE_SETS):
        n_free = _solve_held(hessian, gradient, lower, upper, work)
        if n_free < 0:
            break
        if not _change_sides(hessian, gradient, lower, upper, n_free, work):
            for i in range(size):
                minimizer[i] = work.trial[i]
            return SOLVED, n_free
        if attempt == 0 and n_held > 0:
            for i in range(size):
                work.sides[i] = 0
    if n_free < 0:
        # Components that the gradient holds at a bound need no convexity; they show at zero.
        for i in range(size):
            minimizer[i] = 0.0
    return _projected_newton(hessian, gradient, lower, upper, minimizer, work)


@part
def _solve_held(
    hessian: FloatArray, gradient: FloatArray, lower: FloatArray, upper: FloatArray, work: BoxQPWorkspace
) -> int:
    """Minimize over the free components with the others at their sides; return their number, or -1."""
    n_held = 0
    for i in range(gradient.shape[0]):
        side = work.sides[i]
        work.trial[i] = 0.0 if side == 0 else (lower[i] if side < 0 else upper[i])
        work.slope[i] = gradient[i]
        n_held += side != 0
    if n_held > 0:
        _evaluate(hessian, gradient, work.trial, work)
    n_free = _newton_step(hessian, work)
    for a in range(n_free):
        work.trial[work.free[a]] = work.step[a]
    return n_free


@part
def _change_sides(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    n_free: int,
    work: BoxQPWorkspace,
) -> bool:
    """Hold what leaves the box, free what the slope pulls into it; tell whether there is anything such.

    Without room a component is held even where no slope does: its gains would promise what it cannot do.
    """
    size, changed = gradient.shape[0], False
    if n_free < size:
        _evaluate(hessian, gradient, work.trial, work)
    for i in range(size):
        side, has_room = work.sides[i], lower[i] != upper[i]
        if side == 0:
            if work.trial[i] < lower[i]:
                work.sides[i] = -1
            elif work.trial[i] > upper[i]:
                work.sides[i] = 1
            elif not has_room:
                work.sides[i] = -1
        elif not side * work.slope[i] < 0.0 and (has_room or work.slope[i] != 0.0):
            work.sides[i] = 0
        changed = changed or work.sides[i] != side
    return changed


@part
def _projected_newton(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    minimizer: FloatArray,
    work: BoxQPWorkspace,
) -> tuple[int, int]:
    """Iterate from a first guess."""
    gradient_norm, n_free = 0.0, -1
    for i in range(gradient.shape[0]):
        minimizer[i] = min(max(minimizer[i], lower[i]), upper[i])
        gradient_norm += gradient[i] ** 2
    value = _evaluate(hessian, gradient, minimizer, work)
    previous_value = np.inf
    for _ in range(MAX_ITERATIONS):
        _find_sides(lower, upper, minimizer, work)
        n_free = _newton_step(hessian, work)
        if n_free < 0:
            return NOT_POSITIVE_DEFINITE, gradient.shape[0]
        free_norm = 0.0
        for a in range(n_free):
            free_norm += work.slope[work.free[a]] ** 2
        if free_norm <= GRADIENT_TOLERANCE**2 * gradient_norm:
            return SOLVED, n_free
        if previous_value - value < RELATIVE_IMPROVEMENT * abs(previous_value):
            return SMALL_IMPROVEMENT, n_free
        previous_value = value
        value = _projected_step(hessian, gradient, lower, upper, minimizer, n_free, value, work)
        if not value < previous_value:
            return STALLED, n_free
    return ITERATION_LIMIT, n_free


@part
def _newton_step(hessian: FloatArray, work: BoxQPWorkspace) -> int:
    """List the free components, solve for their Newton step and right sides; return their number, or -1."""
    size, n_free = work.sides.shape[0], _list_free(work)
    for a in range(n_free):
        i = work.free[a]
        copy_row(work.system, a, hessian, i)
        if n_free < size:
            for b in range(a, n_free):
                work.system[a, b] = hessian[i, work.free[b]]
        work.step[a] = work.slope[i]
    if not factorize(work.system, work.inverse_pivots, n_free):
        return -1
    substitute(work.system, work.inverse_pivots, padded_in_loops(size), n_free)
    return n_free


@part
def _list_free(work: BoxQPWorkspace) -> int:
    """List the free components in rising order; return their number."""
    n_free = 0
    for i in range(work.sides.shape[0]):
        if work.sides[i] == 0:
            work.free[n_free] = i
            n_free += 1
    return n_free


@part
def _find_sides(lower: FloatArray, upper: FloatArray, point: FloatArray, work: BoxQPWorkspace) -> None:
    """Hold the components that the slope at a point pushes out of the box, or that have no room."""
    for i in range(point.shape[0]):
        slope, side = work.slope[i], 0
        if point[i] == lower[i] and slope > 0.0:
            side = -1
        elif point[i] == upper[i] and slope < 0.0:
            side = 1
        elif lower[i] == upper[i]:
            side = -1
        work.sides[i] = side


@part
def _projected_step(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    point: FloatArray,
    n_free: int,
    value: float,
    work: BoxQPWorkspace,
) -> float:
    """Move along the projected Newton direction under Armijo's rule; return the new value, or the old one.

    The slope becomes that of the new point, and is lost if there is none.
    """
    slope_along = 0.0
    for a in range(n_free):
        slope_along += work.step[a] * work.slope[work.free[a]]
    step = 1.0
    while step >= SMALLEST_STEP:
        for i in range(point.shape[0]):
            work.trial[i] = point[i]
        for a in range(n_free):
            i = work.free[a]
            work.trial[i] = min(max(point[i] + step * work.step[a], lower[i]), upper[i])
        trial_value = _evaluate(hessian, gradient, work.trial, work)
        if trial_value - value <= ARMIJO * step * slope_along:
            for i in range(point.shape[0]):
                point[i] = work.trial[i]
            return trial_value
        step *= STEP_FACTOR
    return value


@part
def _evaluate(hessian: FloatArray, gradient: FloatArray, point: FloatArray, work: BoxQPWorkspace) -> float:
    """Compute the slope Hx + g at a point, and return the value 1/2 x'Hx + g'x = 1/2 x'(slope + g)."""
    set_vector_sum(work.slope, gradient, hessian, point, point.shape[0])
    value = 0.0
    for i in range(point.shape[0]):
        value += 0.5 * point[i] * (work.slope[i] + gradient[i])
    return value
