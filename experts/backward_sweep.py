"""The backward sweep of control-limited DDP: from derivatives along a trajectory to an update and its gains.

Notation of Tassa, Mansard & Todorov (ICRA 2014), in tangent coordinates: A and B are the derivatives of the
dynamics, l is the cost of a stage, V the value function and ``Q(x, u) = l(x, u) + V(A x + B u)`` the
quadratic model that is minimized over u at every stage. Matrices of a stage are kept in padded rows (see
`padded_algebra`).
"""

from typing import NamedTuple

import numpy as np

from experts.box_qp import NOT_POSITIVE_DEFINITE, BoxQPWorkspace, box_qp, box_qp_workspace
from experts.compilation import compiled
from experts.derivatives import Derivatives, Hessians
from experts.padded_algebra import (
    FloatArray,
    add_block,
    add_product_upper,
    add_vector_product,
    copy_block,
    mirror_upper,
    padded,
    prefetch,
    set_product,
    solve_in_place,
)

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
    """Work arrays of one stage; nt and nu are n_t and n_u rounded up to whole vectors.

    Attributes:
        A: Derivative of the next state with respect to the state, shape (nt, nt).
        B: Derivative of the next state with respect to the control, shape (nt, nu).
        VA: Vxx A, shape (nt, nt).
        VB: Vxx B, shape (nt, nu).
        Vxx: Hessian of the value function; between expansion and update it holds Qxx, upper triangle; (nt,
            nt).
        Vx: Gradient of the value function; shape (nt,).
        Qx: State part of the gradient of Q, shape (nt,).
        Qu: Control part of the gradient of Q, shape (n_u,).
        Qux: Mixed block of the Hessian of Q, shape (nu, nt).
        Quu: Control block of the Hessian of Q, shape (nu, nu).
        Quu_regular: Quu + lambda diag(luu), shape (nu, nu).
        gains: -K of the free inputs, in their order, shape (nu, nt).
        coupling: -(Qux - lambda diag(luu) K) of the free inputs, in their order, shape (nu, nt).
        k: Control update, shape (n_u,).
        slope: Quu k + Qu, shape (n_u,).
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
    nt, nu = padded(n_tangent), padded(n_controls)
    return SweepWorkspace(
        A=np.zeros((nt, nt)),
        B=np.zeros((nt, nu)),
        VA=np.zeros((nt, nt)),
        VB=np.zeros((nt, nu)),
        Vxx=np.zeros((nt, nt)),
        Vx=np.zeros(nt),
        Qx=np.zeros(nt),
        Qu=np.zeros(n_controls),
        Qux=np.zeros((nu, nt)),
        Quu=np.zeros((nu, nu)),
        Quu_regular=np.zeros((nu, nu)),
        gains=np.zeros((nu, nt)),
        coupling=np.zeros((nu, nt)),
        k=np.zeros(n_controls),
        slope=np.zeros(n_controls),
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
    copy_block(work.Vxx, hessians.terminal_xx[0])
    work.k[:] = 0.0
    linear, quadratic, clamped = 0.0, 0.0, 0
    for stage in range(horizon - 1, -1, -1):
        if gaps.shape[0] > 0:
            # From the gradient at x_k+1 to the one where the step lands.
            add_vector_product(work.Vx, work.Vxx, gaps[stage], n_tangent)
        _expand(derivatives, hessians, stage, work)
        mirror_upper(work.Quu, n_controls)
        _regularize(derivatives.luu[stage], regularization, work)
        for i in range(n_controls):
            work.room_below[i] = control_lower[i] - controls[stage, i]
            work.room_above[i] = control_upper[i] - controls[stage, i]
        # work.k still holds the update of the stage after this one: a close first guess.
        status, n_free = box_qp(work.Quu_regular, work.Qu, work.room_below, work.room_above, work.k, work.box)
        if status == NOT_POSITIVE_DEFINITE:
            failure = SWEEP_NOT_POSITIVE_DEFINITE if _is_finite(work) else SWEEP_NOT_FINITE
            return failure, stage, linear, quadratic, clamped
        stage_linear, stage_quadratic = _expected_change(work)
        linear += stage_linear
        quadratic += stage_quadratic
        clamped += n_controls - n_free
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


@compiled
def _expand(derivatives: Derivatives, hessians: Hessians, stage: int, work: SweepWorkspace) -> None:
    """Expand Q to second order; Qx and Qxx take the place of Vx and Vxx.

    Qx = lx + A' Vx, Qu = lu + B' Vx, Qxx = Hxx + A' Vxx A, Qux = Hux + B' Vxx A, Quu = Huu + B' Vxx B.
    """
    n_tangent = derivatives.lx.shape[1]
    copy_block(work.A, derivatives.A[stage])
    copy_block(work.B, derivatives.B[stage])
    if stage > 0:
        prefetch(derivatives.A[stage - 1])
        prefetch(derivatives.B[stage - 1])
    set_product(work.VA, work.Vxx, work.A, n_tangent)
    set_product(work.VB, work.Vxx, work.B, n_tangent)
    copy_block(work.Vxx, hessians.xx[stage])
    if stage > 0:
        prefetch(hessians.xx[stage - 1])
        prefetch(hessians.uu[stage - 1])
    add_product_upper(work.Vxx, work.A, work.VA, n_tangent)
    set_product(work.Qux, work.B, work.VA, n_tangent)
    if hessians.ux.shape[0] > 0:
        add_block(work.Qux, hessians.ux[stage])
        if stage > 0:
            prefetch(hessians.ux[stage - 1])
    copy_block(work.Quu, hessians.uu[stage])
    add_product_upper(work.Quu, work.B, work.VB, n_tangent)
    for j in range(n_tangent):
        work.Qx[j] = derivatives.lx[stage, j]
    add_vector_product(work.Qx, work.A, work.Vx, n_tangent)
    for i in range(work.Qu.shape[0]):
        work.Qu[i] = derivatives.lu[stage, i]
    add_vector_product(work.Qu, work.B, work.Vx, n_tangent)


@compiled
def _regularize(luu: FloatArray, regularization: float, work: SweepWorkspace) -> None:
    """Build Quu + lambda diag(luu)."""
    copy_block(work.Quu_regular, work.Quu)
    for i in range(luu.shape[0]):
        work.Quu_regular[i, i] += regularization * luu[i, i]


@compiled
def _expected_change(work: SweepWorkspace) -> tuple[float, float]:
    """Compute k' Qu and 1/2 k' Quu k, and keep Quu k + Qu; all with the Quu that is not regularized."""
    linear, quadratic = 0.0, 0.0
    n_controls = work.k.shape[0]
    for i in range(n_controls):
        product = 0.0
        for j in range(n_controls):
            product += work.Quu[i, j] * work.k[j]
        linear += work.k[i] * work.Qu[i]
        quadratic += 0.5 * work.k[i] * product
        work.slope[i] = product + work.Qu[i]
    return linear, quadratic


@compiled
def _find_gains(luu: FloatArray, regularization: float, n_free: int, work: SweepWorkspace) -> None:
    """Solve (Quu + lambda diag(luu)) K = -Qux for the free inputs."""
    n_columns = work.Qux.shape[1]
    for a in range(n_free):
        row, source = work.gains[a], work.Qux[work.box.free[a]]
        for j in range(n_columns):
            row[j] = source[j]
    solve_in_place(work.box.factor, work.box.inverse_diagonal, work.gains, n_free)
    for a in range(n_free):
        i = work.box.free[a]
        weight = regularization * luu[i, i]
        row, source, gain = work.coupling[a], work.Qux[i], work.gains[a]
        for j in range(n_columns):
            row[j] = -source[j] - weight * gain[j]


@compiled
def _update_value(n_tangent: int, n_free: int, work: SweepWorkspace) -> None:
    """Propagate the value function under the update that the box allows.

    Tassa's form, with Quu and Qux not regularized:
        Vx = Qx + K' Quu k + K' Qu + Qux' k,  Vxx = Qxx + K' Quu K + K' Qux + Qux' K.
    As (Quu + lambda R) K = -Qux in the free rows, R = diag(luu), the latter is
        Vxx = Qxx + K' (Qux - lambda R K),
    one symmetric product instead of three.
    """
    for j in range(n_tangent):
        work.Vx[j] = work.Qx[j]
    add_vector_product(work.Vx, work.Qux, work.k, work.k.shape[0])
    for a in range(n_free):
        slope, gain = work.slope[work.box.free[a]], work.gains[a]
        for j in range(n_tangent):
            work.Vx[j] -= slope * gain[j]
    add_product_upper(work.Vxx, work.gains, work.coupling, n_free)
    mirror_upper(work.Vxx, n_tangent)


@compiled
def _store(stage: int, n_tangent: int, n_free: int, update: Update, work: SweepWorkspace) -> None:
    """Write k and K of a stage, zero rows for clamped inputs, and the value function if it is kept."""
    for i in range(work.k.shape[0]):
        update.feedforward[stage, i] = work.k[i]
        for j in range(n_tangent):
            update.gains[stage, i, j] = 0.0
    for a in range(n_free):
        row, gain = update.gains[stage, work.box.free[a]], work.gains[a]
        for j in range(n_tangent):
            row[j] = -gain[j]
    if update.stage_gradients.shape[0] > 0:
        for i in range(n_tangent):
            update.stage_gradients[stage, i] = work.Vx[i]
            for j in range(n_tangent):
                update.stage_hessians[stage, i, j] = work.Vxx[i, j]


@compiled
def _is_finite(work: SweepWorkspace) -> bool:
    """Say whether the expansion of Q at the current stage, or the value function after it, is finite."""
    n_tangent, n_controls = work.Vx.shape[0], work.k.shape[0]
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
