"""Rollouts through the native dynamics: of given controls, and of a control update with its feedback."""

import numpy as np

from experts.compilation import compiled, inlined
from experts.native_call import BufferTable, call_kernel
from experts.padded_algebra import FloatArray

FINISHED = -1
"""In place of the failing stage, when every state and cost of the rollout is finite."""


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
        if not (np.isfinite(total) and is_finite(states[k + 1])):
            return np.inf, k
    return add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@compiled
def closed_loop_rollout(
    difference: int,
    difference_buffers: BufferTable,
    step: int,
    step_buffers: BufferTable,
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
    for k in range(controls.shape[0]):
        call_kernel(difference, k, k + 1, difference_buffers)
        if not set_controls(
            controls[k],
            reference_controls[k],
            alpha,
            feedforward[k],
            gains[k],
            deviations[k],
            control_lower,
            control_upper,
        ):
            return np.inf, k
        call_kernel(step, k, k + 1, step_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and is_finite(states[k + 1])):
            return np.inf, k
    return add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@compiled
def add_terminal(
    total: float,
    terminal: int,
    terminal_buffers: BufferTable,
    stage_costs: FloatArray,
    terminal_cost: FloatArray,
) -> tuple[float, int]:
    """Add the terminal cost to the sum over stages.

    Args:
        total: The sum.
        terminal: Address of `terminal_cost`.
        terminal_buffers: Its buffers: the last state, the terminal cost.
        stage_costs: Costs of the stages, shape (N,).
        terminal_cost: Receives the terminal cost, shape (1,).

    Returns:
        Total cost, and `FINISHED`, or N if the terminal cost is not finite.
    """
    call_kernel(terminal, 0, 1, terminal_buffers)
    total += terminal_cost[0]
    if not np.isfinite(total):
        return np.inf, stage_costs.shape[0]
    return total, FINISHED


@inlined
def set_controls(
    controls: FloatArray,
    reference: FloatArray,
    alpha: float,
    feedforward: FloatArray,
    gains: FloatArray,
    deviation: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> bool:
    """Compute u = clip(u_ref + alpha k + K (x (-) x_ref)) of a stage.

    Args:
        controls: Receives u, shape (n_u,).
        reference: u_ref, shape (n_u,).
        alpha: Step length.
        feedforward: k, shape (n_u,).
        gains: K, shape (n_u, n_t).
        deviation: x (-) x_ref, shape (n_t,).
        lower: Lower bounds, shape (n_u,).
        upper: Upper bounds, shape (n_u,).

    Returns:
        Whether it is finite before it is clipped.
    """
    finite = True
    for i in range(controls.shape[0]):
        control = reference[i] + alpha * feedforward[i]
        for j in range(deviation.shape[0]):
            control += gains[i, j] * deviation[j]
        finite = finite and np.isfinite(control)
        controls[i] = min(max(control, lower[i]), upper[i])
    return finite


@inlined
def is_finite(row: FloatArray) -> bool:
    """Say whether all numbers of a row are finite.

    Args:
        row: Shape (n,).

    Returns:
        Whether they are.
    """
    finite = True
    for i in range(row.shape[0]):
        finite = finite and np.isfinite(row[i])
    return finite
