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
stage have padded rows (see `padded_algebra`). B and A, and what follows from them, stand side by side, in the
order of the controls and the state: few wide products take less time than many narrow ones.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experts.ddp.box_qp import NOT_POSITIVE_DEFINITE, BoxQPWorkspace, box_qp, box_qp_workspace
from experts.ddp.derivatives import Derivatives, Hessians
from experts.native.compilation import compiled, inlined, part
from experts.native.padded_algebra import (
    FloatArray,
    add_vector_product,
    mirror_upper,
    nonzero_rows,
    padded,
    padded_zeros,
    prefetch,
    prefetch_to_write,
    set_product_sum,
    set_product_sum_upper,
    set_symmetric_product,
)
from experts.native.vector_tiles import copy_in, copy_row_out, set_row_sum, set_vector_sum

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

    BA: FloatArray  # shape (n_t, nu + nt)
    B: FloatArray  # a view, shape (n_t, nu)
    A: FloatArray  # a view, shape (n_t, nt)
    B_rows: NDArray[np.int64]  # where B may be nonzero, see `nonzero_rows`
    A_rows: NDArray[np.int64]
    VBA: FloatArray  # Vxx (B, A), shape (n_t, nu + nt)
    VA: FloatArray  # a view, shape (n_t, nt)
    Vxx: FloatArray  # upper triangle; between expansion and update that of Qxx; shape (n_t, nt)
    Vx: FloatArray  # shape (nt,)
    gradient: FloatArray  # (Qu, Qx), shape (nu + nt,)
    Qu: FloatArray  # a view, shape (nu,)
    Qx: FloatArray  # a view, shape (nt,)
    Quux: FloatArray  # Quu, regularized for the box QP, and Qux; shape (n_u, nu + nt)
    Quu: FloatArray  # a view, shape (n_u, nu)
    Qux: FloatArray  # a view, shape (n_u, nt)
    diagonal: FloatArray  # of Quu without regularization, shape (n_u,)
    K: FloatArray  # rows of the free inputs, in their order, a view of the box QP's system, shape (n_u, nt)
    coupling: FloatArray  # Qux - mu diag(luu) K of the free inputs, in their order, shape (n_u, nt)
    k: FloatArray  # shape (n_u,)
    slope: FloatArray  # Quu k + Qu, shape (nu,)
    free_slope: FloatArray  # the same of the free inputs, in their order, shape (n_u,)
    room_below: FloatArray  # lower bounds minus the control, shape (n_u,)
    room_above: FloatArray  # upper bounds minus the control, shape (n_u,)
    box: BoxQPWorkspace
    # Tangent coordinates that the lower and upper bound of an input follow one to one, -1 where a bound is
    # fixed; shape (N, 2, n_u), or (0, 2, n_u) if all are
    follows: NDArray[np.int64]
    followed: NDArray[np.int64]  # what a clamped input follows, -1 for nothing, shape (n_u,)
    response: FloatArray  # of the free inputs to one that follows, in their order, shape (n_u,)


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


def pass_workspace(
    n_tangent: int, n_controls: int, patterns: tuple[NDArray[np.bool_], ...] | None = None
) -> PassWorkspace:
    """Allocate work arrays of zeros; the pass relies on the padding being zero and keeps it so.

    The patterns say which entries of A and B may be nonzero; None: all.
    """
    dense = np.ones((n_tangent, n_tangent), np.bool_), np.ones((n_tangent, n_controls), np.bool_)
    row = padded(n_controls) + n_tangent
    BA, VBA = padded_zeros(n_tangent, row), padded_zeros(n_tangent, row)
    Quux, gradient = padded_zeros(n_controls, row), padded_zeros(row)
    box = box_qp_workspace(n_controls, right_sides=n_tangent)
    A_rows, B_rows = (nonzero_rows(pattern) for pattern in patterns or dense)
    return PassWorkspace(
        BA=BA,
        B=BA[:, : padded(n_controls)],
        A=BA[:, padded(n_controls) :],
        B_rows=B_rows,
        A_rows=A_rows,
        VBA=VBA,
        VA=VBA[:, padded(n_controls) :],
        Vxx=padded_zeros(n_tangent, n_tangent),
        Vx=padded_zeros(n_tangent),
        gradient=gradient,
        Qu=gradient[: padded(n_controls)],
        Qx=gradient[padded(n_controls) :],
        Quux=Quux,
        Quu=Quux[:, : padded(n_controls)],
        Qux=Quux[:, padded(n_controls) :],
        diagonal=np.zeros(n_controls),
        K=box.system[:, padded(n_controls) :],
        coupling=padded_zeros(n_controls, n_tangent),
        k=np.zeros(n_controls),
        slope=padded_zeros(n_controls),
        free_slope=np.zeros(n_controls),
        room_below=np.zeros(n_controls),
        room_above=np.zeros(n_controls),
        box=box,
        follows=np.zeros((0, 2, n_controls), np.int64),
        followed=np.full(n_controls, -1),
        response=np.zeros(n_controls),
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
    work.box.sides[:] = 0
    linear, quadratic, clamped = 0.0, 0.0, 0
    for stage in range(horizon - 1, -1, -1):
        if gaps.shape[0] > 0:
            # Vx at x_k+1 becomes Vx where the step lands.
            mirror_upper(work.Vxx, n_tangent)
            add_vector_product(work.Vx, work.Vxx, gaps[stage], n_tangent)
        _expand(derivatives, hessians, stage, work)
        _regularize(derivatives.luu[stage], mu, work)
        for i in range(n_controls):
            work.room_below[i] = control_lower[stage, i] - controls[stage, i]
            work.room_above[i] = control_upper[stage, i] - controls[stage, i]
        # The sides of the next stage are a close first guess, as is its k.
        status, n_free = box_qp(
            work.Quux,
            work.Qu[:n_controls],
            work.room_below,
            work.room_above,
            work.k,
            work.box,
        )
        if status == NOT_POSITIVE_DEFINITE:
            failure = PASS_NOT_POSITIVE_DEFINITE if _is_finite(work) else PASS_NOT_FINITE
            return failure, stage, linear, quadratic, clamped
        stage_linear, stage_quadratic = _expected_change(work)
        linear += stage_linear
        quadratic += stage_quadratic
        clamped += n_controls - n_free
        prefetch_to_write(update.K[max(stage - 1, 0)])
        if work.follows.shape[0] > 0:
            _follow_bounds(stage, n_free, work)
        _update_value(derivatives.luu[stage], mu, n_free, work)
        if work.follows.shape[0] > 0:
            _update_value_of_followers(n_tangent, n_free, work)
        _store(stage, n_tangent, n_free, update, work)
    mirror_upper(work.Vxx, n_tangent)
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
    copy_in(work.B, derivatives.B[stage])
    copy_in(work.A, derivatives.A[stage])
    earlier = max(stage - 1, 0)
    # Prefetches stand between the products: too many at once would stall the processor.
    prefetch(derivatives.A[earlier])
    prefetch(derivatives.B[earlier])
    set_symmetric_product(work.VBA, work.Vxx, work.BA)
    # (Quu, Qux) = (luu, lux) + B' Vxx (B, A)
    prefetch(hessians.uu[earlier])
    if hessians.ux.shape[0] > 0:
        prefetch(hessians.ux[earlier])
        copy_in(work.Quu, hessians.uu[stage])
        copy_in(work.Qux, hessians.ux[stage])
        set_product_sum(work.Quux, work.Quux, work.B, work.VBA, work.B_rows)
    else:
        set_product_sum(work.Quux, hessians.uu[stage], work.B, work.VBA, work.B_rows)
    # Qxx = lxx + A' Vxx A
    prefetch(hessians.xx[earlier])
    set_product_sum_upper(work.Vxx, hessians.xx[stage], work.A, work.VA, work.A_rows)
    # (Qu, Qx) = (lu, lx) + (B, A)' Vx
    n_controls = derivatives.lu.shape[1]
    for i in range(n_controls):
        work.Qu[i] = derivatives.lu[stage, i]
    for i in range(n_tangent):
        work.Qx[i] = derivatives.lx[stage, i]
    set_vector_sum(work.gradient, work.gradient, work.BA, work.Vx, n_tangent)


@inlined
def _regularize(luu: FloatArray, mu: float, work: PassWorkspace) -> None:
    """Compute Quu + mu diag(luu), and keep the diagonal of Quu."""
    for i in range(luu.shape[0]):
        work.diagonal[i] = work.Quu[i, i]
        work.Quu[i, i] += mu * luu[i, i]


@inlined
def _expected_change(work: PassWorkspace) -> tuple[float, float]:
    """Compute k' Qu and 1/2 k' Quu k, and keep Quu k + Qu; Quu is no longer regularized."""
    linear, quadratic = 0.0, 0.0
    n_controls = work.k.shape[0]
    for i in range(n_controls):
        work.Quu[i, i] = work.diagonal[i]
    set_vector_sum(work.slope, work.Qu, work.Quu, work.k, n_controls)
    for i in range(n_controls):
        linear += work.k[i] * work.Qu[i]
        quadratic += 0.5 * work.k[i] * (work.slope[i] - work.Qu[i])
    return linear, quadratic


@inlined
def _update_value(luu: FloatArray, mu: float, n_free: int, work: PassWorkspace) -> None:
    """Propagate the value function under the control update.

    As (Quu + mu R) K = -Qux in the free rows, which the box QP solved, R = diag(luu), Vxx = Qxx + K' Quu K +
    K' Qux + Qux' K is Qxx + K' (Qux - mu R K): one symmetric product instead of three.
    """
    set_vector_sum(work.Vx, work.Qx, work.Qux, work.k, work.k.shape[0])
    for a in range(n_free):
        i = work.box.free[a]
        work.free_slope[a] = work.slope[i]
        set_row_sum(work.coupling, a, work.Qux, i, -mu * luu[i, i], work.K, a)
    set_vector_sum(work.Vx, work.Vx, work.K, work.free_slope, n_free)
    set_product_sum_upper(work.Vxx, work.Vxx, work.K, work.coupling, n_free)


@part
def _follow_bounds(stage: int, n_free: int, work: PassWorkspace) -> None:
    """Let inputs that are clamped at bounds of their rates follow those, and the free ones respond.

    K_c is a row of the identity, and (Quu + mu R)_ff K_f = -Qux_f - Quu_fc K_c.
    """
    system, pivots = work.box.system, work.box.inverse_pivots
    for c in range(work.k.shape[0]):
        side, t = work.box.sides[c], -1
        if side != 0:
            t = work.follows[stage, 0 if side < 0 else 1, c]
        work.followed[c] = t
        if t < 0:
            continue
        for a in range(n_free):
            work.response[a] = -work.Quu[work.box.free[a], c]
            for b in range(a):
                work.response[a] -= system[b, a] * pivots[b] * work.response[b]
        for a in range(n_free - 1, -1, -1):
            for b in range(a + 1, n_free):
                work.response[a] -= system[a, b] * work.response[b]
            work.response[a] *= pivots[a]
            work.K[a, t] += work.response[a]


@part
def _update_value_of_followers(n_tangent: int, n_free: int, work: PassWorkspace) -> None:
    """Add to the value function what clamped inputs that follow contribute.

    With their rows E of K, Vxx gains K_f' Quu_fc E + E' Qux_c + Qux_c' E + E' Quu_cc E, and Vx gains E' times
    their part of Quu k + Qu.
    """
    for c in range(work.k.shape[0]):
        t = work.followed[c]
        if t < 0:
            continue
        work.Vx[t] += work.slope[c]
        for j in range(n_tangent):
            if j <= t:
                work.Vxx[j, t] += work.Qux[c, j]
            if j >= t:
                work.Vxx[t, j] += work.Qux[c, j]
        for a in range(n_free):
            for i in range(t + 1):
                work.Vxx[i, t] += work.K[a, i] * work.Quu[work.box.free[a], c]
        for d in range(work.k.shape[0]):
            if work.followed[d] >= t:
                work.Vxx[t, work.followed[d]] += work.Quu[c, d]


@inlined
def _store(stage: int, n_tangent: int, n_free: int, update: Update, work: PassWorkspace) -> None:
    """Write k and K of a stage, and the value function if it is kept.

    Clamped inputs have rows of zeros, or of the identity if they follow a bound of their rate.
    """
    gains = update.K[stage]
    for i in range(work.k.shape[0]):
        update.k[stage, i] = work.k[i]
        if work.box.sides[i] != 0:
            for j in range(n_tangent):
                gains[i, j] = 0.0
            if work.followed[i] >= 0:
                gains[i, work.followed[i]] = 1.0
    for a in range(n_free):
        copy_row_out(gains, work.box.free[a], work.K, a)
    if update.Vx_all.shape[0] > 0:
        mirror_upper(work.Vxx, n_tangent)
        for i in range(n_tangent):
            update.Vx_all[stage, i] = work.Vx[i]
            for j in range(n_tangent):
                update.Vxx_all[stage, i, j] = work.Vxx[i, j]


@part
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
