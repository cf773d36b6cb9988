"""Rollouts of several step lengths at once, in the lanes of the processor's vectors.

A rollout proceeds stage by stage, and its state fills one lane of a vector. States of other step lengths fill
the rest: eight rollouts cost little more than one. The line search uses them once the full step is rejected.
"""

from typing import NamedTuple

import numpy as np

from dq_space_arm_env.kernels.bound import buffer_table
from experts.ddp.backward_pass import Update
from experts.ddp.rollout import is_finite
from experts.native.compilation import BufferTable, call_kernel, compiled, part
from experts.native.padded_algebra import FloatArray, set_product_sum
from experts.problems.shooting_problem import RateLimits, ShootingProblem, native_calls, rate_limits

LANES = 8
"""Step lengths per call: a whole number of vectors on any processor."""

LANE_KERNELS = ("difference", "step_with_cost")
"""Kernels that work on all lanes at once."""


class _Work(NamedTuple):
    """Trajectories and work arrays of the lanes."""

    states: FloatArray  # shape (N + 1, LANES, n_x)
    controls: FloatArray  # shape (N, LANES, n_u)
    stage_costs: FloatArray  # shape (N, LANES)
    totals: FloatArray  # total costs, inf where a rollout is not finite, shape (LANES,)
    reference: FloatArray  # reference state of a stage, the same in every row, shape (LANES, n_x)
    deviations: FloatArray  # x (-) x_ref of a stage, shape (LANES, n_t)
    deviation_columns: FloatArray  # its transpose, shape (n_t, LANES)
    control_columns: FloatArray  # controls of a stage, shape (n_u, LANES)
    end_state: FloatArray  # last state of a lane, shape (1, n_x)
    end_cost: FloatArray  # its terminal cost, shape (1,)
    parameters: FloatArray  # inputs of the stages, the same in every lane, shape (N, LANES, n_p and more)
    rates: RateLimits


class _Kernels(NamedTuple):
    """Addresses of kernels, and their buffers."""

    difference: int  # `difference`; row 0 of its second buffer moves along with the stages
    difference_buffers: BufferTable  # reference state, states, deviations
    step: int  # `step_with_cost`; stage k has the rows from k LANES on
    step_buffers: BufferTable  # states, parameters, controls, time step, states from stage 1 on, costs
    terminal: int  # `terminal_cost`, of one row
    terminal_buffers: BufferTable  # last state, whatever else it reads, terminal cost


class ParallelRollouts:
    """Rolls out a control update with up to `LANES` step lengths at once."""

    def __init__(self, problem: ShootingProblem, time_step: FloatArray) -> None:
        self._problem = problem
        horizon, n_x, inputs = problem.horizon, problem.n_states, problem.parameters.inputs
        n_t, n_u = problem.n_tangent, problem.n_controls
        self._work = work = _Work(
            states=np.zeros((horizon + 1, LANES, n_x)),
            controls=np.zeros((horizon, LANES, n_u)),
            stage_costs=np.zeros((horizon, LANES)),
            totals=np.zeros(LANES),
            reference=np.zeros((LANES, n_x)),
            deviations=np.zeros((LANES, n_t)),
            deviation_columns=np.zeros((n_t, LANES)),
            control_columns=np.zeros((n_u, LANES)),
            end_state=np.zeros((1, n_x)),
            end_cost=np.zeros(1),
            parameters=np.zeros((horizon, LANES, inputs[0].shape[1] if inputs else 0)),
            rates=rate_limits(problem),
        )
        parameters = (work.parameters,) if inputs else ()
        # Keeps the kernels' code and the arrays behind the tables alive.
        self._arrays = (time_step, *problem.terminal_inputs)
        self._code = difference, step, terminal = (
            *(problem.kernel(name, batched=True) for name in LANE_KERNELS),
            problem.kernel("terminal_cost"),
        )
        self._kernels = _Kernels(
            difference.address,
            buffer_table(work.reference, work.states, work.deviations),
            step.address,
            buffer_table(
                work.states, *parameters, work.controls, time_step, work.states[1:], work.stage_costs
            ),
            terminal.address,
            buffer_table(work.end_state, *problem.terminal_inputs, work.end_cost),
        )

    def run(
        self,
        step_lengths: FloatArray,
        reference: tuple[FloatArray, FloatArray],
        update: Update,
        control_lower: FloatArray,
        control_upper: FloatArray,
    ) -> FloatArray:
        """Roll out u = clip(u_ref + alpha k + K (x (-) x_ref)) for several alpha."""
        alphas = np.zeros(LANES)
        alphas[: len(step_lengths)] = step_lengths
        states, controls = reference
        for rows in self._problem.parameters.inputs:
            self._work.parameters[:] = rows[:-1, None]
        with native_calls(self._problem):
            _roll_out(
                self._kernels,
                alphas,
                states,
                controls,
                update.k,
                update.K,
                control_lower,
                control_upper,
                self._work,
            )
        return self._work.totals[: len(step_lengths)]

    def trajectory(self, lane: int) -> tuple[FloatArray, FloatArray]:
        """States and controls of one of the last rollouts."""
        return self._work.states[:, lane], self._work.controls[:, lane]


@compiled
def _roll_out(
    kernels: _Kernels,
    alphas: FloatArray,
    reference_states: FloatArray,
    reference_controls: FloatArray,
    feedforward: FloatArray,
    gains: FloatArray,
    control_lower: FloatArray,
    control_upper: FloatArray,
    work: _Work,
) -> None:
    """Roll out all lanes as `closed_loop_rollout` does one, without a retraction.

    One that diverges goes on from the reference, so that no kernel meets a state that is not finite.
    """
    horizon, n_x = work.controls.shape[0], work.states.shape[2]
    first_states = kernels.difference_buffers[1]
    for lane in range(LANES):
        work.totals[lane] = 0.0
        for j in range(n_x):
            work.states[0, lane, j] = reference_states[0, j]
    for k in range(horizon):
        for lane in range(LANES):
            for j in range(n_x):
                work.reference[lane, j] = reference_states[k, j]
        kernels.difference_buffers[1] = first_states + 8 * k * LANES * n_x
        call_kernel(kernels.difference, 0, LANES, kernels.difference_buffers)
        _apply_update(k, alphas, reference_controls, feedforward, gains, control_lower, control_upper, work)
        call_kernel(kernels.step, k * LANES, (k + 1) * LANES, kernels.step_buffers)
        alive = False
        for lane in range(LANES):
            work.totals[lane] += work.stage_costs[k, lane]
            if not (np.isfinite(work.totals[lane]) and is_finite(work.states[k + 1, lane])):
                work.totals[lane] = np.inf
                for j in range(n_x):
                    work.states[k + 1, lane, j] = reference_states[k + 1, j]
            alive = alive or np.isfinite(work.totals[lane])
        if not alive:
            break
    kernels.difference_buffers[1] = first_states
    for lane in range(LANES):
        if work.totals[lane] == np.inf:
            continue
        for j in range(n_x):
            work.end_state[0, j] = work.states[horizon, lane, j]
        call_kernel(kernels.terminal, 0, 1, kernels.terminal_buffers)
        work.totals[lane] += work.end_cost[0]
        if not np.isfinite(work.totals[lane]):
            work.totals[lane] = np.inf


@part
def _apply_update(
    stage: int,
    alphas: FloatArray,
    reference_controls: FloatArray,
    feedforward: FloatArray,
    gains: FloatArray,
    control_lower: FloatArray,
    control_upper: FloatArray,
    work: _Work,
) -> None:
    """Compute the controls of a stage in all lanes: clip(u_ref + alpha k + K dx)."""
    n_tangent, n_controls = work.deviation_columns.shape[0], work.control_columns.shape[0]
    for lane in range(LANES):
        for j in range(n_tangent):
            work.deviation_columns[j, lane] = work.deviations[lane, j]
    for i in range(n_controls):
        for lane in range(LANES):
            work.control_columns[i, lane] = (
                reference_controls[stage, i] + alphas[lane] * feedforward[stage, i]
            )
    columns = work.control_columns
    set_product_sum(columns, columns, gains[stage].T, work.deviation_columns, n_tangent)
    for i in range(n_controls):
        for lane in range(LANES):
            control = work.control_columns[i, lane]
            # A lane of NaN ends up in the box; its cost reveals it.
            control = min(max(control, control_lower[stage, i]), control_upper[stage, i])
            work.controls[stage, lane, i] = control
    for a in range(work.rates.change.shape[0]):
        i, change = work.rates.controls[a], work.rates.change[a]
        for lane in range(LANES):
            control, previous = work.controls[stage, lane, i], work.states[stage, lane, work.rates.states[a]]
            work.controls[stage, lane, i] = min(max(control, previous - change), previous + change)
