"""The backward pass of control-limited DDP: from derivatives along a trajectory to a control update.

Notation of Tassa, Mansard & Todorov (ICRA 2014), in tangent coordinates. A and B are the derivatives of the
dynamics (f_x and f_u), l is the cost of a stage, V the value function of the next stage, and

    Q(dx, du) = l(x + dx, u + du) + V(A dx + B du)

is the quadratic model that every stage minimizes over du, within the bounds of the controls:

    Qx  = lx  + A' Vx         Qu  = lu  + B' Vx
    Qxx = lxx + A' Vxx A      Qux = lux + B' Vxx A      Quu = luu + B' Vxx B

    k = argmin Q(0, du) subject to u_min <= u + du <= u_max            (`box_qp`)
    K = -Quu^-1 Qux in the rows of free inputs, 0 in those of clamped ones

    Vx  <- Qx  + K' Quu k + K' Qu + Qux' k
    Vxx <- Qxx + K' Quu K + K' Qux + Qux' K

With exact second derivatives lxx, lux and luu are those of the Lagrangian, which include the curvature of the
dynamics, V_x . f_xx and so on. Regularized, Quu + mu diag(luu) takes the place of Quu in k and K, so that mu
is relative to the control weights; the update of V is exact for that k and K all the same. Matrices of a
stage have padded rows (see `padded_algebra`).
"""

from typing import NamedTuple

import numpy as np

from experts.ddp.box_qp import NOT_POSITIVE_DEFINITE, BoxQPWorkspace, box_qp, box_qp_workspace
from experts.ddp.derivatives import Derivatives, Hessians
from experts.native.compilation import compiled, inlined
from experts.native.padded_algebra import (
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
from experts.native.vector_tiles import copy_row_out, set_row_sum, set_vector_sum

PASS_COMPLETED = 0
PASS_NOT_POSITIVE_DEFINITE = 1
PASS_NOT_FINITE = 2


class Update(NamedTuple):
    """The control update u + alpha k + K dx, and the derivatives of the value function."""

    k: FloatArray  # shape (N, n_u)
    K: FloatArray  # shape (N, n_u, n_t)
    Vx: FloatArray  # at stage 0, shape (n_t,)
    Vxx: FloatArray  # at stage 0, shape (n_t, n_t)
    Vx_all: FloatArray  # at every stage, shape (N, n_t), or (0, n_t) if they are not kept
    Vxx_all: FloatArray  # at every stage, shape (N, n_t, n_t), or (0, n_t, n_t)


class PassResult(NamedTuple):
    """How a backward pass ended, and the reduction of the cost that it predicts."""

    status: int  # PASS_COMPLETED, PASS_NOT_POSITIVE_DEFINITE or PASS_NOT_FINITE
    stage: int  # at which it failed, 0 when completed
    linear: float  # sum over stages of k' Qu, negative
    quadratic: float  # sum over stages of 1/2 k' Quu k
    clamped: int  # inputs held at a bound, over all stages
    mu: float = 0.0  # regularization
    exact: bool = False  # whether it used exact second derivatives

    @property
    def completed(self) -> bool:
        return self.status == PASS_COMPLETED

    def predicted_reduction(self, alpha: float) -> float:
        """Predict J(u) - J(u + alpha k): -(alpha sum k' Qu + alpha^2 / 2 sum k' Quu k)."""
        return -alpha * (self.linear + alpha * self.quadratic)


class PassWorkspace(NamedTuple):
    """Work arrays of one stage; nt and nu are row lengths, n_t and n_u rounded up to whole vectors."""

    A: FloatArray  # shape (n_t, nt)
    B: FloatArray  # shape (n_t, nu)
    VA: FloatArray  # Vxx A, shape (n_t, nt)
    VB: FloatArray  # Vxx B, shape (n_t, nu)
    Vxx: FloatArray  # shape (n_t, nt); between expansion and update the upper triangle of Qxx
    Vx: FloatArray  # shape (nt,)
    Qx: FloatArray  # shape (nt,)
    Qu: FloatArray  # shape (nu,)
    Qux: FloatArray  # shape (n_u, nt)
    Quu: FloatArray  # shape (n_u, nu)
    Quu_regular: FloatArray  # Quu + mu diag(luu), shape (n_u, nu)
    K: FloatArray  # rows of the free inputs, in their order, shape (n_u, nt)
    coupling: FloatArray  # Qux - mu diag(luu) K of the free inputs, in their order, shape (n_u, nt)
    k: FloatArray  # shape (n_u,)
    slope: FloatArray  # Quu k + Qu, shape (nu,)
    free_slope: FloatArray  # the same of the free inputs, in their order, shape (n_u,)
    room_below: FloatArray  # lower bounds minus the control, shape (n_u,)
    room_above: FloatArray  # upper bounds minus the control, shape (n_u,)
    box: BoxQPWorkspace


def allocate_update(horizon: int, n_tangent: int, n_controls: int, *, keep_values: bool = False) -> Update:
    """Allocate an update; keep_values adds the value function's derivatives at every stage."""
    stages = horizon if keep_values else 0
    return Update(
        k=np.zeros((horizon, n_controls)),
        K=np.zeros((horizon, n_controls, n_tangent)),
        Vx=np.zeros(n_tangent),
        Vxx=np.zeros((n_tangent, n_tangent)),
        Vx_all=np.zeros((stages, n_tangent)),
        Vxx_all=np.zeros((stages, n_tangent, n_tangent)),
    )


def pass_workspace(n_tangent: int, n_controls: int) -> PassWorkspace:
    """Allocate work arrays of zeros; the pass relies on the padding being zero and keeps it so."""
    return PassWorkspace(
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
        K=padded_zeros(n_controls, n_tangent),
        coupling=padded_zeros(n_controls, n_tangent),
        k=np.zeros(n_controls),
        slope=padded_zeros(n_controls),
        free_slope=np.zeros(n_controls),
        room_below=np.zeros(n_controls),
        room_above=np.zeros(n_controls),
        box=box_qp_workspace(n_controls),
    )


@compiled
def backward_pass(
    derivatives: Derivatives,
    hessians: Hessians,
    gaps: FloatArray,
    controls: FloatArray,
    control_lower: FloatArray,
    control_upper: FloatArray,
    mu: float,
    update: Update,
    work: PassWorkspace,
) -> tuple[int, int, float, float, int]:
    """Minimize the quadratic model Q at every stage, from the last to the first.

    The Hessians may be indefinite. Gaps f of x_k+1 (+) f = step(x_k, u_k), shape (N, n_t), are closed by the
    update, whose model is l(x, u) + V(A dx + B du + f); shape (0, n_t) if the trajectory has none. Returns
    the first fields of `PassResult` as a plain tuple: to make a named one, compiled code would call Python,
    where a pending Ctrl-C crashes the process.
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
            # Vx at x_k+1 becomes Vx where the step lands.
            add_vector_product(work.Vx, work.Vxx, gaps[stage], n_tangent)
        _expand(derivatives, hessians, stage, work)
        _regularize(derivatives.luu[stage], mu, work)
        for i in range(n_controls):
            work.room_below[i] = control_lower[stage, i] - controls[stage, i]
            work.room_above[i] = control_upper[stage, i] - controls[stage, i]
        # work.k still holds k of the next stage: a close first guess.
        status, n_free = box_qp(
            work.Quu_regular, work.Qu[:n_controls], work.room_below, work.room_above, work.k, work.box
        )
        if status == NOT_POSITIVE_DEFINITE:
            failure = PASS_NOT_POSITIVE_DEFINITE if _is_finite(work) else PASS_NOT_FINITE
            return failure, stage, linear, quadratic, clamped
        stage_linear, stage_quadratic = _expected_change(work)
        linear += stage_linear
        quadratic += stage_quadratic
        clamped += n_controls - n_free
        prefetch_to_write(update.K[max(stage - 1, 0)])
        _find_gains(derivatives.luu[stage], mu, n_free, work)
        _update_value(n_tangent, n_free, work)
        _store(stage, n_tangent, n_free, update, work)
    for i in range(n_tangent):
        update.Vx[i] = work.Vx[i]
        for j in range(n_tangent):
            update.Vxx[i, j] = work.Vxx[i, j]
    if not (np.isfinite(linear + quadratic) and _is_finite(work)):
        return PASS_NOT_FINITE, 0, linear, quadratic, clamped
    return PASS_COMPLETED, 0, linear, quadratic, clamped


@inlined
def _expand(derivatives: Derivatives, hessians: Hessians, stage: int, work: PassWorkspace) -> None:
    """Expand Q to second order; the upper triangle of Qxx takes the place of Vxx."""
    n_tangent = derivatives.lx.shape[1]
    copy_in(work.A, derivatives.A[stage])
    copy_in(work.B, derivatives.B[stage])
    earlier = max(stage - 1, 0)
    # Prefetches stand between the products: too many at once would stall the processor.
    prefetch(derivatives.A[earlier])
    set_product(work.VA, work.Vxx, work.A, n_tangent)
    prefetch(derivatives.B[earlier])
    set_product(work.VB, work.Vxx, work.B, n_tangent)
    # Qxx = lxx + A' Vxx A
    copy_in(work.Vxx, hessians.xx[stage])
    prefetch(hessians.xx[earlier])
    add_product_upper(work.Vxx, work.A, work.VA, n_tangent)
    # Qux = lux + B' Vxx A
    set_product(work.Qux, work.B, work.VA, n_tangent)
    if hessians.ux.shape[0] > 0:
        add_block(work.Qux, hessians.ux[stage])
        prefetch(hessians.ux[earlier])
    # Quu = luu + B' Vxx B
    copy_in(work.Quu, hessians.uu[stage])
    prefetch(hessians.uu[earlier])
    add_product(work.Quu, work.B, work.VB, n_tangent)
    # Qx = lx + A' Vx, Qu = lu + B' Vx
    set_vector_sum(work.Qx, derivatives.lx[stage], work.A, work.Vx, n_tangent)
    set_vector_sum(work.Qu, derivatives.lu[stage], work.B, work.Vx, n_tangent)


@inlined
def _regularize(luu: FloatArray, mu: float, work: PassWorkspace) -> None:
    """Compute Quu + mu diag(luu)."""
    copy_in(work.Quu_regular, work.Quu)
    for i in range(luu.shape[0]):
        work.Quu_regular[i, i] += mu * luu[i, i]


@inlined
def _expected_change(work: PassWorkspace) -> tuple[float, float]:
    """Compute k' Qu and 1/2 k' Quu k, and keep Quu k + Qu; Quu is not regularized here."""
    linear, quadratic = 0.0, 0.0
    n_controls = work.k.shape[0]
    set_vector_sum(work.slope, work.Qu, work.Quu, work.k, n_controls)
    for i in range(n_controls):
        linear += work.k[i] * work.Qu[i]
        quadratic += 0.5 * work.k[i] * (work.slope[i] - work.Qu[i])
    return linear, quadratic


@inlined
def _find_gains(luu: FloatArray, mu: float, n_free: int, work: PassWorkspace) -> None:
    """Solve (Quu + mu diag(luu)) K = -Qux for the free inputs."""
    for a in range(n_free):
        i = work.box.free[a]
        set_row_sum(work.K, a, work.Qux, i, -2.0, work.Qux, i)  # -Qux
    solve_in_place(work.box.factor, work.box.inverse_pivots, work.K, n_free)
    for a in range(n_free):
        i = work.box.free[a]
        set_row_sum(work.coupling, a, work.Qux, i, -mu * luu[i, i], work.K, a)


@inlined
def _update_value(n_tangent: int, n_free: int, work: PassWorkspace) -> None:
    """Propagate the value function under the control update.

    As (Quu + mu R) K = -Qux in the free rows, R = diag(luu), Vxx = Qxx + K' Quu K + K' Qux + Qux' K is
    Qxx + K' (Qux - mu R K): one symmetric product instead of three.
    """
    set_vector_sum(work.Vx, work.Qx, work.Qux, work.k, work.k.shape[0])
    for a in range(n_free):
        work.free_slope[a] = work.slope[work.box.free[a]]
    set_vector_sum(work.Vx, work.Vx, work.K, work.free_slope, n_free)
    add_product_upper(work.Vxx, work.K, work.coupling, n_free)
    mirror_upper(work.Vxx, n_tangent)


@inlined
def _store(stage: int, n_tangent: int, n_free: int, update: Update, work: PassWorkspace) -> None:
    """Write k and K of a stage, zero rows for clamped inputs, and the value function if it is kept."""
    gains = update.K[stage]
    for i in range(work.k.shape[0]):
        update.k[stage, i] = work.k[i]
        if work.box.clamped[i]:
            for j in range(n_tangent):
                gains[i, j] = 0.0
    for a in range(n_free):
        copy_row_out(gains, work.box.free[a], work.K, a)
    if update.Vx_all.shape[0] > 0:
        for i in range(n_tangent):
            update.Vx_all[stage, i] = work.Vx[i]
            for j in range(n_tangent):
                update.Vxx_all[stage, i, j] = work.Vxx[i, j]


@compiled
def _is_finite(work: PassWorkspace) -> bool:
    """Whether the expansion of Q at the current stage, or the value function after it, is finite."""
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
