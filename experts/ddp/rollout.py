"""Rollouts through the native dynamics: of given controls, or of a control update with its feedback."""

from collections.abc import Mapping

import numpy as np

from dq_space_arm_env.kernels.bound import buffer_table
from experts.native.compilation import BufferTable, call_kernel, compiled, inlined, part
from experts.problems.shooting_problem import (
    RETRACTION_KERNEL_NAME,
    FloatArray,
    Kernel,
    RateLimits,
    ShootingProblem,
    native_calls,
    rate_limits,
)

FINISHED = -1
"""Instead of a failing stage: every state and cost of the rollout is finite."""
NO_RETRACTION = 0
"""Instead of the address of `retract`: states are where their steps land."""


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
    """Roll out the controls in the step kernel's buffers.

    Returns the total cost, and the first stage with a number that is not finite, or `FINISHED`.
    """
    total = 0.0
    for k in range(stage_costs.shape[0]):
        call_kernel(step, k, k + 1, step_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and is_finite(states[k + 1])):
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
    rates: RateLimits,
) -> tuple[float, int]:
    """Roll out u = clip(u_ref + alpha k + K (x (-) x_ref)); return as `rollout` does.

    Buffers are those of the kernels in `experts.problems.shooting_problem`. With `retract`, steps write
    landings, which it moves by offsets to the states.
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
            controls[k, i] = min(max(control, control_lower[k, i]), control_upper[k, i])
        for a in range(rates.change.shape[0]):
            i, previous = rates.controls[a], states[k, rates.states[a]]
            controls[k, i] = min(max(controls[k, i], previous - rates.change[a]), previous + rates.change[a])
        call_kernel(step, k, k + 1, step_buffers)
        if retract != NO_RETRACTION:
            call_kernel(retract, k, k + 1, retract_buffers)
        total += stage_costs[k]
        if not (np.isfinite(total) and is_finite(states[k + 1])):
            return np.inf, k
    return _add_terminal(total, terminal, terminal_buffers, stage_costs, terminal_cost)


@part
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
def is_finite(row: FloatArray) -> bool:
    """Whether all numbers of a row are finite."""
    finite = True
    for i in range(row.shape[0]):
        finite = finite and np.isfinite(row[i])
    return finite


class Trajectory:
    """States, controls and costs of one rollout, and the buffer tables of the kernels that fill them.

    Attributes:
        states: Shape (N + 1, n_x); the caller sets the first one.
        controls: Shape (N, n_u).
        stage_costs: Shape (N,).
        terminal_cost: Shape (1,).
        cost: Total cost, inf if the rollout is not finite.
        failing_stage: First stage with a number that is not finite, or `FINISHED`.
    """

    def __init__(self, problem: ShootingProblem) -> None:
        self.states = np.zeros((problem.horizon + 1, problem.n_states))
        self.controls = np.zeros((problem.horizon, problem.n_controls))
        self.stage_costs = np.zeros(problem.horizon)
        self.terminal_cost = np.zeros(1)
        self.cost = np.inf
        self.failing_stage = FINISHED
        self._deviations = np.zeros((problem.horizon, problem.n_tangent))
        self._time_step = np.array([problem.time_step])
        self._problem = problem
        self._step_buffers = self._buffers_of_step(self.states[1:])
        self._terminal_buffers = buffer_table(self.states[-1:], *problem.terminal_inputs, self.terminal_cost)

    def _buffers_of_step(self, landings: FloatArray) -> BufferTable:
        """Buffers of a step that writes landings, shape (N, n_x)."""
        given = (*self._problem.parameters.inputs, self.controls, self._time_step)
        return buffer_table(self.states, *given, landings, self.stage_costs)

    def roll_out(self, kernels: Mapping[str, Kernel]) -> float:
        """Roll out the controls from the first state; return the total cost, inf if it is not finite."""
        with native_calls(self._problem):
            self.cost, self.failing_stage = rollout(
                kernels["step_with_cost"].address,
                self._step_buffers,
                kernels["terminal_cost"].address,
                self._terminal_buffers,
                self.states,
                self.stage_costs,
                self.terminal_cost,
            )
        return self.cost

    def follow(
        self,
        kernels: Mapping[str, Kernel],
        reference: tuple[FloatArray, FloatArray],
        policy: tuple[FloatArray, FloatArray],
        alpha: float,
        bounds: tuple[FloatArray, FloatArray],
        offsets: FloatArray | None = None,
    ) -> float:
        """Roll out u = clip(u_ref + alpha k + K (x (-) x_ref)) from the first state; return the total cost.

        The reference is x_ref, shape (N + 1, n_x), and u_ref, shape (N, n_u); the policy is k, shape (N,
        n_u), and K, shape (N, n_u, n_t); the bounds are those of `stage_bounds`. Offsets, shape (N, n_t),
        move each state from where its step lands, in tangent coordinates there, and leave the negative
        offsets as gaps; None for a true rollout.
        """
        step_buffers, retract, retract_buffers = self._step_buffers, NO_RETRACTION, buffer_table()
        if offsets is not None:
            landings = np.zeros_like(self.states[1:])
            step_buffers = self._buffers_of_step(landings)
            retract = kernels[RETRACTION_KERNEL_NAME].address
            retract_buffers = buffer_table(landings, offsets, self.states[1:])
        with native_calls(self._problem):
            self.cost, self.failing_stage = closed_loop_rollout(
                kernels["difference"].address,
                buffer_table(reference[0], self.states, self._deviations),
                kernels["step_with_cost"].address,
                step_buffers,
                retract,
                retract_buffers,
                kernels["terminal_cost"].address,
                self._terminal_buffers,
                reference[1],
                *policy,
                float(alpha),
                *bounds,
                self.states,
                self.controls,
                self._deviations,
                self.stage_costs,
                self.terminal_cost,
                rate_limits(self._problem),
            )
        return self.cost
