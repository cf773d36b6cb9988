"""The backward sweep of control-limited DDP: from derivatives along a trajectory to an update and its gains.

Notation of Tassa, Mansard & Todorov (ICRA 2014), in tangent coordinates: A and B are the derivatives of the
dynamics, l is the cost of a stage, V the value function and ``Q(x, u) = l(x, u) + V(A x + B u)`` the
quadratic model that is minimized over u at every stage. Matrices of a stage are kept in padded rows (see
`padded_algebra`).
"""

from typing import NamedTuple

import numpy as np

from experts.box_qp import NOT_POSITIVE_DEFINITE, BoxQPWorkspace, box_qp, box_qp_workspace
from experts.compilation import compiled, inlined
from experts.derivatives import Derivatives, Hessians
from experts.padded_algebra import (
    FloatArray,
    add_block,
    add_product,
    add_product_upper,
    add_vector_product,
    copy_in,
    mirror_upper,
    padded_zeros,
    prefetch,
    prefetch_to_write,
    set_product,
    solve_in_place,
)
from experts.vector_tiles import copy_row_out, set_row_sum, set_vector_sum

SWEEP_DONE = 0
SWEEP_NOT_POSITIVE_DEFINITE = 1
SWEEP_NOT_FINITE = 2


class Update(NamedTuple):
    """What the sweep produces: u + alpha k + K dx, and derivatives of the value function.

    Attributes:
        feedforward: k, shape (N, n_u).
        gains: K, zero in the rows of clamped inputs, shape (N, n_u, n_t).
        value_gradient: Vx at stage 0, shape (n_t,).
        value_hessian: Vxx at stage 0, shape (n_t, n_t).
        stage_gradients: Vx at every stage, shape (N, n_t); shape (0, n_t) if they are not kept.
        stage_hessians: Vxx at every stage, shape (N, n_t, n_t); shape (0, n_t, n_t) if they are not kept.
    """

    feedforward: FloatArray
    gains: FloatArray
    value_gradient: FloatArray
    value_hessian: FloatArray
    stage_gradients: FloatArray
    stage_hessians: FloatArray


class SweepOutcome(NamedTuple):
    """How a sweep ended.

    Attributes:
        status: `SWEEP_DONE`, `SWEEP_NOT_POSITIVE_DEFINITE` or `SWEEP_NOT_FINITE`.
        stage: Stage at which it failed, 0 when done.
        linear: Sum over stages of k' Qu, the change of cost per step length; negative, unit of the cost.
        quadratic: Sum over stages of 1/2 k' Quu k, per squared step length; unit of the cost.
        clamped: Number of inputs held at a bound, over all stages.
    """

    status: int
    stage: int
    linear: float
    quadratic: float
    clamped: int

    def promise(self, alpha: float) -> float:
        """Decrease of the cost that the model promises for a step.

        Args:
            alpha: Length of the step, in [0, 1].

        Returns:
            The decrease, unit of the cost.
        """
        return -alpha * (self.linear + alpha * self.quadratic)


class SweepWorkspace(NamedTuple):
    """Work arrays of one stage; nt and nu are row lengths, n_t and n_u rounded up to whole vectors.

    Attributes:
        A: Derivative of the next state with respect to the state, shape (n_t, nt).
        B: Derivative of the next state with respect to the control, shape (n_t, nu).
        VA: Vxx A, shape (n_t, nt).
        VB: Vxx B, shape (n_t, nu).
        Vxx: Hessian of the value function; between expansion and update it holds Qxx, upper triangle; (n_t,
            nt).
        Vx: Gradient of the value function; shape (nt,).
        Qx: State part of the gradient of Q, shape (nt,).
        Qu: Control part of the gradient of Q, shape (nu,).
        Qux: Mixed block of the Hessian of Q, shape (n_u, nt).
        Quu: Control block of the Hessian of Q, shape (n_u, nu).
        Quu_regular: Quu + lambda diag(luu), shape (n_u, nu).
        gains: K of the free inputs, in their order, shape (n_u, nt).
        coupling: Qux - lambda diag(luu) K of the free inputs, in their order, shape (n_u, nt).
        k: Control update, shape (n_u,).
        slope: Quu k + Qu, shape (nu,).
        free_slope: The same of the free inputs, in their order, shape (n_u,).
        room_below: Lower bounds less the control, shape (n_u,).
        room_above: Upper bounds less the control, shape (n_u,).
        box: Work arrays of the quadratic program.
    """

    A: FloatArray
    B: FloatArray
    VA: FloatArray
    VB: FloatArray
    Vxx: FloatArray
    Vx: FloatArray
    Qx: FloatArray
    Qu: FloatArray
    Qux: FloatArray
    Quu: FloatArray
    Quu_regular: FloatArray
    gains: FloatArray
    coupling: FloatArray
    k: FloatArray
    slope: FloatArray
    free_slope: FloatArray
    room_below: FloatArray
    room_above: FloatArray
    box: BoxQPWorkspace


def allocate_update(horizon: int, n_tangent: int, n_controls: int, *, keep_values: bool = False) -> Update:
    """Allocate the results of the sweep.

    Args:
        horizon: Number of stages N.
        n_tangent: Size n_t of the tangent state.
        n_controls: Number n_u of inputs.
        keep_values: Whether to keep the value function's derivatives at every stage.

    Returns:
        Arrays of zeros.
    """
    stages = horizon if keep_values else 0
    return Update(
        feedforward=np.zeros((horizon, n_controls)),
        gains=np.zeros((horizon, n_controls, n_tangent)),
        value_gradient=np.zeros(n_tangent),
        value_hessian=np.zeros((n_tangent, n_tangent)),
        stage_gradients=np.zeros((stages, n_tangent)),
        stage_hessians=np.zeros((stages, n_tangent, n_tangent)),
    )


def sweep_workspace(n_tangent: int, n_controls: int) -> SweepWorkspace:
    """Allocate the work arrays of the sweep.

    Args:
        n_tangent: Size n_t of the tangent state.
        n_controls: Number n_u of inputs.

    Returns:
        Arrays of zeros; the sweep relies on the padding being zero and keeps it so.
    """
    return SweepWorkspace(
        A=padded_zeros(n_tangent, n_tangent),
        B=padded_zeros(n_tangent, n_controls),
        VA=padded_zeros(n_tangent, n_tangent),
        VB=padded_zeros(n_tangent, n_controls),
        Vxx=padded_zeros(n_tangent, n_tangent),
        Vx=padded_zeros(n_tangent),
        Qx=padded_zeros(n_tangent),
        Qu=padded_zeros(n_controls),
        Qux=padded_zeros(n_controls, n_tangent),
        Quu=padded_zeros(n_controls, n_controls),
        Quu_regular=padded_zeros(n_controls, n_controls),
        gains=padded_zeros(n_controls, n_tangent),
        coupling=padded_zeros(n_controls, n_tangent),
        k=np.zeros(n_controls),
        slope=padded_zeros(n_controls),
        free_slope=np.zeros(n_controls),
        room_below=np.zeros(n_controls),
        room_above=np.zeros(n_controls),
        box=box_qp_workspace(n_controls),
    )


@compiled
def backward_sweep(
    derivatives: Derivatives,
    hessians: Hessians,
    gaps: FloatArray,
    controls: FloatArray,
    control_lower: FloatArray,
    control_upper: FloatArray,
    regularization: float,
    update: Update,
    work: SweepWorkspace,
) -> tuple[int, int, float, float, int]:
    """Minimize the quadratic model of the cost-to-go at every stage, from the last to the first.

    Args:
        derivatives: Derivatives along the trajectory.
        hessians: Second derivatives to take; they may be indefinite.
        gaps: f of x_k+1 (+) f = step(x_k, u_k), shape (N, n_t); no stages at all, shape (0, n_t), if the
            trajectory has none. The update is then to close them: the model is l(x, u) + V(A x + B u + f).
        controls: Controls u of the trajectory, inside the box, shape (N, n_u).
        control_lower: Lower bounds, -inf allowed, shape (n_u,).
        control_upper: Upper bounds, +inf allowed, shape (n_u,).
        regularization: lambda >= 0; Quu + lambda diag(luu) takes the place of Quu in the minimization, so
            that its size is relative to the control weights.
        update: Receives the result.
        work: Work arrays.

    Returns:
        The fields of `SweepOutcome`. A plain tuple: to make a named one, compiled code would call Python,
        and a Ctrl-C that is pending there crashes the process.
    """
    horizon, n_controls = controls.shape
    n_tangent = derivatives.lx.shape[1]
    for i in range(n_tangent):
        work.Vx[i] = derivatives.terminal_lx[0, i]
    copy_in(work.Vxx, hessians.terminal_xx[0])
    work.k[:] = 0.0
    linear, quadratic, clamped = 0.0, 0.0, 0
    for stage in range(horizon - 1, -1, -1):
        if gaps.shape[0] > 0:
            # From the gradient at x_k+1 to the one where the step lands.
            add_vector_product(work.Vx, work.Vxx, gaps[stage], n_tangent)
        _expand(derivatives, hessians, stage, work)
        _regularize(derivatives.luu[stage], regularization, work)
        for i in range(n_controls):
            work.room_below[i] = control_lower[i] - controls[stage, i]
            work.room_above[i] = control_upper[i] - controls[stage, i]
        # work.k still holds the update of the stage after this one: a close first guess.
        status, n_free = box_qp(
            work.Quu_regular, work.Qu[:n_controls], work.room_below, work.room_above, work.k, work.box
        )
        if status == NOT_POSITIVE_DEFINITE:
            failure = SWEEP_NOT_POSITIVE_DEFINITE if _is_finite(work) else SWEEP_NOT_FINITE
            return failure, stage, linear, quadratic, clamped
        stage_linear, stage_quadratic = _expected_change(work)
        linear += stage_linear
        quadratic += stage_quadratic
        clamped += n_controls - n_free
        prefetch_to_write(update.gains[max(stage - 1, 0)])
        _find_gains(derivatives.luu[stage], regularization, n_free, work)
        _update_value(n_tangent, n_free, work)
        _store(stage, n_tangent, n_free, update, work)
    for i in range(n_tangent):
        update.value_gradient[i] = work.Vx[i]
        for j in range(n_tangent):
            update.value_hessian[i, j] = work.Vxx[i, j]
    if not (np.isfinite(linear + quadratic) and _is_finite(work)):
        return SWEEP_NOT_FINITE, 0, linear, quadratic, clamped
    return SWEEP_DONE, 0, linear, quadratic, clamped


@inlined
def _expand(derivatives: Derivatives, hessians: Hessians, stage: int, work: SweepWorkspace) -> None:
    """Expand Q to second order; Qx and Qxx take the place of Vx and Vxx.

    Qx = lx + A' Vx, Qu = lu + B' Vx, Qxx = Hxx + A' Vxx A, Qux = Hux + B' Vxx A, Quu = Huu + B' Vxx B.
    """
    n_tangent = derivatives.lx.shape[1]
    copy_in(work.A, derivatives.A[stage])
    copy_in(work.B, derivatives.B[stage])
    earlier = max(stage - 1, 0)
    # Between the products: many lines asked for at once would hold the processor up.
    prefetch(derivatives.A[earlier])
    set_product(work.VA, work.Vxx, work.A, n_tangent)
    prefetch(derivatives.B[earlier])
    set_product(work.VB, work.Vxx, work.B, n_tangent)
    copy_in(work.Vxx, hessians.xx[stage])
    prefetch(hessians.xx[earlier])
    add_product_upper(work.Vxx, work.A, work.VA, n_tangent)
    set_product(work.Qux, work.B, work.VA, n_tangent)
    if hessians.ux.shape[0] > 0:
        add_block(work.Qux, hessians.ux[stage])
        prefetch(hessians.ux[earlier])
    copy_in(work.Quu, hessians.uu[stage])
    prefetch(hessians.uu[earlier])
    add_product(work.Quu, work.B, work.VB, n_tangent)
    set_vector_sum(work.Qx, derivatives.lx[stage], work.A, work.Vx, n_tangent)
    set_vector_sum(work.Qu, derivatives.lu[stage], work.B, work.Vx, n_tangent)


@inlined
def _regularize(luu: FloatArray, regularization: float, work: SweepWorkspace) -> None:
    """Build Quu + lambda diag(luu)."""
    copy_in(work.Quu_regular, work.Quu)
    for i in range(luu.shape[0]):
        work.Quu_regular[i, i] += regularization * luu[i, i]


@inlined
def _expected_change(work: SweepWorkspace) -> tuple[float, float]:
    """Compute k' Qu and 1/2 k' Quu k, and keep Quu k + Qu; all with the Quu that is not regularized."""
    linear, quadratic = 0.0, 0.0
    n_controls = work.k.shape[0]
    set_vector_sum(work.slope, work.Qu, work.Quu, work.k, n_controls)
    for i in range(n_controls):
        linear += work.k[i] * work.Qu[i]
        quadratic += 0.5 * work.k[i] * (work.slope[i] - work.Qu[i])
    return linear, quadratic


@inlined
def _find_gains(luu: FloatArray, regularization: float, n_free: int, work: SweepWorkspace) -> None:
    """Solve (Quu + lambda diag(luu)) K = -Qux for the free inputs."""
    for a in range(n_free):
        i = work.box.free[a]
        set_row_sum(work.gains, a, work.Qux, i, -2.0, work.Qux, i)  # -Qux
    solve_in_place(work.box.factor, work.box.inverse_pivots, work.gains, n_free)
    for a in range(n_free):
        i = work.box.free[a]
        set_row_sum(work.coupling, a, work.Qux, i, -regularization * luu[i, i], work.gains, a)


@inlined
def _update_value(n_tangent: int, n_free: int, work: SweepWorkspace) -> None:
    """Propagate the value function under the update that the box allows.

    Tassa's form, with Quu and Qux not regularized:
        Vx = Qx + K' Quu k + K' Qu + Qux' k,  Vxx = Qxx + K' Quu K + K' Qux + Qux' K.
    As (Quu + lambda R) K = -Qux in the free rows, R = diag(luu), the latter is
        Vxx = Qxx + K' (Qux - lambda R K),
    one symmetric product instead of three.
    """
    set_vector_sum(work.Vx, work.Qx, work.Qux, work.k, work.k.shape[0])
    for a in range(n_free):
        work.free_slope[a] = work.slope[work.box.free[a]]
    set_vector_sum(work.Vx, work.Vx, work.gains, work.free_slope, n_free)
    add_product_upper(work.Vxx, work.gains, work.coupling, n_free)
    mirror_upper(work.Vxx, n_tangent)


@inlined
def _store(stage: int, n_tangent: int, n_free: int, update: Update, work: SweepWorkspace) -> None:
    """Write k and K of a stage, zero rows for clamped inputs, and the value function if it is kept."""
    gains = update.gains[stage]
    for i in range(work.k.shape[0]):
        update.feedforward[stage, i] = work.k[i]
        if work.box.clamped[i]:
            for j in range(n_tangent):
                gains[i, j] = 0.0
    for a in range(n_free):
        copy_row_out(gains, work.box.free[a], work.gains, a)
    if update.stage_gradients.shape[0] > 0:
        for i in range(n_tangent):
            update.stage_gradients[stage, i] = work.Vx[i]
            for j in range(n_tangent):
                update.stage_hessians[stage, i, j] = work.Vxx[i, j]


@compiled
def _is_finite(work: SweepWorkspace) -> bool:
    """Say whether the expansion of Q at the current stage, or the value function after it, is finite."""
    n_tangent, n_controls = work.Vxx.shape[0], work.k.shape[0]
    finite = True
    for i in range(n_tangent):
        finite = finite and np.isfinite(work.Vx[i])
        for j in range(i, n_tangent):
            finite = finite and np.isfinite(work.Vxx[i, j])
    for i in range(n_controls):
        finite = finite and np.isfinite(work.Qu[i])
        for j in range(i, n_controls):
            finite = finite and np.isfinite(work.Quu[i, j])
    return finite
