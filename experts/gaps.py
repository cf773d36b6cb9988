"""Trajectories with gaps: a rollout that closes a share of them, and what the model says of its cost.

Between two stages of such a trajectory there is a gap f_k = step(x_k, u_k) (-) x_k+1, in the tangent
coordinates of x_k+1; see `multiple_shooting`.
"""

import numpy as np

from experts.backward_sweep import Update
from experts.compilation import compiled
from experts.derivatives import Derivatives
from experts.native_call import BufferTable, call_kernel
from experts.padded_algebra import FloatArray
from experts.rollout import add_terminal, is_finite, set_controls


@compiled
def rollout_with_gaps(
    difference: int,
    difference_buffers: BufferTable,
    step: int,
    step_buffers: BufferTable,
    retract: int,
    retract_buffers: BufferTable,
    terminal: int,
    terminal_buffers: BufferTable,
    reference_controls: FloatArray,
    update: Update,
    alpha: float,
    control_lower: FloatArray,
    control_upper: FloatArray,
    states: FloatArray,
    controls: FloatArray,
    deviations: FloatArray,
    stage_costs: FloatArray,
    terminal_cost: FloatArray,
) -> tuple[float, int]:
    """Roll out u = clip(u_ref + alpha k + K (x (-) x_ref)), every state moved off where its step lands.

    Args:
        difference: Address of `difference`.
        difference_buffers: Its buffers: reference states, states, deviations.
        step: Address of `step_with_cost`.
        step_buffers: Its buffers: states, controls, time step, landings, stage costs.
        retract: Address of `retract`.
        retract_buffers: Its buffers: landings, offsets, states from stage 1 on. A state is its landing (+)
            the offset, so that the offset is the negative gap of the result.
        terminal: Address of `terminal_cost`.
        terminal_buffers: Its buffers: the last state, the terminal cost.
        reference_controls: u_ref, shape (N, n_u).
        update: k and K.
        alpha: Step length.
        control_lower: Lower bounds, shape (n_u,).
        control_upper: Upper bounds, shape (n_u,).
        states: Row 0 holds the first state; receives the others; shape (N + 1, n_x).
        controls: Receives the controls, shape (N, n_u).
        deviations: Receives x (-) x_ref, shape (N, n_t).
        stage_costs: Receives the cost of every stage, shape (N,).
        terminal_cost: Receives the terminal cost, shape (1,).

    Returns:
        Total cost, and `FINISHED` or the first stage that gave a number that is not finite.
    """
    total = 0.0
    for k in range(controls.shape[0]):
        call_kernel(difference, k, k + 1, difference_buffers)
        if not set_controls(
            controls[k],
            reference_controls[k],
            alpha,
            update.feedforward[k],
            update.gains[k],
            deviations[k],
            control_lower,
            control_upper,
        ):
            return np.inf, k
        call_kernel(step, k, k + 1, step_buffers)
        call_kernel(retract, k, k + 1, retract_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and is_finite(states[k + 1])):
            return np.inf, k
    return add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@compiled
def change_of_cost(
    derivatives: Derivatives,
    update: Update,
    initial_gap: FloatArray,
    gaps: FloatArray,
    dx: FloatArray,
    dx_next: FloatArray,
    du: FloatArray,
) -> tuple[float, float]:
    """Compute how a step that closes the gaps changes the quadratic model of the cost.

    The linearized rollout dx_0 = f, du = k + K dx, dx_k+1 = A dx + B du + f_k is followed; a step of length
    alpha moves alpha times as far.

    Args:
        derivatives: Derivatives along the trajectory with gaps.
        update: k and K.
        initial_gap: What the first state lacks to the initial state, shape (n_t,).
        gaps: f_k, shape (N, n_t).
        dx: Work array, shape (n_t,).
        dx_next: Work array, shape (n_t,).
        du: Work array, shape (n_u,).

    Returns:
        Change per step length, the exact derivative of the cost; and the same per squared step length.
    """
    horizon, n_tangent = gaps.shape
    n_controls = du.shape[0]
    linear, quadratic = 0.0, 0.0
    for i in range(n_tangent):
        dx[i] = initial_gap[i]
    for k in range(horizon):
        for i in range(n_controls):
            du[i] = update.feedforward[k, i]
            for j in range(n_tangent):
                du[i] += update.gains[k, i, j] * dx[j]
        for i in range(n_controls):
            curvature = 0.0
            for j in range(n_controls):
                curvature += derivatives.luu[k, i, j] * du[j]
            linear += derivatives.lu[k, i] * du[i]
            quadratic += 0.5 * du[i] * curvature
        for i in range(n_tangent):
            curvature, moved = 0.0, gaps[k, i]
            for j in range(n_tangent):
                curvature += derivatives.lxx[k, i, j] * dx[j]
                moved += derivatives.A[k, i, j] * dx[j]
            for j in range(n_controls):
                moved += derivatives.B[k, i, j] * du[j]
            linear += derivatives.lx[k, i] * dx[i]
            quadratic += 0.5 * dx[i] * curvature
            dx_next[i] = moved
        for i in range(n_tangent):
            dx[i] = dx_next[i]
    for i in range(n_tangent):
        curvature = 0.0
        for j in range(n_tangent):
            curvature += derivatives.terminal_lxx[0, i, j] * dx[j]
        linear += derivatives.terminal_lx[0, i] * dx[i]
        quadratic += 0.5 * dx[i] * curvature
    return linear, quadratic
