"""Rollouts through the native dynamics: of given controls, and of a control update with its feedback."""

import numpy as np

from experts.compilation import compiled, inlined
from experts.native_call import BufferTable, call_kernel
from experts.padded_algebra import FloatArray

FINISHED = -1
"""In place of the failing stage, when every state and cost of the rollout is finite."""
NO_RETRACTION = 0
"""In place of the address of `retract`, when states are where their steps land."""


@compiled
def rollout(
    step: int,
    step_buffers: BufferTable,
    terminal: int,
    terminal_buffers: BufferTable,
    states: FloatArray,
    stage_costs: FloatArray,
    terminal_cost: FloatArray,
) -> tuple[float, int]:
    """Roll the dynamics out under the controls in the step kernel's buffers.

    Args:
        step: Address of `step_with_cost`.
        step_buffers: Its buffers: states, controls, time step, states from stage 1 on, stage costs.
        terminal: Address of `terminal_cost`.
        terminal_buffers: Its buffers: the last state, the terminal cost.
        states: Row 0 holds the initial state; receives the others; shape (N + 1, n_x).
        stage_costs: Receives the cost of every stage, shape (N,).
        terminal_cost: Receives the terminal cost, shape (1,).

    Returns:
        Total cost, and `FINISHED` or the first stage that gave a number that is not finite.
    """
    total = 0.0
    for k in range(stage_costs.shape[0]):
        call_kernel(step, k, k + 1, step_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and _is_finite(states[k + 1])):
            return np.inf, k
    return _add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@compiled
def closed_loop_rollout(
    difference: int,
    difference_buffers: BufferTable,
    step: int,
    step_buffers: BufferTable,
    retract: int,
    retract_buffers: BufferTable,
    terminal: int,
    terminal_buffers: BufferTable,
    reference_controls: FloatArray,
    feedforward: FloatArray,
    gains: FloatArray,
    alpha: float,
    control_lower: FloatArray,
    control_upper: FloatArray,
    states: FloatArray,
    controls: FloatArray,
    deviations: FloatArray,
    stage_costs: FloatArray,
    terminal_cost: FloatArray,
) -> tuple[float, int]:
    """Roll the dynamics out under u = clip(u_ref + alpha k + K (x (-) x_ref)).

    Args:
        difference: Address of `difference`.
        difference_buffers: Its buffers: reference states, states, deviations.
        step: Address of `step_with_cost`.
        step_buffers: Its buffers: states, controls, time step, states from stage 1 on, stage costs.
        retract: Address of `retract`, which moves every state off where its step lands; or `NO_RETRACTION`.
        retract_buffers: Its buffers: landings, which then take the place of the states that steps write,
            offsets, states from stage 1 on.
        terminal: Address of `terminal_cost`.
        terminal_buffers: Its buffers: the last state, the terminal cost.
        reference_controls: u_ref, shape (N, n_u).
        feedforward: k, shape (N, n_u).
        gains: K, shape (N, n_u, n_t).
        alpha: Step length.
        control_lower: Lower bounds, shape (n_u,).
        control_upper: Upper bounds, shape (n_u,).
        states: Row 0 holds the initial state; receives the others; shape (N + 1, n_x).
        controls: Receives the controls, shape (N, n_u).
        deviations: Receives x (-) x_ref, shape (N, n_t).
        stage_costs: Receives the cost of every stage, shape (N,).
        terminal_cost: Receives the terminal cost, shape (1,).

    Returns:
        Total cost, and `FINISHED` or the first stage that gave a number that is not finite.
    """
    total = 0.0
    horizon, n_controls = controls.shape
    n_tangent = deviations.shape[1]
    for k in range(horizon):
        call_kernel(difference, k, k + 1, difference_buffers)
        for i in range(n_controls):
            control = reference_controls[k, i] + alpha * feedforward[k, i]
            for j in range(n_tangent):
                control += gains[k, i, j] * deviations[k, j]
            if not np.isfinite(control):
                return np.inf, k
            controls[k, i] = min(max(control, control_lower[i]), control_upper[i])
        call_kernel(step, k, k + 1, step_buffers)
        if retract != NO_RETRACTION:
            call_kernel(retract, k, k + 1, retract_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and _is_finite(states[k + 1])):
            return np.inf, k
    return _add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@compiled
def _add_terminal(
    total: float,
    terminal: int,
    terminal_buffers: BufferTable,
    stage_costs: FloatArray,
    terminal_cost: FloatArray,
) -> tuple[float, int]:
    """Add the terminal cost to the sum over stages."""
    call_kernel(terminal, 0, 1, terminal_buffers)
    total += terminal_cost[0]
    if not np.isfinite(total):
        return np.inf, stage_costs.shape[0]
    return total, FINISHED


@inlined
def _is_finite(row: FloatArray) -> bool:
    """Say whether all numbers of a row are finite."""
    finite = True
    for i in range(row.shape[0]):
        finite = finite and np.isfinite(row[i])
    return finite
