"""A trajectory and the ways to fill it: roll out given controls, or follow another one with feedback."""

from collections.abc import Mapping

import numpy as np

from experts.native_call import buffer_table
from experts.problem import RETRACTION_KERNEL_NAME, FloatArray, Kernel, ShootingProblem
from experts.rollout import FINISHED, NO_RETRACTION, closed_loop_rollout, rollout


class Trajectory:
    """States, controls and costs of one rollout, with the buffer tables of the kernels that fill them.

    Attributes:
        states: Shape (N + 1, n_x); who rolls out writes the first one.
        controls: Shape (N, n_u).
        stage_costs: Shape (N,).
        terminal_cost: Shape (1,).
        cost: Total cost, inf if the rollout is not finite.
        failing_stage: First stage with a number that is not finite, or `FINISHED`.
    """

    def __init__(self, problem: ShootingProblem) -> None:
        """Allocate the arrays.

        Args:
            problem: Gives the sizes, and what its terminal cost reads; the caller keeps it alive.
        """
        self.states = np.zeros((problem.horizon + 1, problem.n_states))
        self.controls = np.zeros((problem.horizon, problem.n_controls))
        self.stage_costs = np.zeros(problem.horizon)
        self.terminal_cost = np.zeros(1)
        self.cost = np.inf
        self.failing_stage = FINISHED
        self._deviations = np.zeros((problem.horizon, problem.n_tangent))
        self._time_step = np.array([problem.time_step])
        self._bounds = (
            np.array(problem.control_lower, dtype=np.float64),
            np.array(problem.control_upper, dtype=np.float64),
        )
        self._step_buffers = buffer_table(
            self.states, self.controls, self._time_step, self.states[1:], self.stage_costs
        )
        self._terminal_buffers = buffer_table(self.states[-1:], *problem.terminal_inputs, self.terminal_cost)

    def roll_out(self, kernels: Mapping[str, Kernel]) -> float:
        """Roll out the controls from the first state.

        Args:
            kernels: `step_with_cost` and `terminal_cost`.

        Returns:
            Total cost, inf if it is not finite.
        """
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
        offsets: FloatArray | None = None,
    ) -> float:
        """Roll out u = clip(u_ref + alpha k + K (x (-) x_ref)) from the first state.

        Args:
            kernels: `difference`, `step_with_cost`, `terminal_cost`, and `retract` if there are offsets.
            reference: x_ref, shape (N + 1, n_x), and u_ref, shape (N, n_u), C-contiguous.
            policy: k, shape (N, n_u), and K, shape (N, n_u, n_t).
            alpha: Step length, in [0, 1].
            offsets: What each state is moved by from where its step lands, in tangent coordinates there, so
                that the result has the negative offsets for gaps, shape (N, n_t); None for a true rollout.

        Returns:
            Total cost, inf if it is not finite.
        """
        step_buffers, retract, retract_buffers = self._step_buffers, NO_RETRACTION, buffer_table()
        if offsets is not None:
            landings = np.zeros_like(self.states[1:])
            step_buffers = buffer_table(
                self.states, self.controls, self._time_step, landings, self.stage_costs
            )
            retract = kernels[RETRACTION_KERNEL_NAME].address
            retract_buffers = buffer_table(landings, offsets, self.states[1:])
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
            *self._bounds,
            self.states,
            self.controls,
            self._deviations,
            self.stage_costs,
            self.terminal_cost,
        )
        return self.cost
