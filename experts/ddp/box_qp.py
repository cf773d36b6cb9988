"""The box-constrained quadratic program of a stage: minimize 1/2 x'Hx + g'x subject to lower <= x <= upper.

Projected Newton of Tassa, Mansard & Todorov, "Control-limited differential dynamic programming", ICRA 2014,
section IV and appendix. The plain Newton step is tried first: if it stays inside the box, it is the solution,
and its factorization serves the feedback gains too.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experts.native.compilation import compiled
from experts.native.padded_algebra import FloatArray, copy_in, factorize, padded_zeros, solve_vector_in_place

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

MAX_ITERATIONS = 100
GRADIENT_TOLERANCE = 1e-8  # of the free gradient, relative to the norm of g
RELATIVE_IMPROVEMENT = 1e-8
STEP_FACTOR = 0.6
ARMIJO = 0.1
SMALLEST_STEP = 1e-22


class BoxQPWorkspace(NamedTuple):
    """Work arrays of `box_qp`; `factor`, `inverse_pivots`, `free` and `clamped` are results."""

    # U of the free block, H_ff = U' D U, above the diagonal of ones, which is not stored; rows and columns
    # in the order of `free`; shape (n, padded(n))
    factor: FloatArray
    inverse_pivots: FloatArray  # 1 / D[i, i], shape (n,)
    # indices of the free components in rising order, the first n_free entries; shape (n,)
    free: NDArray[np.int64]
    clamped: NDArray[np.bool_]  # whether a component is held at its bound, shape (n,)
    slope: FloatArray  # gradient at the current point, shape (n,)
    search: FloatArray  # Newton direction, in the order of `free`; shape (n,)
    trial: FloatArray  # candidate point, shape (n,)


def box_qp_workspace(size: int) -> BoxQPWorkspace:
    """Allocate the work arrays of `box_qp`."""
    return BoxQPWorkspace(
        factor=padded_zeros(size, size),
        inverse_pivots=np.zeros(size),
        free=np.zeros(size, dtype=np.int64),
        clamped=np.zeros(size, dtype=np.bool_),
        slope=np.zeros(size),
        search=np.zeros(size),
        trial=np.zeros(size),
    )


@compiled
def box_qp(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    minimizer: FloatArray,
    work: BoxQPWorkspace,
) -> tuple[int, int]:
    """Minimize 1/2 x'Hx + g'x over lower <= x <= upper; return a status and the number of free components.

    The minimizer array holds a first guess, for the case that the plain Newton step leaves the box. Where H
    is positive definite only on the free components, the search starts at zero instead, and the minimum is
    local.
    """
    size = gradient.shape[0]
    for i in range(size):
        work.clamped[i] = False
    if _factorize_free_block(hessian, work) < 0:
        # Components that the gradient holds at a bound need no convexity; they show at zero.
        for i in range(size):
            minimizer[i] = 0.0
        return _projected_newton(hessian, gradient, lower, upper, minimizer, NOT_POSITIVE_DEFINITE, work)
    for i in range(size):
        work.search[i] = -gradient[i]
    solve_vector_in_place(work.factor, work.inverse_pivots, work.search, size)
    inside = True
    for i in range(size):
        inside = inside and lower[i] <= work.search[i] <= upper[i]
    if inside:
        for i in range(size):
            minimizer[i] = work.search[i]
        return SOLVED, size
    return _projected_newton(hessian, gradient, lower, upper, minimizer, size, work)


@compiled
def _projected_newton(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    minimizer: FloatArray,
    n_free: int,
    work: BoxQPWorkspace,
) -> tuple[int, int]:
    """Iterate; n_free is negative if the whole Hessian could not be factorized."""
    size = gradient.shape[0]
    gradient_norm = 0.0
    for i in range(size):
        minimizer[i] = min(max(minimizer[i], lower[i]), upper[i])
        gradient_norm += gradient[i] ** 2
    value = _value(hessian, gradient, minimizer)
    previous_value = np.inf
    for _ in range(MAX_ITERATIONS):
        changed = _find_clamped(hessian, gradient, lower, upper, minimizer, work)
        if changed or n_free < 0:
            n_free = _factorize_free_block(hessian, work)
            if n_free < 0:
                return NOT_POSITIVE_DEFINITE, size
        free_norm = 0.0
        for a in range(n_free):
            work.search[a] = -work.slope[work.free[a]]
            free_norm += work.search[a] ** 2
        if free_norm <= GRADIENT_TOLERANCE**2 * gradient_norm:
            return SOLVED, n_free
        if previous_value - value < RELATIVE_IMPROVEMENT * abs(previous_value):
            return SMALL_IMPROVEMENT, n_free
        solve_vector_in_place(work.factor, work.inverse_pivots, work.search, n_free)
        previous_value = value
        value = _projected_step(hessian, gradient, lower, upper, minimizer, n_free, value, work)
        if not value < previous_value:
            return STALLED, n_free
    if _find_clamped(hessian, gradient, lower, upper, minimizer, work):
        n_free = _factorize_free_block(hessian, work)
    return ITERATION_LIMIT if n_free >= 0 else NOT_POSITIVE_DEFINITE, n_free


@compiled
def _factorize_free_block(hessian: FloatArray, work: BoxQPWorkspace) -> int:
    """List the components that are not clamped and factorize their block; return their number, or -1."""
    n_free = 0
    for i in range(work.clamped.shape[0]):
        if not work.clamped[i]:
            work.free[n_free] = i
            n_free += 1
    if n_free == work.clamped.shape[0]:
        copy_in(work.factor, hessian)
    else:
        for a in range(n_free):
            row = hessian[work.free[a]]
            for b in range(a, n_free):
                work.factor[a, b] = row[work.free[b]]
    return n_free if factorize(work.factor, work.inverse_pivots, n_free) else -1


@compiled
def _find_clamped(
    hessian: FloatArray,
    gradient: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    point: FloatArray,
    work: BoxQPWorkspace,
) -> bool:
    """Compute the slope at a point and clamp what it pushes out of the box; tell whether the set changed."""
    changed = False
    for i in range(point.shape[0]):
        slope = gradient[i]
        for j in range(point.shape[0]):
            slope += hessian[i, j] * point[j]
        work.slope[i] = slope
        clamped = (point[i] == lower[i] and slope > 0.0) or (point[i] == upper[i] and slope < 0.0)
        changed = changed or clamped != work.clamped[i]
        work.clamped[i] = clamped
    return changed


@compiled
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
    """Move along the projected Newton direction under Armijo's rule; return the new value, or the old one."""
    slope_along = 0.0
    for a in range(n_free):
        slope_along += work.search[a] * work.slope[work.free[a]]
    step = 1.0
    while step >= SMALLEST_STEP:
        for i in range(point.shape[0]):
            work.trial[i] = point[i]
        for a in range(n_free):
            i = work.free[a]
            work.trial[i] = min(max(point[i] + step * work.search[a], lower[i]), upper[i])
        trial_value = _value(hessian, gradient, work.trial)
        if trial_value - value <= ARMIJO * step * slope_along:
            for i in range(point.shape[0]):
                point[i] = work.trial[i]
            return trial_value
        step *= STEP_FACTOR
    return value


@compiled
def _value(hessian: FloatArray, gradient: FloatArray, point: FloatArray) -> float:
    """Evaluate 1/2 x'Hx + g'x."""
    value = 0.0
    for i in range(point.shape[0]):
        product = 0.0
        for j in range(point.shape[0]):
            product += hessian[i, j] * point[j]
        value += point[i] * (0.5 * product + gradient[i])
    return value
